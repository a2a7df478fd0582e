//! The colour that a ray brings back: what is matte, varnished, or glass, and what these mirror.

use std::sync::LazyLock;

use nalgebra::{Point3, Vector3};

use super::{LIFT, Near, Path, Scratch, Seen, Tracer, light::Lit, tiles::TILE};
use crate::{
    isa::Isa,
    lanes::LANES,
    simulation::{
        scene::{Finish, Hit, Primitive},
        shapes::Ray,
        texture::{Rgb, Spot, colours, mixed, rgb, scaled},
    },
};

const MAX_BOUNCES: u32 = 9;
/// Mirrored light of a smaller part in the pixel is taken from the room at large.
const FAINT: f32 = 0.045;
/// Fewer points of a pattern are evaluated one by one.
const FEW: usize = 3;
/// Views more oblique than this (square of the cosine) count as this oblique.
pub(super) const LEAST_COS2: f64 = 2e-3;

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

pub(super) fn plus(a: Rgb, b: Rgb) -> Rgb {
    std::array::from_fn(|i| a[i] + b[i])
}

fn times(a: Rgb, b: Rgb) -> Rgb {
    std::array::from_fn(|i| a[i] * b[i])
}

/// A surface that is not glass, before light falls on it.
#[derive(Clone, Copy)]
pub(super) struct Paint {
    /// Towards the eye.
    normal: Vector3<f64>,
    /// Of the angle between it and the ray.
    cos: f64,
    colour: Rgb,
}

impl Tracer<'_> {
    /// The surface that each of a tile's rays, but those `painted` already, meets. Its pattern is evaluated for many rays at once.
    pub(super) fn paint(
        &self,
        isa: Isa,
        seen: &[Seen],
        painted: u64,
        paints: &mut Vec<Option<Paint>>,
    ) {
        paints.clear();
        let mut spots = [Spot::default(); TILE * TILE];
        // Which rays wait for their colour.
        let mut waiting = 0u64;
        for (index, (_, path, _, hit)) in seen.iter().enumerate() {
            let paint = hit.and_then(|hit| {
                let primitive = &self.scene.primitives()[hit.primitive];
                if primitive.is_glass() || painted >> index & 1 == 1 {
                    return None;
                }
                let (normal, cos, spot) = Self::spot(primitive, path, &hit);
                spots[index] = spot;
                waiting |= 1 << index;
                Some(Paint {
                    normal,
                    cos,
                    colour: [0.0; 3],
                })
            });
            paints.push(paint);
        }
        while waiting != 0 {
            let first = waiting.trailing_zeros() as usize;
            let primitive = |index: usize| seen[index].3.map(|hit| hit.primitive);
            let (mut chosen, mut count) = ([first; LANES], 0);
            let mut rest = waiting;
            while rest != 0 && count < LANES {
                let index = rest.trailing_zeros() as usize;
                rest &= rest - 1;
                if primitive(index) == primitive(first) {
                    chosen[count] = index;
                    count += 1;
                    waiting &= !(1 << index);
                }
            }
            let Some(primitive) = primitive(first) else {
                continue;
            };
            let pattern = &self.scene.primitives()[primitive].material.pattern;
            let mut found = [[0.0; 3]; LANES];
            if count < FEW {
                for (found, &index) in found.iter_mut().zip(&chosen[..count]) {
                    *found = pattern.colour(&spots[index]);
                }
            } else {
                colours(isa, pattern, &chosen.map(|index| spots[index]), &mut found);
            }
            for (&index, &colour) in chosen[..count].iter().zip(&found) {
                if let Some(paint) = &mut paints[index] {
                    paint.colour = colour;
                }
            }
        }
    }

    /// Where a ray meets a surface: its normal on the ray's side, the cosine between them, and the place in its texture.
    fn spot(primitive: &Primitive, path: &Path, hit: &Hit) -> (Vector3<f64>, f64, Spot) {
        let point = path.ray.at(hit.crossing.t);
        let surface = primitive.shape.surface(&point, hit.crossing.part);
        let cos = -path.ray.direction.dot(&surface.normal);
        let (normal, cos) = if cos < 0.0 {
            (-surface.normal, -cos)
        } else {
            (surface.normal, cos)
        };
        let travelled = path.travelled + hit.crossing.t;
        // Along a direction on the surface, a pixel's oblique print is as wide as the pixel, over the cosine of the angle
        // that the ray makes with the plane across that direction.
        let width = travelled * path.spread;
        let along = path.ray.direction.dot(&surface.right).powi(2);
        let cos2 = (cos * cos).max(LEAST_COS2);
        let up = (1.0 - cos * cos - along).max(0.0);
        let spot = Spot {
            u: surface.u as f32,
            v: surface.v as f32,
            footprint: [along, up].map(|square| (width * (1.0 + square / cos2).sqrt()) as f32),
        };
        (normal, cos, spot)
    }

    fn trace(&self, path: &Path, near: Near, scratch: &mut Scratch) -> Rgb {
        let hit = self.scene.nearest(&path.ray, LIFT, f64::INFINITY, |_| true);
        let near = Near {
            lit: None,
            paint: None,
            ..near
        };
        self.shade(path, hit.as_ref(), near, scratch)
    }

    pub(super) fn shade(
        &self,
        path: &Path,
        hit: Option<&Hit>,
        near: Near,
        scratch: &mut Scratch,
    ) -> Rgb {
        let Some(hit) = hit else {
            return self.surroundings(&path.ray.direction);
        };
        let primitive = &self.scene.primitives()[hit.primitive];
        match primitive.material.finish {
            Finish::Glass { index } => self.glass(path, hit, index, near, scratch),
            finish => {
                let lit = near
                    .lit
                    .or_else(|| near.view?.light_at(hit, &path.ray.at(hit.crossing.t)))
                    .unwrap_or_else(|| self.light_beyond(path, hit, scratch));
                self.opaque(path, hit, finish, lit, near, scratch)
            }
        }
    }

    /// What is beyond everything: the ceiling with the lamp, and the rest of the room behind the robot.
    fn surroundings(&self, direction: &Vector3<f64>) -> Rgb {
        static WALL: LazyLock<[Rgb; 2]> = LazyLock::new(|| [rgb(0x8f8577), rgb(0xd8d2c4)]);
        let up = direction.z as f32;
        let [low, high] = *WALL;
        let wall = mixed(low, high, (up * 2.0).clamp(0.0, 1.0));
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

    fn glass(&self, path: &Path, hit: &Hit, index: f64, near: Near, scratch: &mut Scratch) -> Rgb {
        let primitive = &self.scene.primitives()[hit.primitive];
        let direction = path.ray.direction;
        let point = path.ray.at(hit.crossing.t);
        let outward = primitive.shape.normal(&point, hit.crossing.part)
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
            return self.trace(&onward(reflection, 1.0), near, scratch);
        };
        let share = fresnel(-direction.dot(&normal), -transmission.dot(&normal), ratio);
        let through = scaled(
            self.trace(&onward(transmission, 1.0 - share), near, scratch),
            0.985 * (1.0 - share),
        );
        // Reflections inside the wall are many and faint: followed only where they are the view itself.
        if path.bounces > 1 || !entering {
            return plus(through, scaled(self.surroundings(&reflection), share));
        }
        let seen = if path.weight * share > FAINT {
            self.trace(&onward(reflection, share), near, scratch)
        } else {
            self.surroundings(&reflection)
        };
        let reflected = plus(seen, self.highlights(&point, &reflection, 0.08));
        plus(through, scaled(reflected, share))
    }

    /// The light on a surface from everywhere but the lamp.
    pub(super) fn skylight(&self, normal: &Vector3<f64>) -> Rgb {
        let lighting = self.lighting;
        let up = (0.5 + 0.5 * normal.z) as f32;
        let (towards, window) = &lighting.window;
        plus(
            mixed(lighting.ground, lighting.sky, up),
            scaled(*window, normal.dot(towards).max(0.0) as f32),
        )
    }

    /// The light that a surface scatters.
    #[inline]
    pub(super) fn diffuse(&self, point: &Point3<f64>, paint: &Paint, lit: Lit) -> Rgb {
        let normal = &paint.normal;
        let lighting = self.lighting;
        let sky = self.skylight(normal);
        let lamp = &lighting.lamp;
        let to_lamp = lamp.center - point;
        let distance = to_lamp.norm();
        let facing = (normal.dot(&to_lamp) / distance).max(0.0);
        let falloff = ((lamp.reference_m / distance).powi(2) * facing) as f32;
        let light = plus(
            scaled(sky, lit.sky),
            scaled(lamp.irradiance, lit.lamp * falloff),
        );
        times(paint.colour, light)
    }

    fn opaque(
        &self,
        path: &Path,
        hit: &Hit,
        finish: Finish,
        lit: Lit,
        near: Near,
        scratch: &mut Scratch,
    ) -> Rgb {
        let primitive = &self.scene.primitives()[hit.primitive];
        let direction = path.ray.direction;
        let point = path.ray.at(hit.crossing.t);
        let Paint {
            normal,
            cos,
            colour,
        } = near.paint.unwrap_or_else(|| {
            let (normal, cos, spot) = Self::spot(primitive, path, hit);
            Paint {
                normal,
                cos,
                colour: primitive.material.pattern.colour(&spot),
            }
        });
        let travelled = path.travelled + hit.crossing.t;
        let diffuse = self.diffuse(
            &point,
            &Paint {
                normal,
                cos,
                colour,
            },
            lit,
        );
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
                },
                near,
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
}
