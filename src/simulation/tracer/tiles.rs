//! What can be seen at all in a square of pixels, so that its rays meet few shapes.

use std::ops::Range;

use nalgebra::{Point3, Vector3};

use super::{LIFT, Tracer};
use crate::{
    model::{camera::Intrinsics, pose::Pose},
    simulation::{
        scene::Hit,
        shapes::{Bounds, Ray, Shape},
    },
};

/// Side of the squares of pixels that share one search for what may be seen or shade there.
pub(super) const TILE: usize = 8;

/// Pixels that a primitive's bounds cover, columns and rows, and how near they come.
#[derive(Clone)]
pub(super) struct Footprint {
    pub(super) primitive: usize,
    pub(super) window: [Range<usize>; 2],
    pub(super) nearest_m: f64,
}

pub(super) fn overlap(a: &Range<usize>, b: &Range<usize>) -> bool {
    a.start < b.end && b.start < a.end
}

/// What matters in a square of pixels.
pub(super) struct Tile {
    /// What may be seen there, nearest first.
    pub(super) seen: Vec<Footprint>,
    /// Holds every point seen through a pixel's centre.
    pub(super) reach: Bounds,
    /// What may hide the lamp, or some of the sky, from points in `reach`.
    pub(super) lamp: Vec<u32>,
    pub(super) sky: Vec<u32>,
}

impl Tile {
    pub(super) fn over(
        band: &[&Footprint],
        columns: &Range<usize>,
        nearest_m: impl Fn(&Footprint) -> Option<f64>,
    ) -> Self {
        let mut seen: Vec<_> = band
            .iter()
            .filter(|print| overlap(&print.window[0], columns))
            .filter_map(|&print| {
                Some(Footprint {
                    nearest_m: nearest_m(print)?,
                    ..print.clone()
                })
            })
            .collect();
        seen.sort_by(|a, b| a.nearest_m.total_cmp(&b.nearest_m));
        Self {
            seen,
            reach: Bounds::EMPTY,
            lamp: Vec::new(),
            sky: Vec::new(),
        }
    }
}

/// All rays through a square of pixels and a pixel around it.
pub(super) struct Pyramid {
    pub(super) eye: Point3<f64>,
    /// Its four edges: z = 1 in the camera's frame, directions of the world.
    pub(super) edges: [Vector3<f64>; 4],
    /// Of its four sides, pointing outwards.
    pub(super) normals: [Vector3<f64>; 4],
}

impl Pyramid {
    pub(super) fn over(
        camera: &Intrinsics,
        world_from_camera: &Pose,
        columns: Range<usize>,
        rows: Range<usize>,
    ) -> Self {
        let (left, right) = (columns.start as f64 - 1.0, columns.end as f64);
        let (top, bottom) = (rows.start as f64 - 1.0, rows.end as f64);
        let corners = [(left, top), (right, top), (right, bottom), (left, bottom)]
            .map(|(u, v)| world_from_camera.rotation * camera.unproject(u, v, 1.0).coords);
        Self {
            eye: Point3::from(world_from_camera.translation.vector),
            edges: corners,
            normals: std::array::from_fn(|side| corners[(side + 1) % 4].cross(&corners[side])),
        }
    }

    /// No ray of the pyramid meets the shape nearer than this, metres along the ray.
    pub(super) fn nearest_m(&self, shape: &Shape) -> f64 {
        let Shape::Solid(solid) = shape else {
            return 0.0;
        };
        // A ray that enters the solid has passed every plane that faces the eye. Inverse depth of a plane is linear in
        // the image, so it is greatest at an edge of the pyramid.
        let inverse_depth = solid
            .planes()
            .iter()
            .filter_map(|(normal, offset)| {
                let distance = normal.dot(&self.eye.coords) - offset;
                (distance > 0.0).then(|| {
                    self.edges
                        .iter()
                        .map(|edge| -normal.dot(edge) / distance)
                        .fold(0.0, f64::max)
                })
            })
            .fold(f64::INFINITY, f64::min);
        // Along the ray it is farther than in depth.
        inverse_depth.recip()
    }

    /// Never wrong if it says no.
    pub(super) fn may_hold(&self, bounds: &Bounds) -> bool {
        let center = bounds.center() - self.eye;
        let half = bounds.half();
        self.normals
            .iter()
            .all(|normal| normal.dot(&center) <= normal.abs().dot(&half))
    }
}

/// Columns and rows that something in these bounds can reach, with a pixel to spare; the whole image if a part of it is
/// behind the camera.
pub(super) fn window_of(
    bounds: &Bounds,
    camera: &Intrinsics,
    camera_from_world: &Pose,
) -> [Range<usize>; 2] {
    let size = [camera.width, camera.height];
    let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
    let mut behind = 0;
    for corner in 0..8 {
        let pick = |axis: usize| {
            if corner >> axis & 1 == 0 {
                bounds.min[axis]
            } else {
                bounds.max[axis]
            }
        };
        let in_camera = camera_from_world * Point3::new(pick(0), pick(1), pick(2));
        if in_camera.z < 1e-3 {
            behind += 1;
        } else if let Some((u, v)) = camera.project(&in_camera) {
            low = [low[0].min(u), low[1].min(v)];
            high = [high[0].max(u), high[1].max(v)];
        }
    }
    match behind {
        // The casts saturate: what is beside the image gets an empty range.
        0 => [0, 1].map(|axis| {
            ((low[axis] - 1.0).max(0.0) as usize).min(size[axis])
                ..((high[axis] + 2.0).max(0.0) as usize).min(size[axis])
        }),
        8 => [0..0, 0..0],
        _ => size.map(|size| 0..size),
    }
}

impl Tracer<'_> {
    /// Where each primitive can be seen in the image at all.
    pub(super) fn footprints(
        &self,
        camera: &Intrinsics,
        world_from_camera: &Pose,
    ) -> Vec<Footprint> {
        let camera_from_world = world_from_camera.inverse();
        let eye = Point3::from(world_from_camera.translation.vector);
        self.scene
            .bounds()
            .iter()
            .enumerate()
            .map(|(primitive, bounds)| Footprint {
                primitive,
                window: window_of(bounds, camera, &camera_from_world),
                nearest_m: (eye.sup(&bounds.min).inf(&bounds.max) - eye).norm(),
            })
            .filter(|print| print.window.iter().all(|range| !range.is_empty()))
            .collect()
    }

    /// If all that a tile shows is one flat face: where one of its corner pixels meets it. `corners`: their rays, columns
    /// and rows.
    pub(super) fn flat(&self, tile: &Tile, corners: [(&Ray, usize, usize); 4]) -> Option<Hit> {
        let mut farthest: Option<Hit> = None;
        for (ray, column, row) in corners {
            let hit = self.first(ray, tile, column, row)?;
            if let Some(before) = farthest
                && (before.primitive, before.crossing.part) != (hit.primitive, hit.crossing.part)
            {
                return None;
            }
            farthest = match farthest {
                Some(before) if before.crossing.t >= hit.crossing.t => farthest,
                _ => Some(hit),
            };
        }
        let hit = farthest?;
        let Shape::Solid(solid) = &self.scene.primitives()[hit.primitive].shape else {
            return None;
        };
        let (normal, offset) = &solid.planes()[hit.crossing.part];
        let before_face = |primitive: usize| {
            let bounds = &self.scene.bounds()[primitive];
            normal.dot(&bounds.center().coords) + normal.abs().dot(&bounds.half()) > offset + 1e-9
        };
        // A face of a convex solid that holds the corners holds all between them, none of it farther than the farthest
        // corner.
        tile.seen
            .iter()
            .take_while(|print| print.nearest_m <= hit.crossing.t)
            .all(|print| print.primitive == hit.primitive || !before_face(print.primitive))
            .then_some(hit)
    }

    /// The nearest hit of a ray through this pixel of the tile.
    pub(super) fn first(&self, ray: &Ray, tile: &Tile, column: usize, row: usize) -> Option<Hit> {
        let mut best: Option<Hit> = None;
        let mut t_max = f64::INFINITY;
        for print in &tile.seen {
            if print.nearest_m > t_max {
                break;
            }
            if !print.window[0].contains(&column) || !print.window[1].contains(&row) {
                continue;
            }
            let primitive = print.primitive;
            let shape = &self.scene.primitives()[primitive].shape;
            if let Some(crossing) = shape.crossing(ray, LIFT, t_max) {
                t_max = crossing.t;
                best = Some(Hit {
                    crossing,
                    primitive,
                });
            }
        }
        best
    }
}
