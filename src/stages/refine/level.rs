//! What the memory expects at half resolution, and the pyramid over it.
//!
//! Coarse views and a pose -> luminance, variance and depth of the nearest surface; beside them the observed luminance.
//! Views whose depth is not the middle one are outvoted.

use crate::{
    isa::{Isa, for_each_isa},
    model::{camera::Intrinsics, pose::Pose, viewpoint::Coarse},
    stages::interpolate::project::{
        ProjectScratch, Projector, Sample, draw, map_size, sample_depth_m, sample_position,
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
    for pixel in 0..pixels {
        let mut seen = [(0.0f32, 0.0f32, 0.0f32, 0.0f32); REFINE_VIEWS];
        let mut count = 0;
        for (view, (coarse, _, weight)) in views.iter().enumerate() {
            let sample = maps[view * map_size(pixels) + pixel];
            if sample != 0 {
                let (luminance, variance) = interpolate(coarse, sample);
                seen[count] = (sample_depth_m(sample), luminance, variance, *weight);
                count += 1;
            }
        }
        let (luminance, variance, depth_m) = if count > 0 {
            merge(&mut seen[..count])
        } else {
            (0.0, 0.0, 0.0)
        };
        rows.luminance[pixel] = luminance;
        rows.variance[pixel] = variance;
        rows.depth_m[pixel] = depth_m;
    }
}

/// Luminance and variance inside the triangle around a sample.
#[inline(always)]
fn interpolate(coarse: &Coarse, sample: Sample) -> (f32, f32) {
    let Intrinsics { width, height, .. } = coarse.mesh.intrinsics;
    let (column, row, mut right, mut down) = sample_position(sample);
    right += if column > width - 2 { 1.0 } else { 0.0 };
    down += if row > height - 2 { 1.0 } else { 0.0 };
    let upper_left = row.min(height - 2) * width + column.min(width - 2);
    let (upper_right, lower_left) = (upper_left + 1, upper_left + width);
    let (corner, weights) = if right + down <= 1.0 {
        (upper_left, [1.0 - right - down, right, down])
    } else {
        (
            lower_left + 1,
            [right + down - 1.0, 1.0 - down, 1.0 - right],
        )
    };
    let corners = [corner, upper_right, lower_left];
    corners
        .into_iter()
        .zip(weights)
        .fold((0.0, 0.0), |(luminance, variance), (pixel, weight)| {
            (
                luminance + weight * coarse.luminance[pixel],
                variance + weight * coarse.variance[pixel],
            )
        })
}

/// `(depth, luminance, variance, weight)` of the views that see a pixel -> luminance, variance with their disagreement,
/// and depth of those near the middle depth.
fn merge(seen: &mut [(f32, f32, f32, f32)]) -> (f32, f32, f32) {
    seen.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
    let middle = seen[(seen.len() - 1) / 2].0;
    let kept = seen
        .iter()
        .filter(|view| (view.0 - middle).abs() <= DEPTH_TOLERANCE * middle);
    let (mut total, mut depth_m, mut luminance, mut square, mut variance) =
        (0.0, 0.0, 0.0, 0.0, 0.0);
    for &(z, y, v, weight) in kept {
        total += weight;
        depth_m += weight * z;
        luminance += weight * y;
        square += weight * y * y;
        variance += weight * v;
    }
    let luminance = luminance / total;
    let disagreement = (square / total - luminance * luminance).max(0.0);
    (luminance, variance / total + disagreement, depth_m / total)
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
