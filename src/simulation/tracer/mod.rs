//! A ray tracer for small scenes: one area lamp with soft shadows, sky light with ambient occlusion, mirrors, and glass
//! that refracts by Snell's law and reflects by Fresnel's. No caustics: light that glass bends onto other things is
//! left out, glass only dims it.
//!
//! In: a [`Scene`], a camera. Out: linear radiance, depth along the optical axis (metres), the object in every pixel.
//! One ray through each pixel's centre gives depth and object; edges and strong contrasts get more for colour. How
//! much light a point gets does not depend on who looks: cameras side by side look for it once.

mod light;
mod shade;
mod tiles;

use std::{collections::HashMap, ops::Range};

use arrayvec::ArrayVec;
use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

pub use self::{light::LitView, shade::refracted};
use self::{
    light::{Face, Lit, UNLIT, face_of},
    shade::{Paint, plus},
    tiles::{Pyramid, TILE, Tile, overlap, window_of},
};
use super::{
    scene::{Finish, Hit, ObjectId, Primitive, Scene},
    shapes::{Bounds, Crossing, Ray, Shape},
    texture::{Rgb, scaled},
};
use crate::{
    isa::Isa,
    model::{camera::Intrinsics, pose::Pose},
};

/// Metres by which a secondary ray leaves its surface.
const LIFT: f64 = 1e-7;
/// Contrast between neighbouring surfaces of one object (relative to the brighter) above which a pixel is sampled again.
const CONTRAST: f32 = 0.12;
/// Where in such a pixel it is sampled again, besides its centre: five even steps both across and down, none off the
/// middle. The first two do as well.
const SAMPLES: [(f64, f64); 4] = [(0.4, -0.2), (-0.4, 0.2), (0.2, 0.4), (-0.2, -0.4)];

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
    /// What may be in the light's way.
    tile: Option<&'a Tile>,
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
}

impl Eye {
    fn new(camera: &Intrinsics, world_from_camera: &Pose) -> Self {
        let rotation = world_from_camera.rotation;
        Self {
            origin: Point3::from(world_from_camera.translation.vector),
            corner: rotation * camera.unproject(0.0, 0.0, 1.0).coords,
            across: rotation * Vector3::new(1.0 / camera.fx, 0.0, 0.0),
            down: rotation * Vector3::new(0.0, 1.0 / camera.fy, 0.0),
        }
    }

    /// Ray through image position `(u, v)` and the cosine that turns its length into depth.
    fn ray(&self, u: f64, v: f64) -> (Ray, f64) {
        let direction = self.corner + self.across * u + self.down * v;
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
        let path = |u: f64, v: f64| {
            let (ray, cos) = eye.ray(u, v);
            let path = Path {
                ray,
                bounces: 0,
                travelled: 0.0,
                spread: cos / camera.fx,
                weight: 1.0,
            };
            (path, cos)
        };
        let bands: Vec<Vec<Tile>> = rendering
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
                                let (path, cos) = path(u as f64, v as f64);
                                seen.push((row * width + column, path, cos, None));
                            }
                        }
                        self.look(&tile, &mut seen, left..right, rows.clone());
                        self.light(&mut tile, &seen, beside, lit, right - left, scratch);
                        let mut paints = std::mem::take(&mut scratch.paints);
                        self.paint(isa, &seen, &mut paints);
                        for (&(at, path, cos, hit), &paint) in seen.iter().zip(&paints) {
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
                            let near = Near {
                                lit: Some(lit[at]),
                                view: beside,
                                tile: None,
                                paint,
                            };
                            radiance[at] = self.shade(&path, hit.as_ref(), near, scratch);
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
                    tiles
                },
            )
            .collect();
        let first = rendering.radiance.clone();
        let view = LitView::new(lit, rendering.depth_m.clone(), *camera, world_from_camera);
        let lit = &view.lit;
        rendering
            .radiance
            .par_chunks_mut(width)
            .enumerate()
            .for_each_init(
                || Scratch::new(isa),
                |scratch, (row, radiance)| {
                    scratch.beyond.clear();
                    for (column, radiance) in radiance.iter_mut().enumerate() {
                        let more =
                            more_samples(camera, &rendering.object, lit, &first, column, row);
                        if more == 0 {
                            continue;
                        }
                        let here = row * width + column;
                        let around = [
                            Some(here),
                            (column > 0).then(|| here - 1),
                            (column + 1 < width).then_some(here + 1),
                            (row > 0).then(|| here.wrapping_sub(width)),
                            (row + 1 < camera.height).then_some(here + width),
                        ];
                        let tile = &bands[row / TILE][column / TILE];
                        let clear = around
                            .into_iter()
                            .flatten()
                            .all(|there| lit[there].face != UNLIT.face);
                        let mut nearby = ArrayVec::<usize, 5>::new();
                        for at in around.into_iter().flatten() {
                            let primitive = lit[at].face.0 as usize;
                            if !nearby.contains(&primitive) {
                                nearby.push(primitive);
                            }
                        }
                        // Glass is looked through again for every sample.
                        let offsets = &SAMPLES[..if clear { more } else { 2 }];
                        let share = 1.0 / (offsets.len() + 1) as f32;
                        let mut sum = scaled(*radiance, share);
                        for &(du, dv) in offsets {
                            let (path, _) = path(column as f64 + du, row as f64 + dv);
                            // Where there is no glass, what is seen here is seen at one of these pixels.
                            let hit = if clear {
                                self.first_of(&path.ray, &nearby)
                            } else {
                                None
                            }
                            .or_else(|| self.first(&path.ray, tile, column, row));
                            // What the pixel or one beside it shows of the same face: its texture and light are averaged
                            // over a pixel already, and do not differ much.
                            let known = hit.and_then(|hit| {
                                around
                                    .into_iter()
                                    .flatten()
                                    .find(|&there| lit[there].face == face_of(&hit))
                            });
                            let near = Near {
                                lit: None,
                                view: Some(&view),
                                tile: Some(tile),
                                paint: None,
                            };
                            let colour = known.map_or_else(
                                || self.shade(&path, hit.as_ref(), near, scratch),
                                |there| first[there],
                            );
                            sum = plus(sum, scaled(colour, share));
                        }
                        *radiance = sum;
                    }
                },
            );
        (rendering, view)
    }
}

impl Tracer<'_> {
    /// Finds what each ray of a tile meets.
    fn look(&self, tile: &Tile, seen: &mut [Seen], columns: Range<usize>, rows: Range<usize>) {
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
                let places = rows.flat_map(|row| columns.clone().map(move |column| (column, row)));
                for ((_, path, _, met), (column, row)) in seen.iter_mut().zip(places) {
                    *met = self.first(&path.ray, tile, column, row);
                }
            }
        }
    }
}

/// How many more samples a pixel needs: none where it is like its neighbours, all of [`SAMPLES`] where one of them has
/// another colour, two where one shows another object of about the same colour.
fn more_samples(
    camera: &Intrinsics,
    object: &[ObjectId],
    lit: &[Lit],
    radiance: &[Rgb],
    column: usize,
    row: usize,
) -> usize {
    let width = camera.width;
    let here = row * width + column;
    let needed = |there: usize| {
        // Textures are averaged over the pixel already; what is seen through glass is not.
        if lit[here].face == lit[there].face && lit[here].face != UNLIT.face {
            return 0;
        }
        let (a, b) = (radiance[here], radiance[there]);
        let contrast = (0..3).any(|i| (a[i] - b[i]).abs() > CONTRAST * a[i].max(b[i]).max(0.05));
        match (contrast, object[here] != object[there]) {
            (true, _) => SAMPLES.len(),
            (false, true) => 2,
            (false, false) => 0,
        }
    };
    [
        (column > 0).then(|| here - 1),
        (column + 1 < width).then_some(here + 1),
        (row > 0).then(|| here - width),
        (row + 1 < camera.height).then_some(here + width),
    ]
    .into_iter()
    .flatten()
    .map(needed)
    .max()
    .unwrap_or(0)
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
