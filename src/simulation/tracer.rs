//! A ray tracer for small scenes: one area lamp with soft shadows, sky light with ambient occlusion, mirrors, and glass
//! that refracts by Snell's law and reflects by Fresnel's. No caustics: light that glass bends onto other things is
//! left out, glass only dims it.
//!
//! In: a [`Scene`], a camera. Out: linear radiance, depth along the optical axis (metres), the object in every pixel.
//! One ray through each pixel's centre gives depth and object; edges and strong contrasts get two more for colour.

use std::ops::Range;

use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

use super::{
    scene::{Finish, Hit, Light, ObjectId, Primitive, Scene},
    shapes::{Bounds, Ray, Shape},
    texture::{Rgb, Spot, mixed, rgb, scaled},
};
use crate::model::{camera::Intrinsics, pose::Pose};

/// Metres by which a secondary ray leaves its surface.
const LIFT: f64 = 1e-7;
const MAX_BOUNCES: u32 = 9;
const LAMP_SAMPLES: usize = 9;
const SKY_SAMPLES: usize = 5;
/// Where a sample is one of several of a pixel, or seen in a mirror or through glass.
const FEW_LAMP_SAMPLES: usize = 4;
const FEW_SKY_SAMPLES: usize = 3;
/// Things farther than this do not dim the sky light, metres.
const SKY_REACH: f64 = 0.26;
/// Share of light that one pane of glass lets through to what is in its shadow.
const GLASS_SHADOW: f32 = 0.9;
/// Mirrored light of a smaller part in the pixel is taken from the room at large.
const FAINT: f32 = 0.06;
/// Of a smaller part in the pixel, shadows are not looked for.
const WEAK: f32 = 0.3;
/// Contrast between neighbouring surfaces of one object (relative to the brighter) above which a pixel is sampled again.
const CONTRAST: f32 = 0.12;
/// Side of the squares of pixels that share one search for what may be seen or shade there.
const TILE: usize = 8;

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

/// Reused per row.
#[derive(Default)]
struct Scratch {
    casters: Vec<u32>,
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
    /// Turns the sample patterns, 0..1.
    twist: f64,
    /// One of several samples of its pixel.
    few: bool,
    /// Its part in the pixel, 0..1.
    weight: f32,
}

/// How much of the sky and of the lamp a point on a surface sees, 0..1. Light changes slowly over a surface, so
/// neighbouring pixels on the same face of the same primitive share it.
#[derive(Clone, Copy)]
struct Lit {
    /// Primitive and part.
    face: (usize, usize),
    sky: f32,
    lamp: f32,
}

/// Nothing, or glass, which has no light of its own.
const UNLIT: Lit = Lit {
    face: (usize::MAX, 0),
    sky: 1.0,
    lamp: 1.0,
};

/// Lamp shares that differ by more are the edge of a shadow, where each pixel is looked at.
const SHADOW_EDGE: f32 = 0.15;

/// Shares of the lamp and of the sky that differ by less, across a tile, are looked for at few of its points.
const LEVEL: [f32; 2] = [0.12, 0.16];

/// Pixels that a primitive's bounds cover, columns and rows, and how near they come.
struct Footprint {
    primitive: usize,
    window: [Range<usize>; 2],
    nearest_m: f64,
}

fn overlap(a: &Range<usize>, b: &Range<usize>) -> bool {
    a.start < b.end && b.start < a.end
}

/// What matters in a square of pixels.
struct Tile {
    /// Primitives that may be seen there and the least distance at which they may be, nearest first.
    seen: Vec<(usize, f64)>,
    /// Holds every point seen through a pixel's centre.
    reach: Bounds,
    /// What may hide the lamp, or some of the sky, from points in `reach`.
    lamp: Vec<u32>,
    sky: Vec<u32>,
}

impl Tile {
    fn over(
        band: &[&Footprint],
        columns: &Range<usize>,
        nearest_m: impl Fn(&Footprint) -> Option<f64>,
    ) -> Self {
        let mut seen: Vec<_> = band
            .iter()
            .filter(|print| overlap(&print.window[0], columns))
            .filter_map(|print| Some((print.primitive, nearest_m(print)?)))
            .collect();
        seen.sort_by(|a, b| a.1.total_cmp(&b.1));
        Self {
            seen,
            reach: Bounds::EMPTY,
            lamp: Vec::new(),
            sky: Vec::new(),
        }
    }
}

/// All rays through a square of pixels and a pixel around it.
struct Pyramid {
    eye: Point3<f64>,
    /// Its four edges: z = 1 in the camera's frame, directions of the world.
    edges: [Vector3<f64>; 4],
    /// Of its four sides, pointing outwards.
    normals: [Vector3<f64>; 4],
}

impl Pyramid {
    fn over(
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
    fn nearest_m(&self, shape: &Shape) -> f64 {
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
    fn may_hold(&self, bounds: &Bounds) -> bool {
        let center = bounds.center() - self.eye;
        let half = bounds.half();
        self.normals
            .iter()
            .all(|normal| normal.dot(&center) <= normal.abs().dot(&half))
    }
}

/// Ray through image position `(u, v)` and the cosine that turns its length into depth.
pub fn camera_ray(camera: &Intrinsics, world_from_camera: &Pose, u: f64, v: f64) -> (Ray, f64) {
    let in_camera = camera.unproject(u, v, 1.0).coords;
    let length = in_camera.norm();
    let ray = Ray {
        origin: Point3::from(world_from_camera.translation.vector),
        direction: world_from_camera.rotation * (in_camera / length),
    };
    (ray, 1.0 / length)
}

/// Direction after refraction at a surface whose `normal` faces against `direction`; `None`: total reflection.
/// `ratio` is the index on this side over the index beyond (Snell: sin beyond = ratio * sin here).
pub fn refracted(
    direction: &Vector3<f64>,
    normal: &Vector3<f64>,
    ratio: f64,
) -> Option<Vector3<f64>> {
    let cos = -direction.dot(normal);
    let sin2_beyond = ratio * ratio * (1.0 - cos * cos);
    (sin2_beyond <= 1.0)
        .then(|| direction * ratio + normal * (ratio * cos - (1.0 - sin2_beyond).sqrt()))
}

/// Unpolarised share of light that a boundary reflects (Fresnel), from the cosines on both sides.
fn fresnel(cos_here: f64, cos_beyond: f64, ratio: f64) -> f32 {
    let parallel = (cos_here - ratio * cos_beyond) / (cos_here + ratio * cos_beyond);
    let crossed = (ratio * cos_here - cos_beyond) / (ratio * cos_here + cos_beyond);
    (0.5 * (parallel * parallel + crossed * crossed)) as f32
}

fn mirrored(direction: &Vector3<f64>, normal: &Vector3<f64>) -> Vector3<f64> {
    direction - normal * (2.0 * direction.dot(normal))
}

fn plus(a: Rgb, b: Rgb) -> Rgb {
    std::array::from_fn(|i| a[i] + b[i])
}

fn times(a: Rgb, b: Rgb) -> Rgb {
    std::array::from_fn(|i| a[i] * b[i])
}

/// Points spread evenly over the unit disc: a sunflower's seeds, turned by `twist` of a full turn.
fn seed_points<const N: usize>(twist: f64) -> [(f64, f64); N] {
    const GOLDEN_ANGLE: f64 = 2.399_963_229_728_653;
    let (step_sin, step_cos) = GOLDEN_ANGLE.sin_cos();
    let (mut sin, mut cos) = (twist * std::f64::consts::TAU).sin_cos();
    std::array::from_fn(|index| {
        let radius = ((index as f64 + 0.5) / N as f64).sqrt();
        let point = (radius * cos, radius * sin);
        (sin, cos) = (
            sin * step_cos + cos * step_sin,
            cos * step_cos - sin * step_sin,
        );
        point
    })
}

fn basis(normal: &Vector3<f64>) -> (Vector3<f64>, Vector3<f64>) {
    let helper = if normal.z.abs() < 0.9 {
        Vector3::z()
    } else {
        Vector3::x()
    };
    let right = helper.cross(normal).normalize();
    (right, normal.cross(&right))
}

/// A number in 0..1 that differs between neighbouring pixels like noise.
fn twist_of(column: usize, row: usize) -> f64 {
    // Jimenez's interleaved gradient noise.
    (52.982_918_9 * (0.067_110_56 * column as f64 + 0.005_837_15 * row as f64).fract()).fract()
}

impl Tracer<'_> {
    /// Renders what a camera sees.
    pub fn render(&self, camera: &Intrinsics, world_from_camera: &Pose) -> Rendering {
        let width = camera.width;
        let pixels = camera.pixels();
        let prints = self.footprints(camera, world_from_camera);
        let mut rendering = Rendering {
            radiance: vec![[0.0; 3]; pixels],
            depth_m: vec![0.0; pixels],
            depth_through_glass_m: vec![0.0; pixels],
            object: vec![ObjectId::ROOM; pixels],
        };
        let mut lit = vec![UNLIT; pixels];
        let path = |u: f64, v: f64, twist: f64, few: bool| {
            let (ray, cos) = camera_ray(camera, world_from_camera, u, v);
            let path = Path {
                ray,
                bounces: 0,
                travelled: 0.0,
                spread: 1.0 / camera.fx,
                twist,
                few,
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
                Scratch::default,
                |scratch, (band, ((((radiance, depth), through), object), lit))| {
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
                        let mut seen = Vec::with_capacity(TILE * TILE);
                        for row in 0..height {
                            for column in left..right {
                                let (u, v) = (column, top + row);
                                let (path, cos) = path(u as f64, v as f64, twist_of(u, v), false);
                                let hit = self.first(&path.ray, &tile);
                                seen.push((row * width + column, path, cos, hit));
                            }
                        }
                        self.look_around(&mut tile, &seen);
                        self.light(&tile, &seen, lit, width, scratch);
                        for (at, path, cos, hit) in seen {
                            radiance[at] =
                                self.shade(&path, hit.as_ref(), Some(lit[at]), None, scratch);
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
                        tiles.push(tile);
                    }
                    tiles
                },
            )
            .collect();
        let first = rendering.radiance.clone();
        rendering
            .radiance
            .par_chunks_mut(width)
            .enumerate()
            .for_each_init(Scratch::default, |scratch, (row, radiance)| {
                for (column, radiance) in radiance.iter_mut().enumerate() {
                    if !rough(camera, &rendering.object, &lit, &first, column, row) {
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
                    let mut sum = scaled(*radiance, 1.0 / 3.0);
                    for (index, (du, dv)) in [(-0.34, 0.17), (0.17, -0.34)].into_iter().enumerate()
                    {
                        let twist = (twist_of(column, row) + index as f64 * 0.23).fract();
                        let (path, _) = path(column as f64 + du, row as f64 + dv, twist, true);
                        let hit = self.first(&path.ray, tile);
                        // What the pixel or one beside it shows of the same face: its texture and light are averaged
                        // over a pixel already, and do not differ much. Glass is looked through again.
                        let known = hit.and_then(|hit| {
                            around.into_iter().flatten().find(|&there| {
                                lit[there].face == (hit.primitive, hit.crossing.part)
                            })
                        });
                        let colour = known.map_or_else(
                            || self.shade(&path, hit.as_ref(), None, Some(tile), scratch),
                            |there| first[there],
                        );
                        sum = plus(sum, scaled(colour, 1.0 / 3.0));
                    }
                    *radiance = sum;
                }
            });
        rendering
    }

    /// Where each primitive can be seen in the image at all.
    fn footprints(&self, camera: &Intrinsics, world_from_camera: &Pose) -> Vec<Footprint> {
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

    /// The nearest hit of a ray through the tile.
    fn first(&self, ray: &Ray, tile: &Tile) -> Option<Hit> {
        let mut best: Option<Hit> = None;
        let mut t_max = f64::INFINITY;
        for &(primitive, nearest_m) in &tile.seen {
            if nearest_m > t_max {
                break;
            }
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

    /// Finds what may shade any of the points that a tile sees.
    fn look_around(&self, tile: &mut Tile, seen: &[(usize, Path, f64, Option<Hit>)]) {
        tile.reach = Bounds::of(
            seen.iter()
                .filter_map(|(_, path, _, hit)| hit.map(|hit| path.ray.at(hit.crossing.t))),
        );
        if tile.reach.min.x > tile.reach.max.x {
            return;
        }
        // Room for the further samples of its pixels.
        let spare = Vector3::from_element(2e-3);
        tile.reach.min -= spare;
        tile.reach.max += spare;
        let center = tile.reach.center();
        let half = tile.reach.half();
        let lamp = &self.lighting.lamp;
        let axis = lamp.center - center;
        let length = axis.norm();
        let direction = axis / length;
        self.scene.casters(Light::Lamp, &mut tile.lamp, |bounds| {
            let grown = Bounds {
                min: bounds.min - half,
                max: bounds.max + half,
            };
            in_beam(&grown, &center, &direction, length, lamp.radius)
        });
        self.scene.casters(Light::Sky, &mut tile.sky, |bounds| {
            let apart = (bounds.center() - center).abs() - bounds.half() - half;
            apart.max() < SKY_REACH
        });
    }

    /// Finds the light on every point that a tile sees: exactly at every sixteenth pixel, at every fourth where those
    /// of the tile differ, and between these where the edge of a shadow is.
    fn light(
        &self,
        tile: &Tile,
        seen: &[(usize, Path, f64, Option<Hit>)],
        lit: &mut [Lit],
        width: usize,
        scratch: &mut Scratch,
    ) {
        let Some(&(origin, ..)) = seen.first() else {
            return;
        };
        let place = |at: usize| (at % width - origin % width, at / width - origin / width);
        let mut known = [[None::<Lit>; TILE]; TILE];
        for step in [4, 2, 1] {
            // The coarsest lattice is centred in the tile.
            let phase = step / 4 * 2;
            let on_lattice = |i: usize| i % step == phase;
            let before = known;
            for &(at, ref path, _, hit) in seen {
                let (column, row) = place(at);
                let Some(hit) = hit else {
                    continue;
                };
                if known[row][column].is_some() || !on_lattice(column) || !on_lattice(row) {
                    continue;
                }
                let face = (hit.primitive, hit.crossing.part);
                let shared = match step {
                    4 => None,
                    2 => shared(&before, face, (column, row), TILE, 3, LEVEL),
                    _ => shared(&before, face, (column, row), 1, 1, [SHADOW_EDGE, 1.0])
                        .or_else(|| shared(&before, face, (column, row), 2, 3, LEVEL)),
                };
                let light =
                    shared.unwrap_or_else(|| self.light_on(path, &hit, Some(tile), scratch));
                known[row][column] = Some(light);
                lit[at] = light;
            }
        }
    }

    fn light_on(&self, path: &Path, hit: &Hit, tile: Option<&Tile>, scratch: &mut Scratch) -> Lit {
        let primitive = &self.scene.primitives()[hit.primitive];
        if primitive.is_glass() {
            return UNLIT;
        }
        if path.weight < WEAK {
            return Lit {
                face: (hit.primitive, hit.crossing.part),
                sky: 0.85,
                lamp: 0.8,
            };
        }
        let point = path.ray.at(hit.crossing.t);
        let surface = primitive.shape.surface(&point, hit.crossing.part);
        let facing = path.ray.direction.dot(&surface.normal) < 0.0;
        let normal = if facing {
            surface.normal
        } else {
            -surface.normal
        };
        let own = (!primitive.hollow).then_some(hit.primitive as u32);
        // Seen in a mirror or through glass, fewer samples do.
        let few = path.few || path.bounces > 0;
        let sky = if few {
            Self::sky_share::<FEW_SKY_SAMPLES>
        } else {
            Self::sky_share::<SKY_SAMPLES>
        };
        let lamp = if few {
            Self::lamp_share::<FEW_LAMP_SAMPLES>
        } else {
            Self::lamp_share::<LAMP_SAMPLES>
        };
        Lit {
            face: (hit.primitive, hit.crossing.part),
            sky: sky(self, &point, &normal, own, path.twist, tile, scratch),
            lamp: if normal.dot(&(self.lighting.lamp.center - point)) > 0.0 {
                lamp(self, &point, own, path.twist, tile, scratch)
            } else {
                0.0
            },
        }
    }

    /// What may hide a light from a point: from the tile's choice if the point is among those it was made for.
    fn casters_at(
        &self,
        light: Light,
        point: &Point3<f64>,
        tile: Option<&Tile>,
        found: &mut Vec<u32>,
        may_hide: impl Fn(&Bounds) -> bool,
    ) {
        match tile.filter(|tile| tile.reach.contains(point)) {
            Some(tile) => {
                let list = match light {
                    Light::Lamp => &tile.lamp,
                    Light::Sky => &tile.sky,
                };
                found.clear();
                found.extend(
                    list.iter()
                        .filter(|&&index| may_hide(&self.scene.bounds()[index as usize])),
                );
            }
            None => self.scene.casters(light, found, may_hide),
        }
    }

    fn trace(&self, path: &Path, scratch: &mut Scratch) -> Rgb {
        let hit = self.scene.nearest(&path.ray, LIFT, f64::INFINITY, |_| true);
        self.shade(path, hit.as_ref(), None, None, scratch)
    }

    fn shade(
        &self,
        path: &Path,
        hit: Option<&Hit>,
        lit: Option<Lit>,
        tile: Option<&Tile>,
        scratch: &mut Scratch,
    ) -> Rgb {
        let Some(hit) = hit else {
            return self.surroundings(&path.ray.direction);
        };
        let primitive = &self.scene.primitives()[hit.primitive];
        match primitive.material.finish {
            Finish::Glass { index } => self.glass(path, hit, primitive, index, scratch),
            finish => {
                let lit = lit.unwrap_or_else(|| self.light_on(path, hit, tile, scratch));
                self.opaque(path, hit, primitive, finish, lit, scratch)
            }
        }
    }

    /// What is beyond everything: the ceiling with the lamp, and the rest of the room behind the robot.
    fn surroundings(&self, direction: &Vector3<f64>) -> Rgb {
        let up = direction.z as f32;
        let wall = mixed(rgb(0x8f8577), rgb(0xd8d2c4), (up * 2.0).clamp(0.0, 1.0));
        scaled(wall, 0.55 + 0.25 * up.max(0.0))
    }

    /// The lamp and the window as bright patches in a mirror.
    fn highlights(&self, from: &Point3<f64>, direction: &Vector3<f64>, softness: f64) -> Rgb {
        let lamp = &self.lighting.lamp;
        let to_lamp = lamp.center - from;
        let distance = to_lamp.norm();
        let patch = |cos: f64, radius: f64| {
            // Squared chord instead of the angle.
            let off = (2.0 * (1.0 - cos)).max(0.0).sqrt();
            ((1.0 - (off - radius) / softness).clamp(0.0, 1.0)) as f32
        };
        let lamp_patch = patch(to_lamp.dot(direction) / distance, lamp.radius / distance);
        let (towards, light) = &self.lighting.window;
        let window_patch = patch(towards.dot(direction), 0.16);
        plus(
            scaled(lamp.irradiance, lamp_patch * 14.0),
            scaled(*light, window_patch * 9.0),
        )
    }

    fn glass(
        &self,
        path: &Path,
        hit: &Hit,
        primitive: &Primitive,
        index: f64,
        scratch: &mut Scratch,
    ) -> Rgb {
        let direction = path.ray.direction;
        let point = path.ray.at(hit.crossing.t);
        let outward = primitive.shape.surface(&point, hit.crossing.part).normal
            * if primitive.hollow { -1.0 } else { 1.0 };
        let entering = direction.dot(&outward) < 0.0;
        let (normal, ratio) = if entering {
            (outward, 1.0 / index)
        } else {
            (-outward, index)
        };
        if path.bounces >= MAX_BOUNCES {
            return self.surroundings(&direction);
        }
        let onward = |direction: Vector3<f64>, share: f32| Path {
            ray: Ray {
                origin: point,
                direction,
            },
            bounces: path.bounces + 1,
            travelled: path.travelled + hit.crossing.t,
            weight: path.weight * share,
            ..*path
        };
        let reflection = mirrored(&direction, &normal);
        let Some(transmission) = refracted(&direction, &normal, ratio) else {
            return self.trace(&onward(reflection, 1.0), scratch);
        };
        let share = fresnel(-direction.dot(&normal), -transmission.dot(&normal), ratio);
        let through = scaled(
            self.trace(&onward(transmission, 1.0 - share), scratch),
            0.985 * (1.0 - share),
        );
        // Reflections inside the wall are many and faint: followed only where they are the view itself.
        if path.bounces > 1 || !entering {
            return plus(through, scaled(self.surroundings(&reflection), share));
        }
        let reflected = plus(
            self.trace(&onward(reflection, share), scratch),
            self.highlights(&point, &reflection, 0.08),
        );
        plus(through, scaled(reflected, share))
    }

    fn opaque(
        &self,
        path: &Path,
        hit: &Hit,
        primitive: &Primitive,
        finish: Finish,
        lit: Lit,
        scratch: &mut Scratch,
    ) -> Rgb {
        let direction = path.ray.direction;
        let point = path.ray.at(hit.crossing.t);
        let surface = primitive.shape.surface(&point, hit.crossing.part);
        let cos = -direction.dot(&surface.normal);
        let (normal, cos) = if cos < 0.0 {
            (-surface.normal, -cos)
        } else {
            (surface.normal, cos)
        };
        let travelled = path.travelled + hit.crossing.t;
        let colour = primitive.material.pattern.colour(&Spot {
            u: surface.u,
            v: surface.v,
            part: surface.part,
            point,
            // Between the short and the long side of the pixel's oblique print.
            footprint: travelled * path.spread / cos.max(0.1).sqrt(),
        });
        let lighting = self.lighting;
        let up = (0.5 + 0.5 * normal.z) as f32;
        let (towards, window) = &lighting.window;
        let sky = plus(
            mixed(lighting.ground, lighting.sky, up),
            scaled(*window, normal.dot(towards).max(0.0) as f32),
        );
        let lamp = &lighting.lamp;
        let to_lamp = lamp.center - point;
        let distance = to_lamp.norm();
        let facing = (normal.dot(&to_lamp) / distance).max(0.0);
        let falloff = ((lamp.reference_m / distance).powi(2) * facing) as f32;
        let light = plus(
            scaled(sky, lit.sky),
            scaled(lamp.irradiance, lit.lamp * falloff),
        );
        let diffuse = times(colour, light);
        let Finish::Glossy {
            reflectance,
            sharpness,
        } = finish
        else {
            return diffuse;
        };
        let share = reflectance
            + (1.0 - reflectance) * (1.0 - cos as f32).powi(5) * (sharpness / 200.0).min(1.0);
        let reflection = mirrored(&direction, &normal);
        let seen = if path.bounces < 2 && path.weight * share > FAINT {
            self.trace(
                &Path {
                    ray: Ray {
                        origin: point + normal * LIFT,
                        direction: reflection,
                    },
                    bounces: path.bounces + 2,
                    travelled,
                    spread: path.spread * 3.0,
                    weight: path.weight * share,
                    ..*path
                },
                scratch,
            )
        } else {
            self.surroundings(&reflection)
        };
        let softness = 2.0 / f64::from(sharpness).sqrt();
        let highlights = scaled(
            self.highlights(&point, &reflection, softness),
            (0.25 + 0.75 * lit.lamp) * (sharpness / 300.0).min(1.0),
        );
        plus(
            scaled(diffuse, 1.0 - share),
            scaled(plus(seen, highlights), share),
        )
    }

    /// Share of the sky that near things leave to the point, 0..1.
    fn sky_share<const SAMPLES: usize>(
        &self,
        point: &Point3<f64>,
        normal: &Vector3<f64>,
        own: Option<u32>,
        twist: f64,
        tile: Option<&Tile>,
        scratch: &mut Scratch,
    ) -> f32 {
        let center = point + normal * (SKY_REACH * 0.5);
        self.casters_at(Light::Sky, point, tile, &mut scratch.casters, |bounds| {
            let nearest = center.sup(&bounds.min).inf(&bounds.max);
            (nearest - center).norm_squared() < SKY_REACH * SKY_REACH * 0.8
                // Not wholly behind the surface.
                && normal.dot(&(bounds.center() - point)) + normal.abs().dot(&bounds.half()) > 1e-3
        });
        scratch.casters.retain(|&index| Some(index) != own);
        if scratch.casters.is_empty() {
            return 1.0;
        }
        let (right, forward) = basis(normal);
        let mut hidden = 0.0;
        for (x, y) in seed_points::<SAMPLES>(twist) {
            let direction =
                right * x + forward * y + normal * (1.0 - x * x - y * y).max(0.0).sqrt();
            let ray = Ray {
                origin: *point,
                direction,
            };
            let mut nearest = SKY_REACH;
            for &caster in &scratch.casters {
                let primitive = &self.scene.primitives()[caster as usize];
                if let Some(crossing) = primitive.shape.crossing(&ray, LIFT, nearest) {
                    nearest = crossing.t;
                }
            }
            hidden += 1.0 - (nearest / SKY_REACH) as f32;
        }
        1.0 - 0.9 * hidden / SAMPLES as f32
    }

    /// Share of the lamp that the point sees, 0..1.
    fn lamp_share<const SAMPLES: usize>(
        &self,
        point: &Point3<f64>,
        own: Option<u32>,
        twist: f64,
        tile: Option<&Tile>,
        scratch: &mut Scratch,
    ) -> f32 {
        let lamp = &self.lighting.lamp;
        let axis = lamp.center - point;
        let length = axis.norm();
        let direction = axis / length;
        self.casters_at(Light::Lamp, point, tile, &mut scratch.casters, |bounds| {
            in_beam(bounds, point, &direction, length, lamp.radius)
        });
        scratch.casters.retain(|&index| Some(index) != own);
        if scratch.casters.is_empty() {
            return 1.0;
        }
        let (right, forward) = basis(&direction);
        let mut seen = 0.0;
        for (x, y) in seed_points::<SAMPLES>(twist) {
            let offset = axis + (right * x + forward * y) * lamp.radius;
            let distance = offset.norm();
            let ray = Ray {
                origin: *point,
                direction: offset / distance,
            };
            let mut share = 1.0;
            for &caster in &scratch.casters {
                let primitive = &self.scene.primitives()[caster as usize];
                if primitive.shape.crossing(&ray, LIFT, distance).is_some() {
                    share *= if primitive.is_glass() {
                        GLASS_SHADOW
                    } else {
                        0.0
                    };
                    if share == 0.0 {
                        break;
                    }
                }
            }
            seen += share;
        }
        seen / SAMPLES as f32
    }
}

/// Mean light of the points of the same face at most `reach` pixels away, the nearer ones counting more, if there are
/// `enough` and they differ by less than `lamp_range` and `sky_range`.
fn shared(
    known: &[[Option<Lit>; TILE]; TILE],
    face: (usize, usize),
    (column, row): (usize, usize),
    reach: usize,
    enough: usize,
    [lamp_range, sky_range]: [f32; 2],
) -> Option<Lit> {
    let (mut count, mut weight, mut sky, mut lamp) = (0, 0.0, 0.0, 0.0);
    let (mut low, mut high) = ([1.0f32; 2], [0.0f32; 2]);
    for there_row in row.saturating_sub(reach)..(row + reach + 1).min(TILE) {
        for there_column in column.saturating_sub(reach)..(column + reach + 1).min(TILE) {
            let Some(lit) = known[there_row][there_column].filter(|lit| lit.face == face) else {
                continue;
            };
            let (across, down) = (there_column.abs_diff(column), there_row.abs_diff(row));
            let near = 1.0 / (across * across + down * down) as f32;
            count += 1;
            weight += near;
            sky += near * lit.sky;
            lamp += near * lit.lamp;
            low = [low[0].min(lit.lamp), low[1].min(lit.sky)];
            high = [high[0].max(lit.lamp), high[1].max(lit.sky)];
        }
    }
    (count >= enough && high[0] - low[0] < lamp_range && high[1] - low[1] < sky_range).then(|| {
        Lit {
            face,
            sky: sky / weight,
            lamp: lamp / weight,
        }
    })
}

/// Does a pixel differ from one of its neighbours in surface, or strongly in colour?
fn rough(
    camera: &Intrinsics,
    object: &[ObjectId],
    lit: &[Lit],
    radiance: &[Rgb],
    column: usize,
    row: usize,
) -> bool {
    let width = camera.width;
    let here = row * width + column;
    let differs = |there: usize| {
        let (a, b) = (radiance[here], radiance[there]);
        if object[here] != object[there] {
            return true;
        }
        // Textures are averaged over the pixel already; what is seen through glass is not.
        if lit[here].face == lit[there].face && lit[here].face != UNLIT.face {
            return false;
        }
        (0..3).any(|i| (a[i] - b[i]).abs() > CONTRAST * a[i].max(b[i]).max(0.05))
    };
    (column > 0 && differs(here - 1))
        || (column + 1 < width && differs(here + 1))
        || (row > 0 && differs(here - width))
        || (row + 1 < camera.height && differs(here + width))
}

/// May something in these bounds hide a part of a lamp of this radius, `length` away in `direction`? Never wrong if it
/// says no.
fn in_beam(
    bounds: &Bounds,
    point: &Point3<f64>,
    direction: &Vector3<f64>,
    length: f64,
    radius: f64,
) -> bool {
    let center = bounds.center() - point;
    let half = bounds.half();
    let along = center.dot(direction);
    let reach = half.dot(&direction.abs());
    if along + reach <= 0.0 {
        return false;
    }
    // The beam is no wider within the bounds than at their far end.
    let margin = radius * ((along + reach) / length).min(1.0);
    let grown = half.add_scalar(margin);
    // Separating axes of the segment and the grown box: the three sides, then the three cross products.
    let middle = center - direction * (length * 0.5);
    let arm = direction * (length * 0.5);
    let arm_size = arm.abs();
    (0..3).all(|i| middle[i].abs() <= grown[i] + arm_size[i])
        && (0..3).all(|i| {
            let (j, k) = ((i + 1) % 3, (i + 2) % 3);
            (middle[j] * arm[k] - middle[k] * arm[j]).abs()
                <= grown[j] * arm_size[k] + grown[k] * arm_size[j] + 1e-12
        })
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
    for row in rows {
        for column in columns.clone() {
            let (ray, cos) = camera_ray(camera, world_from_camera, column as f64, row as f64);
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

/// Columns and rows that something in these bounds can reach, with a pixel to spare; the whole image if a part of it is
/// behind the camera.
fn window_of(bounds: &Bounds, camera: &Intrinsics, camera_from_world: &Pose) -> [Range<usize>; 2] {
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
