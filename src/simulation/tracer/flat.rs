//! Matte flat faces, most of what there is to see: their colour in many pixels at once. The same as in [`super::shade`],
//! in single precision.

use nalgebra::Vector3;

use super::{
    Seen, Tracer,
    light::{Lit, face_of},
    shade::LEAST_COS2,
};
use crate::{
    isa::{Isa, for_each_isa},
    lanes::{LANES, Lanes},
    simulation::{
        scene::{Finish, Hit, Primitive},
        shapes::{Directions, Shape},
        texture::{Pattern, Rgb, Spots},
    },
};

/// A face as seen from one point. Lengths in metres.
struct Flat<'a> {
    pattern: &'a Pattern,
    /// Towards the eye.
    normal: [f32; 3],
    /// Directions in which the texture's u and v grow, and both at the eye's foot.
    axes: [[f32; 3]; 2],
    foot: [f32; 2],
    /// Of the lamp, from the eye.
    lamp: [f32; 3],
    /// Its light at one metre.
    lamplight: Rgb,
    /// All light from elsewhere.
    skylight: Rgb,
}

/// Of several pixels: the rays of unit length, how far they go, how wide a pixel is there, and the shares of the sky and
/// of the lamp.
struct Pixels {
    directions: Directions,
    length: Lanes,
    width: Lanes,
    sky: Lanes,
    lamp: Lanes,
}

for_each_isa! {
    fn colour(flat: &Flat, pixels: &Pixels, colours: &mut [Rgb; LANES]) = colour_kernel;
}

#[inline(always)]
fn dot(a: [f32; 3], x: f32, y: f32, z: f32) -> f32 {
    a[0] * x + a[1] * y + a[2] * z
}

#[inline(always)]
fn colour_kernel(flat: &Flat, pixels: &Pixels, colours: &mut [Rgb; LANES]) {
    let [xs, ys, zs] = &pixels.directions;
    let mut place = [[0.0; LANES]; 2];
    let mut footprint = [[0.0; LANES]; 2];
    let mut lamp = [0.0; LANES];
    for lane in 0..LANES {
        let (x, y, z, length) = (xs[lane], ys[lane], zs[lane], pixels.length[lane]);
        let along = dot(flat.axes[0], x, y, z);
        let up = dot(flat.axes[1], x, y, z);
        let cos = dot(flat.normal, x, y, z);
        place[0][lane] = flat.foot[0] + along * length;
        place[1][lane] = flat.foot[1] + up * length;
        let per_cos2 = 1.0 / (cos * cos).max(LEAST_COS2 as f32);
        let width = pixels.width[lane];
        footprint[0][lane] = width * (1.0 + along * along * per_cos2).sqrt();
        footprint[1][lane] = width * (1.0 + up * up * per_cos2).sqrt();
        let (x, y, z) = (
            flat.lamp[0] - x * length,
            flat.lamp[1] - y * length,
            flat.lamp[2] - z * length,
        );
        let square = x * x + y * y + z * z;
        let facing = dot(flat.normal, x, y, z).max(0.0);
        lamp[lane] = pixels.lamp[lane] * facing / (square * square.sqrt());
    }
    let [u, v] = place;
    *colours = flat.pattern.colours(&Spots::new(u, v, footprint));
    for channel in 0..3 {
        let (sky, lamplight) = (flat.skylight[channel], flat.lamplight[channel]);
        for lane in 0..LANES {
            colours[lane][channel] *= sky * pixels.sky[lane] + lamplight * lamp[lane];
        }
    }
}

fn single(vector: &Vector3<f64>) -> [f32; 3] {
    [vector.x as f32, vector.y as f32, vector.z as f32]
}

impl Tracer<'_> {
    fn flat_face<'a>(&self, primitive: &'a Primitive, hit: &Hit, seen: &Seen) -> Option<Flat<'a>> {
        let Shape::Solid(solid) = &primitive.shape else {
            return None;
        };
        if primitive.material.finish != Finish::Matte {
            return None;
        }
        let ray = &seen.1.ray;
        let (outward, _) = &solid.planes()[hit.crossing.part];
        let normal = if outward.dot(&ray.direction) < 0.0 {
            *outward
        } else {
            -outward
        };
        let (origin, axes) = solid.texture(hit.crossing.part);
        let from_origin = ray.origin - origin;
        let lamp = &self.lighting.lamp;
        let reference2 = (lamp.reference_m * lamp.reference_m) as f32;
        Some(Flat {
            pattern: &primitive.material.pattern,
            normal: single(&normal),
            axes: axes.each_ref().map(single),
            foot: axes.each_ref().map(|axis| from_origin.dot(axis) as f32),
            lamp: single(&(lamp.center - ray.origin)),
            lamplight: lamp.irradiance.map(|value| value * reference2),
            skylight: self.skylight(&normal),
        })
    }

    /// Colours, in `radiance`, those of a tile's pixels (at most 64) that show a matte flat face, if many show the same;
    /// returns which, a bit each.
    pub(super) fn paint_flat(
        &self,
        isa: Isa,
        seen: &[Seen],
        lit: &[Lit],
        radiance: &mut [Rgb],
    ) -> u64 {
        let mut painted = 0u64;
        let mut waiting = seen
            .iter()
            .enumerate()
            .filter(|(_, seen)| seen.3.is_some())
            .fold(0u64, |bits, (index, _)| bits | 1 << index);
        while waiting != 0 {
            let first = waiting.trailing_zeros() as usize;
            let Some(hit) = &seen[first].3 else {
                break;
            };
            let face = face_of(hit);
            let mut same = 0u64;
            let mut rest = waiting;
            while rest != 0 {
                let index = rest.trailing_zeros() as usize;
                rest &= rest - 1;
                if seen[index].3.is_some_and(|hit| face_of(&hit) == face) {
                    same |= 1 << index;
                }
            }
            waiting &= !same;
            if same.count_ones() < MANY {
                continue;
            }
            let primitive = &self.scene.primitives()[hit.primitive];
            let Some(flat) = self.flat_face(primitive, hit, &seen[first]) else {
                continue;
            };
            painted |= same;
            while same != 0 {
                let (mut chosen, mut count) = ([0; LANES], 0);
                while same != 0 && count < LANES {
                    chosen[count] = same.trailing_zeros() as usize;
                    same &= same - 1;
                    count += 1;
                }
                let last = chosen[count - 1];
                chosen[count..].fill(last);
                let mut pixels = Pixels {
                    directions: [[0.0; LANES]; 3],
                    length: [0.0; LANES],
                    width: [0.0; LANES],
                    sky: [0.0; LANES],
                    lamp: [0.0; LANES],
                };
                for (lane, &index) in chosen.iter().enumerate() {
                    let (at, path, _, hit) = &seen[index];
                    for axis in 0..3 {
                        pixels.directions[axis][lane] = path.ray.direction[axis] as f32;
                    }
                    let length = hit.map_or(0.0, |hit| hit.crossing.t);
                    pixels.length[lane] = length as f32;
                    pixels.width[lane] = (length * path.spread) as f32;
                    pixels.sky[lane] = lit[*at].sky;
                    pixels.lamp[lane] = lit[*at].lamp;
                }
                let mut colours = [[0.0; 3]; LANES];
                colour(isa, &flat, &pixels, &mut colours);
                for (&index, &colour) in chosen[..count].iter().zip(&colours) {
                    radiance[seen[index].0] = colour;
                }
            }
        }
        painted
    }
}

/// Fewer pixels of a face are coloured one by one.
const MANY: u32 = 4;
