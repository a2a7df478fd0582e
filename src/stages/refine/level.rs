//! What the memory expects at half resolution, and the pyramid over it.
//!
//! Coarse views and a pose -> luminance, variance and depth of the nearest surface; beside them the observed luminance.
//! Views whose depth is not the middle one are outvoted.

use crate::{
    isa::{Isa, for_each_isa},
    lanes::{LANES, Lanes},
    model::{camera::Intrinsics, pose::Pose, viewpoint::Coarse},
    stages::interpolate::{
        gather::Source,
        project::{ProjectScratch, Projector, draw},
        sample::{Sample, map_size},
    },
};

use super::REFINE_VIEWS;

/// Views whose depth differs by more than this share from the middle one do not predict a pixel.
const DEPTH_TOLERANCE: f32 = 0.03;

/// Luminance, variance and depth that the memory predicts, or what was observed, at one resolution.
#[derive(Default)]
pub struct Level {
    pub width: usize,
    pub height: usize,
    /// Predicted Y; the depth is 0 where nothing is predicted.
    pub luminance: Vec<f32>,
    pub variance: Vec<f32>,
    pub depth_m: Vec<f32>,
    pub observed: Vec<f32>,
}

impl Level {
    /// Keeps its allocation; the contents are unspecified.
    pub fn resize(&mut self, width: usize, height: usize) {
        (self.width, self.height) = (width, height);
        for plane in [
            &mut self.luminance,
            &mut self.variance,
            &mut self.depth_m,
            &mut self.observed,
        ] {
            plane.resize(width * height, 0.0);
        }
    }
}

/// Rows of a level that are predicted.
pub struct LevelRows<'a> {
    pub luminance: &'a mut [f32],
    pub variance: &'a mut [f32],
    pub depth_m: &'a mut [f32],
}

/// What the rows of a band are predicted with.
#[derive(Default)]
pub struct PredictScratch {
    /// One map a view.
    maps: Vec<Sample>,
    project: ProjectScratch,
}

impl PredictScratch {
    /// Rows from `first_row` on of an image `width` wide.
    pub fn predict(
        &mut self,
        isa: Isa,
        views: &[(&Coarse, &Pose, f32)],
        projectors: &[Projector],
        width: usize,
        first_row: usize,
        rows: &mut LevelRows,
    ) {
        let pixels = rows.depth_m.len();
        let map_size = map_size(pixels);
        self.maps.clear();
        self.maps.resize(map_size * REFINE_VIEWS, 0);
        for (projector, map) in projectors.iter().zip(self.maps.chunks_exact_mut(map_size)) {
            draw(
                isa,
                projector,
                width,
                first_row..first_row + pixels / width,
                map,
                &mut self.project,
            );
        }
        expect(isa, views, &self.maps, rows);
    }
}

for_each_isa! {
    /// Luminance, variance and depth from the maps of the views, each as [`map_size`] says.
    fn expect(
        views: &[(&Coarse, &Pose, f32)],
        maps: &[Sample],
        rows: &mut LevelRows<'_>,
    ) = expect_kernel;
}

#[inline(always)]
fn expect_kernel(views: &[(&Coarse, &Pose, f32)], maps: &[Sample], rows: &mut LevelRows) {
    let pixels = rows.luminance.len();
    for start in (0..pixels).step_by(LANES) {
        let count = LANES.min(pixels - start);
        let mut seen = [Seen::NONE; REFINE_VIEWS];
        let maps = maps.chunks_exact(map_size(pixels));
        for (seen, ((coarse, _, weight), map)) in seen.iter_mut().zip(views.iter().zip(maps)) {
            let Intrinsics { width, height, .. } = coarse.mesh.intrinsics;
            // A smaller view has no triangle. A map reaches a step beyond its last pixel.
            if let (Some(samples), true) =
                (map[start..].first_chunk::<LANES>(), width.min(height) > 1)
            {
                seen.read(coarse, samples, *weight);
            }
        }
        let [luminance, variance, depth_m] = merge(&seen);
        rows.luminance[start..start + count].copy_from_slice(&luminance[..count]);
        rows.variance[start..start + count].copy_from_slice(&variance[..count]);
        rows.depth_m[start..start + count].copy_from_slice(&depth_m[..count]);
    }
}

/// What a view says about sixteen pixels.
#[derive(Clone, Copy)]
struct Seen {
    /// Infinite where unseen.
    depth_m: Lanes,
    luminance: Lanes,
    variance: Lanes,
    weight: f32,
}

impl Seen {
    const NONE: Self = Self {
        depth_m: [f32::INFINITY; LANES],
        luminance: [0.0; LANES],
        variance: [0.0; LANES],
        weight: 0.0,
    };

    /// Luminance and variance inside the triangles around the samples.
    #[inline(always)]
    fn read(&mut self, coarse: &Coarse, samples: &[Sample; LANES], weight: f32) {
        let Intrinsics { width, height, .. } = coarse.mesh.intrinsics;
        let mut source = Source::NONE;
        source.locate(samples, (width as u32, height as u32), 1.0);
        let mut corners = [[[0.0f32; LANES]; 3]; 2];
        for lane in 0..LANES {
            let at = source.corners(lane, width);
            for (plane, corners) in [&coarse.luminance, &coarse.variance]
                .into_iter()
                .zip(&mut corners)
            {
                for (corner, at) in corners.iter_mut().zip(at) {
                    corner[lane] = plane[at];
                }
            }
        }
        let interpolate = |corners: &[Lanes; 3], lane: usize| {
            corners[0][lane] * source.weights[0][lane]
                + corners[1][lane] * source.weights[1][lane]
                + corners[2][lane] * source.weights[2][lane]
        };
        for lane in 0..LANES {
            // 1/0 where unseen.
            self.depth_m[lane] = 1.0 / source.inverse_depth[lane];
            self.luminance[lane] = interpolate(&corners[0], lane);
            self.variance[lane] = interpolate(&corners[1], lane);
        }
        self.weight = weight;
    }
}

/// Luminance, variance with the views' disagreement, and depth, of those near the middle depth, the lower of two; 0 where
/// no view sees anything.
#[inline(always)]
fn merge(seen: &[Seen; REFINE_VIEWS]) -> [Lanes; 3] {
    let mut merged = [[0.0; LANES]; 3];
    for lane in 0..LANES {
        let [a, b, c] = [0, 1, 2].map(|view| seen[view].depth_m[lane]);
        let (low, high) = if a < b { (a, b) } else { (b, a) };
        let nearest = if low < c { low } else { c };
        let upper = if low < c { c } else { low };
        let middle = if high < upper { high } else { upper };
        let farthest = if high < upper { upper } else { high };
        let middle = if farthest < f32::INFINITY {
            middle
        } else {
            nearest
        };
        let (mut total, mut depth_m, mut luminance, mut square, mut variance) =
            (0.0, 0.0, 0.0, 0.0, 0.0);
        for seen in seen {
            let z = seen.depth_m[lane];
            // Infinity less infinity is no number.
            let kept = (z - middle).abs() <= DEPTH_TOLERANCE * middle;
            let weight = if kept { seen.weight } else { 0.0 };
            let y = seen.luminance[lane];
            total += weight;
            depth_m += weight * if kept { z } else { 0.0 };
            luminance += weight * y;
            square += weight * y * y;
            variance += weight * seen.variance[lane];
        }
        let scale = if total > 0.0 { 1.0 / total } else { 0.0 };
        let luminance = luminance * scale;
        let disagreement = square * scale - luminance * luminance;
        let disagreement = if disagreement > 0.0 {
            disagreement
        } else {
            0.0
        };
        merged[0][lane] = luminance;
        merged[1][lane] = variance * scale + disagreement;
        merged[2][lane] = depth_m * scale;
    }
    merged
}

for_each_isa! {
    /// Means over 2x2; predicted where at least three of the four are.
    pub fn halve_level(fine: &Level, level: &mut Level) = halve_level_kernel;
}

#[inline(always)]
fn halve_level_kernel(fine: &Level, level: &mut Level) {
    let (width, height) = (fine.width / 2, fine.height / 2);
    level.resize(width, height);
    halve_kernel(&fine.observed, fine.width, &mut level.observed);
    for y in 0..height {
        for x in 0..width {
            let first = 2 * y * fine.width + 2 * x;
            let four = [first, first + 1, first + fine.width, first + fine.width + 1];
            let (mut count, mut luminance, mut variance, mut depth_m) = (0.0, 0.0, 0.0, 0.0);
            for pixel in four {
                if fine.depth_m[pixel] > 0.0 {
                    count += 1.0;
                    luminance += fine.luminance[pixel];
                    variance += fine.variance[pixel];
                    depth_m += fine.depth_m[pixel];
                }
            }
            let scale = if count >= 3.0 { 1.0 / count } else { 0.0 };
            let pixel = y * width + x;
            level.luminance[pixel] = luminance * scale;
            level.variance[pixel] = variance * scale;
            level.depth_m[pixel] = depth_m * scale;
        }
    }
}

for_each_isa! {
    /// Means over 2x2; an odd last row or column is left out.
    pub fn halve(plane: &[f32], width: usize, half: &mut [f32]) = halve_kernel;
}

#[inline(always)]
fn halve_kernel(plane: &[f32], width: usize, half: &mut [f32]) {
    let rows = plane.chunks_exact((2 * width).max(1));
    for (half, rows) in half.chunks_exact_mut((width / 2).max(1)).zip(rows) {
        let (upper, lower) = rows.split_at(width);
        let pairs = upper.chunks_exact(2).zip(lower.chunks_exact(2));
        for (half, (upper, lower)) in half.iter_mut().zip(pairs) {
            *half = (upper[0] + upper[1] + lower[0] + lower[1]) / 4.0;
        }
    }
}
