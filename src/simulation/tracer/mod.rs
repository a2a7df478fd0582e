//! A ray tracer for small scenes: one area lamp with soft shadows, sky light with ambient occlusion, mirrors, and glass
//! that refracts by Snell's law and reflects by Fresnel's. No caustics: light that glass bends onto other things is
//! left out, glass only dims it.
//!
//! In: a [`Scene`], a camera. Out: linear radiance, depth along the optical axis (metres), the object in every pixel.
//! One ray through each pixel's centre gives depth and object; edges and strong contrasts get more for colour. How
//! much light a point gets does not depend on who looks: cameras side by side look for it once.

mod edges;
mod flat;
mod light;
mod shade;
mod tiles;

use std::{collections::HashMap, ops::Range};

use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

use self::{
    edges::{First, Samples},
    light::{Face, Lit, UNLIT},
    shade::Paint,
    tiles::{Pyramid, TILE, Tile, overlap, window_of},
};
pub use self::{light::LitView, shade::refracted};
use super::{
    scene::{Finish, Hit, ObjectId, Primitive, Scene},
    shapes::{Bounds, Crossing, Ray, Shape, within},
    texture::Rgb,
};
use crate::{
    isa::Isa,
    lanes::{LANES, members},
    model::{camera::Intrinsics, pose::Pose},
};

/// Metres by which a secondary ray leaves its surface.
const LIFT: f64 = 1e-7;
/// A round lamp below the ceiling.
#[derive(Debug, Clone)]
pub struct Lamp {
    pub center: Point3<f64>,
    pub radius: f64,
    /// On a surface that faces it at `reference_m`.
    pub irradiance: Rgb,
    pub reference_m: f64,
}

/// What lights the room.
#[derive(Debug, Clone)]
pub struct Lighting {
    pub lamp: Lamp,
    /// Light from above and, weaker, from everywhere.
    pub sky: Rgb,
    pub ground: Rgb,
    /// A window: direction towards it and irradiance, without shadows.
    pub window: (Vector3<f64>, Rgb),
}

impl Default for Lighting {
    fn default() -> Self {
        Self {
            lamp: Lamp {
                center: Point3::new(0.75, -0.35, 2.55),
                radius: 0.17,
                irradiance: [0.78, 0.70, 0.58],
                reference_m: 2.0,
            },
            sky: [0.34, 0.36, 0.40],
            ground: [0.16, 0.14, 0.12],
            window: (
                Vector3::new(-0.75, -0.5, 0.45).normalize(),
                [0.17, 0.20, 0.25],
            ),
        }
    }
}

/// What one camera would record without noise; row by row.
#[derive(Debug, Clone, PartialEq)]
pub struct Rendering {
    /// Linear, 1 is white paper in full light.
    pub radiance: Vec<Rgb>,
    /// Along the optical axis to the first surface, glass included; 0 = nothing there.
    pub depth_m: Vec<f32>,
    /// To the first surface that is not glass: what stereo and depth cameras tend to see.
    pub depth_through_glass_m: Vec<f32>,
    pub object: Vec<ObjectId>,
}

/// Renders a scene; rows in parallel on rayon's current pool.
#[derive(Debug, Clone)]
pub struct Tracer<'a> {
    pub scene: &'a Scene,
    pub lighting: &'a Lighting,
}

/// Reused per tile.
struct Scratch {
    isa: Isa,
    casters: Vec<u32>,
    paints: Vec<Option<Paint>>,
    seen: Vec<Seen>,
    /// Light on what is seen in mirrors and through glass, by face and place; of one row, or band, of pixels, so that it
    /// does not depend on which of them a thread takes.
    beyond: HashMap<(Face, [i32; 3]), Lit>,
}

impl Scratch {
    fn new(isa: Isa) -> Self {
        Self {
            isa,
            casters: Vec::new(),
            paints: Vec::new(),
            seen: Vec::new(),
            beyond: HashMap::new(),
        }
    }
}

/// A pixel of a band, the ray through its centre, the cosine that turns its length into depth, and what it meets.
type Seen = (usize, Path, f64, Option<Hit>);

/// A row of tiles, and those of its pixels that mirror, or let light through.
struct Band {
    tiles: Vec<Tile>,
    shiny: Vec<(usize, Path, Option<Hit>, Option<Paint>)>,
}

/// A ray on its way.
#[derive(Clone, Copy)]
struct Path {
    ray: Ray,
    bounces: u32,
    /// Metres so far.
    travelled: f64,
    /// Pixel width, radians.
    spread: f64,
    /// Its part in the pixel, 0..1.
    weight: f32,
}

/// What is known of the light on a ray's end before it is looked for.
#[derive(Clone, Copy)]
struct Near<'a> {
    /// The light itself.
    lit: Option<Lit>,
    /// The light that a camera near by sees.
    view: Option<&'a LitView>,
    /// The surface itself.
    paint: Option<Paint>,
}

/// Where a camera's rays start and what is added to their direction for each pixel.
struct Eye {
    origin: Point3<f64>,
    /// Through image position (0, 0); unit depth.
    corner: Vector3<f64>,
    across: Vector3<f64>,
    down: Vector3<f64>,
    /// Width of a pixel at unit depth.
    pixel: f64,
}

impl Eye {
    fn new(camera: &Intrinsics, world_from_camera: &Pose) -> Self {
        let rotation = world_from_camera.rotation;
        Self {
            origin: Point3::from(world_from_camera.translation.vector),
            corner: rotation * camera.unproject(0.0, 0.0, 1.0).coords,
            across: rotation * Vector3::new(1.0 / camera.fx, 0.0, 0.0),
            down: rotation * Vector3::new(0.0, 1.0 / camera.fy, 0.0),
            pixel: 1.0 / camera.fx,
        }
    }

    /// Direction through image position `(u, v)`, of unit depth.
    fn towards(&self, u: f64, v: f64) -> Vector3<f64> {
        self.corner + self.across * u + self.down * v
    }

    /// [`Self::ray`] at its start.
    fn path(&self, u: f64, v: f64) -> (Path, f64) {
        let (ray, cos) = self.ray(u, v);
        let path = Path {
            ray,
            bounces: 0,
            travelled: 0.0,
            spread: cos * self.pixel,
            weight: 1.0,
        };
        (path, cos)
    }

    /// Ray through image position `(u, v)` and the cosine that turns its length into depth.
    fn ray(&self, u: f64, v: f64) -> (Ray, f64) {
        let direction = self.towards(u, v);
        let cos = direction.norm().recip();
        let ray = Ray {
            origin: self.origin,
            direction: direction * cos,
        };
        (ray, cos)
    }
}

/// Ray through image position `(u, v)` and the cosine that turns its length into depth.
pub fn camera_ray(camera: &Intrinsics, world_from_camera: &Pose, u: f64, v: f64) -> (Ray, f64) {
    Eye::new(camera, world_from_camera).ray(u, v)
}

impl Tracer<'_> {
    /// Renders what a camera sees.
    pub fn render(&self, camera: &Intrinsics, world_from_camera: &Pose) -> Rendering {
        self.render_beside(camera, world_from_camera, None).0
    }

    /// Renders what a camera sees. The light on what the camera `beside` it, if any, sees as well is taken from there.
    pub fn render_beside(
        &self,
        camera: &Intrinsics,
        world_from_camera: &Pose,
        beside: Option<&LitView>,
    ) -> (Rendering, LitView) {
        let width = camera.width;
        let pixels = camera.pixels();
        let isa = Isa::detect();
        let prints = self.footprints(camera, world_from_camera);
        let mut rendering = Rendering {
            radiance: vec![[0.0; 3]; pixels],
            depth_m: vec![0.0; pixels],
            depth_through_glass_m: vec![0.0; pixels],
            object: vec![ObjectId::ROOM; pixels],
        };
        let mut lit = vec![UNLIT; pixels];
        let eye = Eye::new(camera, world_from_camera);
        let bands: Vec<Band> = rendering
            .radiance
            .par_chunks_mut(width * TILE)
            .zip(rendering.depth_m.par_chunks_mut(width * TILE))
            .zip(rendering.depth_through_glass_m.par_chunks_mut(width * TILE))
            .zip(rendering.object.par_chunks_mut(width * TILE))
            .zip(lit.par_chunks_mut(width * TILE))
            .enumerate()
            .map_init(
                || Scratch::new(isa),
                |scratch, (band, ((((radiance, depth), through), object), lit))| {
                    scratch.beyond.clear();
                    let top = band * TILE;
                    let height = radiance.len() / width;
                    let rows = top..top + height;
                    let band: Vec<_> = prints
                        .iter()
                        .filter(|print| overlap(&print.window[1], &rows))
                        .collect();
                    let mut tiles = Vec::with_capacity(width.div_ceil(TILE));
                    let mut shiny = Vec::new();
                    for left in (0..width).step_by(TILE) {
                        let right = (left + TILE).min(width);
                        let frame = Pyramid::over(
                            camera,
                            world_from_camera,
                            left..right,
                            top..top + height,
                        );
                        let mut tile = Tile::over(&band, &(left..right), |print| {
                            let primitive = print.primitive;
                            frame.may_hold(&self.scene.bounds()[primitive]).then(|| {
                                let shape = &self.scene.primitives()[primitive].shape;
                                frame.nearest_m(shape).max(print.nearest_m)
                            })
                        });
                        let mut seen = std::mem::take(&mut scratch.seen);
                        seen.clear();
                        for row in 0..height {
                            for column in left..right {
                                let (u, v) = (column, top + row);
                                let (path, cos) = eye.path(u as f64, v as f64);
                                seen.push((row * width + column, path, cos, None));
                            }
                        }
                        self.look(isa, &tile, &mut seen, left..right, rows.clone());
                        self.light(&mut tile, &seen, beside, lit, right - left, scratch);
                        let mut paints = std::mem::take(&mut scratch.paints);
                        let painted = self.paint_flat(isa, &seen, lit, radiance);
                        self.paint(isa, &seen, painted, &mut paints);
                        let pixels = seen.iter().zip(&paints).enumerate();
                        for (index, (&(at, path, cos, hit), &paint)) in pixels {
                            if let Some(hit) = hit
                                && painted >> index & 1 == 1
                            {
                                depth[at] = (hit.crossing.t * cos) as f32;
                                through[at] = depth[at];
                                object[at] = self.scene.primitives()[hit.primitive].object;
                                continue;
                            }
                            let matte = hit.zip(paint).filter(|(hit, _)| {
                                let material = &self.scene.primitives()[hit.primitive].material;
                                material.finish == Finish::Matte
                            });
                            if let Some((hit, paint)) = matte {
                                let point = path.ray.at(hit.crossing.t);
                                radiance[at] = self.diffuse(&point, &paint, lit[at]);
                                depth[at] = (hit.crossing.t * cos) as f32;
                                through[at] = depth[at];
                                object[at] = self.scene.primitives()[hit.primitive].object;
                                continue;
                            }
                            shiny.push((at, path, hit, paint));
                            let Some(hit) = hit else {
                                continue;
                            };
                            let primitive = &self.scene.primitives()[hit.primitive];
                            depth[at] = (hit.crossing.t * cos) as f32;
                            object[at] = primitive.object;
                            through[at] = if primitive.is_glass() {
                                self.scene
                                    .nearest(&path.ray, hit.crossing.t, f64::INFINITY, |p| {
                                        !p.is_glass()
                                    })
                                    .map_or(0.0, |hit| (hit.crossing.t * cos) as f32)
                            } else {
                                depth[at]
                            };
                        }
                        scratch.paints = paints;
                        scratch.seen = seen;
                        tiles.push(tile);
                    }
                    Band { tiles, shiny }
                },
            )
            .collect();
        let view = LitView::new(lit, rendering.depth_m.clone(), *camera, world_from_camera);
        rendering
            .radiance
            .par_chunks_mut(width * TILE)
            .zip(&bands)
            .enumerate()
            .for_each_init(
                || Scratch::new(isa),
                |scratch, (number, (radiance, band))| {
                    scratch.beyond.clear();
                    for &(at, ref path, hit, paint) in &band.shiny {
                        let near = Near {
                            lit: Some(view.lit[number * width * TILE + at]),
                            view: Some(&view),
                            paint,
                        };
                        radiance[at] = self.shade(path, hit.as_ref(), near, scratch);
                    }
                },
            );
        let radiance = rendering.radiance.clone();
        let first = First {
            camera,
            object: &rendering.object,
            radiance: &radiance,
            view: &view,
        };
        let samples = Samples::new(&eye);
        rendering
            .radiance
            .par_chunks_mut(width)
            .enumerate()
            .for_each_init(
                || Scratch::new(isa),
                |scratch, (row, radiance)| {
                    scratch.beyond.clear();
                    for (column, radiance) in radiance.iter_mut().enumerate() {
                        let tile = &bands[row / TILE].tiles[column / TILE];
                        let place = (column, row);
                        if let Some(mixed) = self.edge(&first, &samples, tile, place, scratch) {
                            *radiance = mixed;
                        }
                    }
                },
            );
        (rendering, view)
    }
}

impl Tracer<'_> {
    /// Finds what each ray of a tile meets.
    fn look(
        &self,
        isa: Isa,
        tile: &Tile,
        seen: &mut [Seen],
        columns: Range<usize>,
        rows: Range<usize>,
    ) {
        let (across, last) = (columns.len(), seen.len() - 1);
        let flat = self.flat(
            tile,
            [
                (0, columns.start, rows.start),
                (across - 1, columns.end - 1, rows.start),
                (last + 1 - across, columns.start, rows.end - 1),
                (last, columns.end - 1, rows.end - 1),
            ]
            .map(|(index, column, row)| (&seen[index].1.ray, column, row)),
        );
        let face = flat.and_then(|hit| match &self.scene.primitives()[hit.primitive].shape {
            Shape::Solid(solid) => Some((solid, hit)),
            _ => None,
        });
        match face {
            Some((solid, hit)) => {
                for (_, path, _, met) in seen {
                    let crossing = Crossing {
                        t: solid.on_plane_of(hit.crossing.part, &path.ray),
                        ..hit.crossing
                    };
                    *met = Some(Hit { crossing, ..hit });
                }
            }
            None => {
                for group in seen.chunks_mut(LANES) {
                    self.look_at_once(isa, tile, group);
                }
            }
        }
    }

    /// As [`Self::first`] for at most [`LANES`] rays from one point.
    fn look_at_once(&self, isa: Isa, tile: &Tile, group: &mut [Seen]) {
        let ray = |lane: usize| &group[lane.min(group.len() - 1)].1.ray;
        let origin = ray(0).origin;
        let mut directions = [[0.0; LANES]; 3];
        for lane in 0..LANES {
            for axis in 0..3 {
                directions[axis][lane] = ray(lane).direction[axis] as f32;
            }
        }
        let mut nearest = [f32::INFINITY; LANES];
        for print in &tile.seen {
            let farthest = nearest[..group.len()].iter().copied().fold(0.0, f32::max);
            if print.nearest_m > f64::from(farthest) {
                break;
            }
            let shape = &self.scene.primitives()[print.primitive].shape;
            let mut lanes = 0;
            within(isa, shape, &origin, &directions, &nearest, &mut lanes);
            for lane in members(lanes) {
                let Some((_, path, _, met)) = group.get_mut(lane) else {
                    break;
                };
                let t_max = met.map_or(f64::INFINITY, |hit| hit.crossing.t);
                if let Some(crossing) = shape.crossing(&path.ray, LIFT, t_max) {
                    nearest[lane] = crossing.t as f32;
                    *met = Some(Hit {
                        crossing,
                        primitive: print.primitive,
                    });
                }
            }
        }
    }
}

/// Nearest depth along the optical axis of the primitives alone, metres; infinite where there is none. Used for the
/// silhouette of an object that stands, or would stand, in the scene.
pub fn depth_alone(
    primitives: &[Primitive],
    camera: &Intrinsics,
    world_from_camera: &Pose,
) -> Vec<f32> {
    let mut depth = vec![f32::INFINITY; camera.pixels()];
    let bounds = primitives.iter().fold(Bounds::EMPTY, |bounds, primitive| {
        bounds.joined(&primitive.shape.bounds())
    });
    let [columns, rows] = window_of(&bounds, camera, &world_from_camera.inverse());
    let eye = Eye::new(camera, world_from_camera);
    for row in rows {
        for column in columns.clone() {
            let (ray, cos) = eye.ray(column as f64, row as f64);
            depth[row * camera.width + column] = primitives
                .iter()
                .filter_map(|primitive| primitive.shape.crossing(&ray, LIFT, f64::INFINITY))
                .map(|crossing| crossing.t)
                .min_by(f64::total_cmp)
                .map_or(f32::INFINITY, |t| (t * cos) as f32);
        }
    }
    depth
}
