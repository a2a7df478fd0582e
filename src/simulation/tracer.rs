//! A ray tracer for small scenes: one area lamp with soft shadows, sky light with ambient occlusion, mirrors, and glass
//! that refracts by Snell's law and reflects by Fresnel's. No caustics: light that glass bends onto other things is
//! left out, glass only dims it.
//!
//! In: a [`Scene`], a camera. Out: linear radiance, depth along the optical axis (metres), the object in every pixel.
//! One ray through each pixel's centre gives depth and object; edges and strong contrasts get four more for colour.

use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

use super::{
    scene::{Finish, Hit, ObjectId, Primitive, Scene},
    shapes::{Bounds, Ray},
    texture::{Rgb, Spot, mixed, rgb, scaled},
};
use crate::model::{camera::Intrinsics, pose::Pose};

/// Metres by which a secondary ray leaves its surface.
const LIFT: f64 = 1e-7;
const MAX_BOUNCES: u32 = 9;
const LAMP_SAMPLES: usize = 16;
const SKY_SAMPLES: usize = 8;
/// Things farther than this do not dim the sky light, metres.
const SKY_REACH: f64 = 0.26;
/// Share of light that one pane of glass lets through to what is in its shadow.
const GLASS_SHADOW: f32 = 0.9;
/// Contrast between neighbours (of the larger) above which a pixel is sampled again.
const CONTRAST: f32 = 0.22;

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
}

struct Sample {
    radiance: Rgb,
    /// Distance along the ray, infinite for nothing.
    t: f64,
    primitive: Option<usize>,
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

/// Points spread evenly over the unit disc: a sunflower's seeds.
fn seed_point(index: usize, count: usize, twist: f64) -> (f64, f64) {
    const GOLDEN_ANGLE: f64 = 2.399_963_229_728_653;
    let radius = ((index as f64 + 0.5) / count as f64).sqrt();
    let (sin, cos) = (index as f64 * GOLDEN_ANGLE + twist * std::f64::consts::TAU).sin_cos();
    (radius * cos, radius * sin)
}

fn basis(normal: &Vector3<f64>) -> (Vector3<f64>, Vector3<f64>) {
    let helper = if normal.z.abs() < 0.9 { Vector3::z() } else { Vector3::x() };
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
        let Intrinsics { width, height, .. } = *camera;
        let pixels = camera.pixels();
        let spread = 1.0 / camera.fx;
        let mut rendering = Rendering {
            radiance: vec![[0.0; 3]; pixels],
            depth_m: vec![0.0; pixels],
            depth_through_glass_m: vec![0.0; pixels],
            object: vec![ObjectId::ROOM; pixels],
        };
        let mut surface = vec![usize::MAX; pixels];
        let path = |u: f64, v: f64, twist: f64| {
            let (ray, cos) = camera_ray(camera, world_from_camera, u, v);
            let path = Path {
                ray,
                bounces: 0,
                travelled: 0.0,
                spread,
                twist,
            };
            (path, cos)
        };
        rendering
            .radiance
            .par_chunks_mut(width)
            .zip(rendering.depth_m.par_chunks_mut(width))
            .zip(rendering.depth_through_glass_m.par_chunks_mut(width))
            .zip(rendering.object.par_chunks_mut(width))
            .zip(surface.par_chunks_mut(width))
            .enumerate()
            .for_each_init(
                Scratch::default,
                |scratch, (row, ((((radiance, depth), through), object), surface))| {
                    for column in 0..width {
                        let (path, cos) =
                            path(column as f64, row as f64, twist_of(column, row));
                        let sample = self.trace(&path, scratch);
                        radiance[column] = sample.radiance;
                        let Some(primitive) = sample.primitive else {
                            continue;
                        };
                        let seen = &self.scene.primitives()[primitive];
                        depth[column] = (sample.t * cos) as f32;
                        object[column] = seen.object;
                        surface[column] = primitive;
                        through[column] = if seen.is_glass() {
                            self.scene
                                .nearest(&path.ray, sample.t, f64::INFINITY, |p| !p.is_glass())
                                .map_or(0.0, |hit| (hit.crossing.t * cos) as f32)
                        } else {
                            depth[column]
                        };
                    }
                },
            );
        let first = rendering.radiance.clone();
        rendering
            .radiance
            .par_chunks_mut(width)
            .enumerate()
            .for_each_init(Scratch::default, |scratch, (row, radiance)| {
                for (column, radiance) in radiance.iter_mut().enumerate() {
                    let here = row * width + column;
                    let rough = [
                        (column > 0).then(|| here - 1),
                        (column + 1 < width).then_some(here + 1),
                        (row > 0).then(|| here - width),
                        (row + 1 < height).then_some(here + width),
                    ]
                    .into_iter()
                    .flatten()
                    .any(|there| {
                        surface[here] != surface[there] || contrast(first[here], first[there])
                    });
                    if !rough {
                        continue;
                    }
                    let mut sum = scaled(*radiance, 0.2);
                    for (index, (du, dv)) in
                        [(-0.125, -0.375), (0.375, -0.125), (0.125, 0.375), (-0.375, 0.125)]
                            .into_iter()
                            .enumerate()
                    {
                        let twist = (twist_of(column, row) + index as f64 * 0.23).fract();
                        let (path, _) = path(column as f64 + du, row as f64 + dv, twist);
                        sum = plus(sum, scaled(self.trace(&path, scratch).radiance, 0.2));
                    }
                    *radiance = sum;
                }
            });
        rendering
    }

    fn trace(&self, path: &Path, scratch: &mut Scratch) -> Sample {
        let Some(hit) = self.scene.nearest(&path.ray, LIFT, f64::INFINITY, |_| true) else {
            return Sample {
                radiance: self.surroundings(&path.ray.direction),
                t: f64::INFINITY,
                primitive: None,
            };
        };
        let primitive = &self.scene.primitives()[hit.primitive];
        let radiance = match primitive.material.finish {
            Finish::Glass { index } => self.glass(path, &hit, primitive, index, scratch),
            finish => self.opaque(path, &hit, primitive, finish, scratch),
        };
        Sample {
            radiance,
            t: hit.crossing.t,
            primitive: Some(hit.primitive),
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
        plus(scaled(lamp.irradiance, lamp_patch * 14.0), scaled(*light, window_patch * 9.0))
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
        let (normal, ratio) = if entering { (outward, 1.0 / index) } else { (-outward, index) };
        if path.bounces >= MAX_BOUNCES {
            return self.surroundings(&direction);
        }
        let onward = |direction: Vector3<f64>| Path {
            ray: Ray {
                origin: point,
                direction,
            },
            bounces: path.bounces + 1,
            travelled: path.travelled + hit.crossing.t,
            ..*path
        };
        let reflection = mirrored(&direction, &normal);
        let Some(transmission) = refracted(&direction, &normal, ratio) else {
            return self.trace(&onward(reflection), scratch).radiance;
        };
        let share = fresnel(-direction.dot(&normal), -transmission.dot(&normal), ratio);
        let through = scaled(self.trace(&onward(transmission), scratch).radiance, 0.985 * (1.0 - share));
        // Reflections inside the wall are many and faint: followed only where they are the view itself.
        if path.bounces > 1 || !entering {
            return plus(through, scaled(self.surroundings(&reflection), share));
        }
        let reflected = plus(
            self.trace(&onward(reflection), scratch).radiance,
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
        scratch: &mut Scratch,
    ) -> Rgb {
        let direction = path.ray.direction;
        let point = path.ray.at(hit.crossing.t);
        let surface = primitive.shape.surface(&point, hit.crossing.part);
        let cos = -direction.dot(&surface.normal);
        let (normal, cos) = if cos < 0.0 { (-surface.normal, -cos) } else { (surface.normal, cos) };
        let travelled = path.travelled + hit.crossing.t;
        let colour = primitive.material.pattern.colour(&Spot {
            u: surface.u,
            v: surface.v,
            part: surface.part,
            point,
            // Between the short and the long side of the pixel's oblique print.
            footprint: travelled * path.spread / cos.max(0.1).sqrt(),
        });
        let own = (!primitive.hollow).then_some(hit.primitive as u32);
        // Seen in a mirror or through glass, fewer samples do.
        let effort = if path.bounces > 1 { 4 } else { 1 };
        let mut light = self.sky(&point, &normal, own, path.twist, effort, scratch);
        let lamp = &self.lighting.lamp;
        let to_lamp = lamp.center - point;
        let distance = to_lamp.norm();
        let facing = normal.dot(&to_lamp) / distance;
        let mut lit = 0.0;
        if facing > 0.0 {
            lit = self.lamp_share(&point, own, path.twist, effort, scratch);
            let falloff = (lamp.reference_m / distance).powi(2) * facing;
            light = plus(light, scaled(lamp.irradiance, lit * falloff as f32));
        }
        let diffuse = times(colour, light);
        let Finish::Glossy {
            reflectance,
            sharpness,
        } = finish
        else {
            return diffuse;
        };
        let share = reflectance + (1.0 - reflectance) * (1.0 - cos as f32).powi(5) * (sharpness / 200.0).min(1.0);
        let reflection = mirrored(&direction, &normal);
        let seen = if path.bounces < 2 {
            self.trace(
                &Path {
                    ray: Ray {
                        origin: point + normal * LIFT,
                        direction: reflection,
                    },
                    bounces: path.bounces + 2,
                    travelled,
                    spread: path.spread * 3.0,
                    ..*path
                },
                scratch,
            )
            .radiance
        } else {
            self.surroundings(&reflection)
        };
        let softness = 2.0 / f64::from(sharpness).sqrt();
        let highlights = scaled(
            self.highlights(&point, &reflection, softness),
            (0.25 + 0.75 * lit) * (sharpness / 300.0).min(1.0),
        );
        plus(
            scaled(diffuse, 1.0 - share),
            scaled(plus(seen, highlights), share),
        )
    }

    /// Irradiance from all around, less what near things take away.
    fn sky(
        &self,
        point: &Point3<f64>,
        normal: &Vector3<f64>,
        own: Option<u32>,
        twist: f64,
        effort: usize,
        scratch: &mut Scratch,
    ) -> Rgb {
        let up = (0.5 + 0.5 * normal.z) as f32;
        let (towards, window) = &self.lighting.window;
        let from_window = normal.dot(towards).max(0.0) as f32;
        let light = plus(
            mixed(self.lighting.ground, self.lighting.sky, up),
            scaled(*window, from_window),
        );
        let center = point + normal * (SKY_REACH * 0.5);
        self.scene.casters(&mut scratch.casters, |bounds| {
            let nearest = center.sup(&bounds.min).inf(&bounds.max);
            (nearest - center).norm_squared() < SKY_REACH * SKY_REACH * 0.8
                // Not wholly behind the surface.
                && normal.dot(&(bounds.center() - point)) + normal.abs().dot(&bounds.half()) > 1e-3
        });
        scratch.casters.retain(|&index| Some(index) != own);
        if scratch.casters.is_empty() {
            return light;
        }
        let (right, forward) = basis(normal);
        let samples = (SKY_SAMPLES / effort).max(4);
        let mut hidden = 0.0;
        for index in 0..samples {
            let (x, y) = seed_point(index, samples, twist);
            let direction =
                right * x + forward * y + normal * (1.0 - x * x - y * y).max(0.0).sqrt();
            let ray = Ray {
                origin: *point,
                direction,
            };
            let mut nearest = SKY_REACH;
            for &caster in &scratch.casters {
                let primitive = &self.scene.primitives()[caster as usize];
                if primitive.is_glass() {
                    continue;
                }
                if let Some(crossing) = primitive.shape.crossing(&ray, LIFT, nearest) {
                    nearest = crossing.t;
                }
            }
            hidden += 1.0 - (nearest / SKY_REACH) as f32;
        }
        scaled(light, 1.0 - 0.9 * hidden / samples as f32)
    }

    /// Share of the lamp that the point sees, 0..1.
    fn lamp_share(
        &self,
        point: &Point3<f64>,
        own: Option<u32>,
        twist: f64,
        effort: usize,
        scratch: &mut Scratch,
    ) -> f32 {
        let lamp = &self.lighting.lamp;
        let axis = lamp.center - point;
        let length = axis.norm();
        let direction = axis / length;
        self.scene.casters(&mut scratch.casters, |bounds| {
            in_beam(bounds, point, &direction, length, lamp.radius)
        });
        scratch.casters.retain(|&index| Some(index) != own);
        if scratch.casters.is_empty() {
            return 1.0;
        }
        let (right, forward) = basis(&direction);
        let samples = LAMP_SAMPLES / effort;
        let mut seen = 0.0;
        for index in 0..samples {
            let (x, y) = seed_point(index, samples, twist);
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
                    share *= if primitive.is_glass() { GLASS_SHADOW } else { 0.0 };
                    if share == 0.0 {
                        break;
                    }
                }
            }
            seen += share;
        }
        seen / samples as f32
    }
}

fn contrast(a: Rgb, b: Rgb) -> bool {
    (0..3).any(|i| (a[i] - b[i]).abs() > CONTRAST * a[i].max(b[i]).max(0.05))
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
pub fn depth_alone(primitives: &[Primitive], camera: &Intrinsics, world_from_camera: &Pose) -> Vec<f32> {
    let mut depth = vec![f32::INFINITY; camera.pixels()];
    let Some((columns, rows)) = window_of(primitives, camera, world_from_camera) else {
        return depth;
    };
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

/// Pixels that the primitives' bounds can reach; the whole image if part of them is behind the camera.
fn window_of(
    primitives: &[Primitive],
    camera: &Intrinsics,
    world_from_camera: &Pose,
) -> Option<(std::ops::Range<usize>, std::ops::Range<usize>)> {
    let bounds = primitives
        .iter()
        .map(|primitive| primitive.shape.bounds())
        .reduce(|a, b| a.joined(&b))?;
    let camera_from_world = world_from_camera.inverse();
    let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
    for corner in 0..8 {
        let pick = |axis: usize| {
            if corner >> axis & 1 == 0 { bounds.min[axis] } else { bounds.max[axis] }
        };
        let in_camera = camera_from_world * Point3::new(pick(0), pick(1), pick(2));
        let Some((u, v)) = (in_camera.z > 1e-3)
            .then(|| camera.project(&in_camera))
            .flatten()
        else {
            return Some((0..camera.width, 0..camera.height));
        };
        low = [low[0].min(u), low[1].min(v)];
        high = [high[0].max(u), high[1].max(v)];
    }
    // The casts saturate: a box outside of the image gives an empty range.
    let range = |axis: usize, size: usize| {
        (low[axis].floor().max(0.0) as usize).min(size)..((high[axis].ceil() + 1.0).max(0.0) as usize).min(size)
    };
    Some((range(0, camera.width), range(1, camera.height)))
}
