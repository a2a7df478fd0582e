//! Where one pixel shows several things: how much of it each covers.

use arrayvec::ArrayVec;
use nalgebra::Point3;

use super::{
    Eye, LIFT, Near, Scratch, Tracer,
    light::{Lit, LitView, UNLIT, face_of},
    shade::plus,
    tiles::Tile,
};
use crate::{
    isa::for_each_isa,
    lanes::{LANES, Lanes},
    model::camera::Intrinsics,
    simulation::{
        scene::{ObjectId, Scene},
        shapes::{Directions, PLAIN},
        texture::{Rgb, scaled},
    },
};

/// Contrast between neighbouring surfaces (relative to the brighter) above which a pixel is sampled again; between those
/// of several objects at any contrast.
const CONTRAST: f32 = 0.12;
/// So many samples of a pixel are shaded for themselves if what they show is seen at none of the pixels around.
const SHADED: usize = 2;
/// Where a pixel that glass is seen in, or beside, is sampled again.
const THROUGH_GLASS: [(f64, f64); 2] = [(0.4, -0.2), (-0.4, 0.2)];
/// None of `nearby`.
const ELSEWHERE: u32 = u32::MAX;

/// Offsets of a pixel's samples from its centre, pixels: a net with one in each sixteenth of the pixel's width, of its
/// height, and of its area in every proportion of the two.
fn offset(sample: usize) -> (f64, f64) {
    let reversed = (sample as u32).reverse_bits() >> 28;
    let place = |step: f64| (step + 0.5) / LANES as f64 - 0.5;
    (place(sample as f64), place(f64::from(reversed)))
}

/// What a camera adds to the direction through a pixel's centre for each of its samples.
pub(super) struct Samples<'a> {
    eye: &'a Eye,
    beside: Directions,
}

impl<'a> Samples<'a> {
    pub(super) fn new(eye: &'a Eye) -> Self {
        let mut beside = [[0.0; LANES]; 3];
        for lane in 0..LANES {
            let (du, dv) = offset(lane);
            let added = eye.across * du + eye.down * dv;
            for axis in 0..3 {
                beside[axis][lane] = added[axis] as f32;
            }
        }
        Self { eye, beside }
    }
}

for_each_isa! {
    /// Which of the primitives `nearby` (its index there) each of these rays meets first.
    fn shown(scene: &Scene, nearby: &[usize], eye: &Point3<f64>, rays: &Directions, which: &mut [u32; LANES]) = shown_kernel;
}

#[inline(always)]
fn shown_kernel(
    scene: &Scene,
    nearby: &[usize],
    eye: &Point3<f64>,
    rays: &Directions,
    which: &mut [u32; LANES],
) {
    let mut nearest: Lanes = [f32::INFINITY; LANES];
    let mut found = [ELSEWHERE; LANES];
    for (index, &primitive) in (0..).zip(nearby) {
        let before = nearest;
        scene.primitives()[primitive]
            .shape
            .approach::<PLAIN>(eye, rays, &mut nearest);
        for lane in 0..LANES {
            found[lane] = if nearest[lane] < before[lane] {
                index
            } else {
                found[lane]
            };
        }
    }
    *which = found;
}

/// What is known of an image before its edges are looked at.
pub(super) struct First<'a> {
    pub(super) camera: &'a Intrinsics,
    pub(super) object: &'a [ObjectId],
    pub(super) radiance: &'a [Rgb],
    pub(super) view: &'a LitView,
}

impl First<'_> {
    /// The pixel and its neighbours, itself first.
    fn around(&self, column: usize, row: usize) -> ArrayVec<usize, 5> {
        let Intrinsics { width, height, .. } = *self.camera;
        let here = row * width + column;
        [
            Some(here),
            (column > 0).then(|| here - 1),
            (column + 1 < width).then_some(here + 1),
            (row > 0).then(|| here.wrapping_sub(width)),
            (row + 1 < height).then_some(here + width),
        ]
        .into_iter()
        .flatten()
        .collect()
    }

    /// Whether a pixel inside the image shows a face that is not glass, and all around it the same.
    fn is_amid(&self, column: usize, row: usize) -> bool {
        let Intrinsics { width, height, .. } = *self.camera;
        if column == 0 || column + 1 == width || row == 0 || row + 1 == height {
            return false;
        }
        let here = row * width + column;
        let face = self.lit(here).face;
        face != UNLIT.face
            && [here - width, here - 1, here + 1, here + width]
                .into_iter()
                .all(|there| self.lit(there).face == face)
    }

    fn lit(&self, at: usize) -> &Lit {
        &self.view.lit[at]
    }

    /// Textures are averaged over a pixel already; what is seen through glass, and what several things share, is not.
    fn is_edge(&self, around: &[usize]) -> bool {
        let here = around[0];
        around[1..].iter().any(|&there| {
            if self.lit(here).face == self.lit(there).face && self.lit(here).face != UNLIT.face {
                return false;
            }
            let (a, b) = (self.radiance[here], self.radiance[there]);
            self.object[here] != self.object[there]
                || (0..3).any(|i| (a[i] - b[i]).abs() > CONTRAST * a[i].max(b[i]).max(0.05))
        })
    }
}

impl Tracer<'_> {
    /// The colour of a pixel at an edge; `None` elsewhere.
    pub(super) fn edge(
        &self,
        first: &First,
        samples: &Samples,
        tile: &Tile,
        (column, row): (usize, usize),
        scratch: &mut Scratch,
    ) -> Option<Rgb> {
        if first.is_amid(column, row) {
            return None;
        }
        let around = first.around(column, row);
        if !first.is_edge(&around) {
            return None;
        }
        let eye = samples.eye;
        let path = |(du, dv): (f64, f64)| eye.path(column as f64 + du, row as f64 + dv).0;
        let near = Near {
            lit: None,
            view: Some(first.view),
            paint: None,
        };
        if around.iter().any(|&at| first.lit(at).face == UNLIT.face) {
            // Glass is looked through again for every sample.
            let share = 1.0 / (THROUGH_GLASS.len() + 1) as f32;
            let mut sum = scaled(first.radiance[around[0]], share);
            for offset in THROUGH_GLASS {
                let path = path(offset);
                let hit = self.first(&path.ray, tile, column, row);
                let known = hit.and_then(|hit| {
                    around
                        .iter()
                        .find(|&&there| first.lit(there).face == face_of(&hit))
                });
                let colour = match known {
                    Some(&there) => first.radiance[there],
                    None => self.shade(&path, hit.as_ref(), near, scratch),
                };
                sum = plus(sum, scaled(colour, share));
            }
            return Some(sum);
        }
        // What is seen in this pixel is as a rule seen at one of these, and has about the colour that it has there.
        let mut nearby = ArrayVec::<usize, 5>::new();
        for &at in &around {
            let primitive = first.lit(at).face.0 as usize;
            if !nearby.contains(&primitive) {
                nearby.push(primitive);
            }
        }
        let middle = eye.towards(column as f64, row as f64);
        let mut rays = samples.beside;
        for axis in 0..3 {
            for lane in 0..LANES {
                rays[axis][lane] += middle[axis] as f32;
            }
        }
        let mut which = [ELSEWHERE; LANES];
        shown(
            scratch.isa,
            self.scene,
            &nearby,
            &eye.origin,
            &rays,
            &mut which,
        );
        let mut sum = [0.0; 3];
        for (index, &primitive) in (0..).zip(&nearby) {
            let count = which.iter().filter(|&&shown| shown == index).count();
            if count == 0 {
                continue;
            }
            let of = |part: Option<u32>| {
                around.iter().copied().find(|&at| {
                    let face = first.lit(at).face;
                    face.0 as usize == primitive && part.is_none_or(|part| part == face.1)
                })
            };
            let Some(one) = of(None) else {
                continue;
            };
            let several = around.iter().any(|&at| {
                let face = first.lit(at).face;
                face.0 as usize == primitive && face != first.lit(one).face
            });
            if !several {
                sum = plus(sum, scaled(first.radiance[one], count as f32));
                continue;
            }
            for lane in (0..LANES).filter(|&lane| which[lane] == index) {
                let path = path(offset(lane));
                let shape = &self.scene.primitives()[primitive].shape;
                let at = shape
                    .crossing(&path.ray, LIFT, f64::INFINITY)
                    .and_then(|crossing| of(Some(crossing.part as u32)))
                    .unwrap_or(one);
                sum = plus(sum, first.radiance[at]);
            }
        }
        let elsewhere = || (0..LANES).filter(|&lane| which[lane] == ELSEWHERE);
        let missing = elsewhere().count();
        let shaded = missing.min(SHADED);
        for lane in elsewhere().take(shaded) {
            let path = path(offset(lane));
            let hit = self.first(&path.ray, tile, column, row);
            let colour = self.shade(&path, hit.as_ref(), near, scratch);
            sum = plus(sum, scaled(colour, missing as f32 / shaded as f32));
        }
        Some(scaled(sum, 1.0 / LANES as f32))
    }
}
