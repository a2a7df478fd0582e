//! The pixels of some rows of a level: what a step of refinement needs to know about them.
//!
//! A level's planes and an estimate -> residuals in predicted standard deviations, their histogram, their weighted normal
//! equations. Which rows are one band depends on the level alone, and sums of bands are added in their order, so that
//! the number of threads changes no bit.

use std::ops::Range;

use crate::{
    isa::{Isa, for_each_isa},
    lanes::{LANES, Lanes},
    model::camera::Intrinsics,
};

use super::level::{Level, PredictScratch};

/// Variance of the sensor on top of what the belief predicts, squared grey levels.
const SENSOR_VARIANCE: f32 = 9.0;
/// Where a residual stops counting in the test whether refinement helped, predicted standard deviations.
const RESIDUAL_CAP: f32 = 4.0;
/// Pixels of a band, about: some ten microseconds of work.
const BAND_PIXELS: usize = 2560;
/// Products of two of eight derivatives.
pub const HESSIAN: usize = 36;
/// The upper triangle of the normal equations row by row, then the gradient.
pub type NormalSums = [f64; HESSIAN + 8];
/// Steps of sixteen pixels that are added up in single precision.
const STEPS_MAX: usize = 64;

/// Bins of a histogram over magnitudes: 64 to an octave; the first and the last are open. One more is for NaN, which is no
/// magnitude.
const BINS: usize = 24 * 64;
const BIN_SHIFT: u32 = f32::MANTISSA_DIGITS - 1 - 6;
/// Of the first: magnitudes of 2^-12.
const FIRST_BIN: u32 = (127 - 12) << 6;

/// A level as a camera sees it.
pub struct LevelView<'a> {
    pub level: &'a Level,
    pub camera: &'a Intrinsics,
    /// Right per unit of depth, a value a column, padded to whole steps.
    pub along: &'a [f32],
}

impl LevelView<'_> {
    /// Steps of a row.
    #[inline(always)]
    fn steps(&self) -> usize {
        self.along.len() / LANES
    }
}

/// How the points are seen by an estimate.
pub struct Motion {
    /// Column by column.
    pub rotation: [[f32; 3]; 3],
    pub translation: [f32; 3],
    pub gain: f32,
    pub offset: f32,
}

/// Tukey's weights, predicted standard deviations.
#[derive(Clone, Copy)]
pub struct Tukey {
    pub scale: f32,
    pub cutoff: f32,
}

/// Everything about the pixels that does not change while the pose does, a plane a value. Rows are padded to whole
/// steps.
#[derive(Default)]
struct Points {
    /// Metres; negative where there is nothing to compare.
    depth_m: Vec<f32>,
    luminance: Vec<f32>,
    /// d luminance / d direction: gradient times focal length.
    slope_x: Vec<f32>,
    slope_y: Vec<f32>,
    inverse_sd: Vec<f32>,
}

/// How far some points are from what was predicted.
#[derive(Debug, Clone, Copy, Default)]
pub struct Mismatch {
    pub compared: usize,
    /// Of capped residuals' magnitudes, predicted standard deviations.
    pub sum: f64,
}

pub struct Band {
    pub rows: Range<usize>,
    pub predict: PredictScratch,
    points: Points,
    /// What the middle is sought of; NaN does not count. In comparisons residuals, predicted standard deviations.
    values: Vec<f32>,
    histogram: Vec<u32>,
    sums: NormalSums,
    mismatches: [Mismatch; 2],
}

impl Default for Band {
    fn default() -> Self {
        Self {
            rows: 0..0,
            predict: PredictScratch::default(),
            points: Points::default(),
            values: Vec::new(),
            histogram: Vec::new(),
            sums: [0.0; HESSIAN + 8],
            mismatches: Default::default(),
        }
    }
}

/// Rows that make a band of an image so wide.
pub fn band_rows(width: usize) -> usize {
    (BAND_PIXELS / width.max(1)).max(1)
}

/// Bands for so many rows; those that are there are used again.
pub fn divide(bands: &mut Vec<Band>, width: usize, height: usize) -> &mut [Band] {
    let rows = band_rows(width);
    let count = height.div_ceil(rows);
    if bands.len() < count {
        bands.resize_with(count, Band::default);
    }
    for (index, band) in bands[..count].iter_mut().enumerate() {
        band.rows = index * rows..((index + 1) * rows).min(height);
    }
    &mut bands[..count]
}

impl Band {
    /// Seeks the middle of depths, 0 = none.
    pub fn hold_depths(&mut self, isa: Isa, depth_m: &[f32]) {
        self.values.clear();
        let given = |z: &f32| if *z > 0.0 { *z } else { f32::NAN };
        self.values.extend(depth_m.iter().map(given));
        count(isa, self);
    }

    /// Collects the comparable pixels: predicted together with their four neighbours.
    pub fn collect(&mut self, isa: Isa, view: &LevelView) -> usize {
        let mut comparable = 0;
        collect(isa, self, view, &mut comparable);
        comparable
    }

    /// Residuals of all points, Y(pi(M X)) - gain * tau - offset, NaN where they leave the image.
    pub fn compare(&mut self, isa: Isa, view: &LevelView, motion: &Motion) {
        compare(isa, self, view, motion);
        count(isa, self);
    }

    /// Adds up the weighted normal equations.
    pub fn accumulate(&mut self, isa: Isa, view: &LevelView, gain: f32, tukey: Tukey) {
        accumulate(isa, self, view, gain, tukey);
    }

    pub fn sums(&self) -> &NormalSums {
        &self.sums
    }

    /// How well two estimates explain the points.
    pub fn judge(&mut self, isa: Isa, view: &LevelView, motions: &[Motion; 2]) {
        for (index, motion) in motions.iter().enumerate() {
            compare(isa, self, view, motion);
            let mut mismatch = Mismatch::default();
            judge(isa, &self.values, &mut mismatch);
            self.mismatches[index] = mismatch;
        }
    }

    pub fn mismatches(&self) -> &[Mismatch; 2] {
        &self.mismatches
    }
}

/// How many values all bands hold, and the magnitude with as many below as above, as if those that share its bin were
/// spread evenly in it; 0 of none.
pub fn middle(bands: &[Band]) -> (usize, f32) {
    let mut histogram = [0u32; BINS];
    for band in bands {
        // Without the last, for NaN.
        for (sum, members) in histogram.iter_mut().zip(&band.histogram) {
            *sum += members;
        }
    }
    let count = histogram.iter().sum::<u32>() as usize;
    let mut rank = count as f32 / 2.0;
    for (bin, &members) in histogram.iter().enumerate() {
        let members = members as f32;
        if rank < members {
            let [low, high] =
                [bin, bin + 1].map(|bin| f32::from_bits((bin as u32 + FIRST_BIN) << BIN_SHIFT));
            return (count, low + (high - low) * (rank / members));
        }
        rank -= members;
    }
    (count, 0.0)
}

#[inline(always)]
fn bin(value: f32) -> u32 {
    let bin = (value.abs().to_bits() >> BIN_SHIFT).max(FIRST_BIN) - FIRST_BIN;
    let bin = bin.min(BINS as u32 - 1);
    if value.is_nan() { BINS as u32 } else { bin }
}

/// Of sixteen values, or fewer and NaN.
#[inline(always)]
fn sixteen_bins(values: &[f32]) -> [u32; LANES] {
    let mut bins = [BINS as u32; LANES];
    match values.first_chunk::<LANES>() {
        Some(values) => {
            for lane in 0..LANES {
                bins[lane] = bin(values[lane]);
            }
        }
        None => {
            for (slot, value) in bins.iter_mut().zip(values) {
                *slot = bin(*value);
            }
        }
    }
    bins
}

for_each_isa! {
    fn count(band: &mut Band) = count_kernel;
}

#[inline(always)]
fn count_kernel(band: &mut Band) {
    band.histogram.clear();
    band.histogram.resize(BINS + 1, 0);
    for values in band.values.chunks(LANES) {
        for bin in sixteen_bins(values) {
            band.histogram[bin as usize] += 1;
        }
    }
}

for_each_isa! {
    fn judge(values: &[f32], mismatch: &mut Mismatch) = judge_kernel;
}

#[inline(always)]
fn judge_kernel(values: &[f32], mismatch: &mut Mismatch) {
    let (mut compared, mut sum) = ([0u32; LANES], [0.0f32; LANES]);
    for (step, values) in values.as_chunks::<LANES>().0.iter().enumerate() {
        for lane in 0..LANES {
            let magnitude = values[lane].abs();
            let capped = if magnitude < RESIDUAL_CAP {
                magnitude
            } else {
                RESIDUAL_CAP
            };
            let counts = !values[lane].is_nan();
            compared[lane] += u32::from(counts);
            sum[lane] += if counts { capped } else { 0.0 };
        }
        if (step + 1) % STEPS_MAX == 0 {
            mismatch.add(&mut compared, &mut sum);
        }
    }
    mismatch.add(&mut compared, &mut sum);
}

impl Mismatch {
    /// Single precision within some steps, double across, as with the normal equations.
    #[inline(always)]
    fn add(&mut self, compared: &mut [u32; LANES], sum: &mut Lanes) {
        self.compared += compared.iter().sum::<u32>() as usize;
        self.sum += sum.iter().map(|&value| f64::from(value)).sum::<f64>();
        *compared = [0; LANES];
        *sum = [0.0; LANES];
    }
}

for_each_isa! {
    fn collect(band: &mut Band, view: &LevelView<'_>, comparable: &mut usize) = collect_kernel;
}

#[inline(always)]
fn collect_kernel(band: &mut Band, view: &LevelView, comparable: &mut usize) {
    let LevelView { level, camera, .. } = view;
    let (width, stride) = (level.width, view.along.len());
    let points = &mut band.points;
    let size = stride * band.rows.len();
    for plane in [
        &mut points.luminance,
        &mut points.slope_x,
        &mut points.slope_y,
        &mut points.inverse_sd,
    ] {
        plane.resize(size, 0.0);
    }
    points.depth_m.clear();
    points.depth_m.resize(size, -1.0);
    let (fx, fy) = (0.5 * camera.fx as f32, 0.5 * camera.fy as f32);
    let inner = width - 2;
    for (row, y) in band.rows.clone().enumerate() {
        if y == 0 || y + 1 == level.height {
            continue;
        }
        let depths = around(&level.depth_m, width, inner, y);
        let [tau, left, right, above, below] = around(&level.luminance, width, inner, y);
        let variance = &level.variance[y * width + 1..][..inner];
        let at = row * stride + 1..row * stride + 1 + inner;
        let depth_m = &mut points.depth_m[at.clone()];
        let luminance = &mut points.luminance[at.clone()];
        let slope_x = &mut points.slope_x[at.clone()];
        let slope_y = &mut points.slope_y[at.clone()];
        let inverse_sd = &mut points.inverse_sd[at];
        let mut found = 0u32;
        for x in 0..inner {
            let mut predicted = true;
            for depths in &depths {
                predicted &= depths[x] > 0.0;
            }
            depth_m[x] = if predicted { depths[0][x] } else { -1.0 };
            found += u32::from(predicted);
            luminance[x] = tau[x];
            slope_x[x] = (right[x] - left[x]) * fx;
            slope_y[x] = (below[x] - above[x]) * fy;
            inverse_sd[x] = 1.0 / (variance[x] + SENSOR_VARIANCE).sqrt();
        }
        *comparable += found as usize;
    }
}

/// So many pixels of row `y` from the second on, those to their left, right, above and below.
#[inline(always)]
fn around(plane: &[f32], width: usize, count: usize, y: usize) -> [&[f32]; 5] {
    [(y, 1), (y, 0), (y, 2), (y - 1, 1), (y + 1, 1)].map(|(y, x)| &plane[y * width + x..][..count])
}

for_each_isa! {
    fn compare(band: &mut Band, view: &LevelView<'_>, motion: &Motion) = compare_kernel;
}

#[inline(always)]
fn compare_kernel(band: &mut Band, view: &LevelView, motion: &Motion) {
    let LevelView { level, camera, .. } = view;
    let (width, height) = (level.width, level.height);
    let observed = level.observed.as_slice();
    assert!(
        observed.len() == width * height && width >= 2 && height >= 2,
        "one value a pixel"
    );
    let (right, bottom) = ((width - 1) as f32, (height - 1) as f32);
    let (fx, fy) = (camera.fx as f32, camera.fy as f32);
    let (cx, cy) = (camera.cx as f32, camera.cy as f32);
    let [a, b, c] = motion.rotation;
    let t = motion.translation;
    let points = &band.points;
    band.values.resize(points.depth_m.len(), 0.0);
    let along = view.along.as_chunks::<LANES>().0;
    let depth_m = points.depth_m.as_chunks::<LANES>().0;
    let luminance = points.luminance.as_chunks::<LANES>().0;
    let inverse_sd = points.inverse_sd.as_chunks::<LANES>().0;
    let values = band.values.as_chunks_mut::<LANES>().0;
    for (row, y) in band.rows.clone().enumerate() {
        let down = (y as f32 - cy) / fy;
        let start: [f32; 3] = [0, 1, 2].map(|axis| b[axis] * down + c[axis]);
        for (step, along) in along.iter().enumerate() {
            let at = row * view.steps() + step;
            let (depth_m, luminance) = (&depth_m[at], &luminance[at]);
            let mut pixel = [0u32; LANES];
            let mut inside = [0u32; LANES];
            let mut to_right: Lanes = [0.0; LANES];
            let mut to_below: Lanes = [0.0; LANES];
            for lane in 0..LANES {
                let (z, along) = (depth_m[lane], along[lane]);
                let q: [f32; 3] =
                    [0, 1, 2].map(|axis| z * (a[axis] * along + start[axis]) + t[axis]);
                let inverse = 1.0 / q[2];
                let u = fx * (q[0] * inverse) + cx;
                let v = fy * (q[1] * inverse) + cy;
                let is_inside =
                    (z > 0.0) & (q[2] > 0.0) & (u >= 0.0) & (v >= 0.0) & (u < right) & (v < bottom);
                let (u, v) = if is_inside { (u, v) } else { (0.0, 0.0) };
                // SAFETY: neither is below 0 or above 2^13, the longest side.
                let (column, row): (i32, i32) =
                    unsafe { (u.to_int_unchecked(), v.to_int_unchecked()) };
                to_right[lane] = u - column as f32;
                to_below[lane] = v - row as f32;
                pixel[lane] = row as u32 * width as u32 + column as u32;
                inside[lane] = u32::from(is_inside);
            }
            // Two neighbours a load.
            let mut pairs = [[[0.0f32; 2]; LANES]; 2];
            for lane in 0..LANES {
                let pixel = pixel[lane] as usize;
                // SAFETY: the column is below `width - 1` and the row below `height - 1`, or both are 0; the image has
                // `width * height` values, at least 2x2. An array of `f32` needs no more alignment than one does.
                unsafe {
                    pairs[0][lane] = *observed.as_ptr().add(pixel).cast();
                    pairs[1][lane] = *observed.as_ptr().add(pixel + width).cast();
                }
            }
            for lane in 0..LANES {
                let (right, down) = (to_right[lane], to_below[lane]);
                let [upper, lower] = [0, 1]
                    .map(|row| pairs[row][lane][0] * (1.0 - right) + pairs[row][lane][1] * right);
                let observed = upper * (1.0 - down) + lower * down;
                let residual = observed - motion.gain * luminance[lane] - motion.offset;
                let normalised = residual * inverse_sd[at][lane];
                values[at][lane] = if inside[lane] != 0 {
                    normalised
                } else {
                    f32::NAN
                };
            }
        }
    }
}

for_each_isa! {
    fn accumulate(
        band: &mut Band,
        view: &LevelView<'_>,
        gain: f32,
        tukey: Tukey,
    ) = accumulate_kernel;
}

#[inline(always)]
fn accumulate_kernel(band: &mut Band, view: &LevelView, gain: f32, tukey: Tukey) {
    let camera = view.camera;
    let (fy, cy) = (camera.fy as f32, camera.cy as f32);
    let inverse_scale2 = 1.0 / (tukey.scale * tukey.scale);
    let inverse_cutoff = 1.0 / tukey.cutoff;
    let points = &band.points;
    let along = view.along.as_chunks::<LANES>().0;
    let depth_m = points.depth_m.as_chunks::<LANES>().0;
    let luminance = points.luminance.as_chunks::<LANES>().0;
    let slope_x = points.slope_x.as_chunks::<LANES>().0;
    let slope_y = points.slope_y.as_chunks::<LANES>().0;
    let inverse_sd = points.inverse_sd.as_chunks::<LANES>().0;
    let values = band.values.as_chunks::<LANES>().0;
    band.sums = [0.0; HESSIAN + 8];
    let mut parts = [[0.0f32; LANES]; HESSIAN + 8];
    let mut steps = 0;
    for (row, y) in band.rows.clone().enumerate() {
        let b = (y as f32 - cy) / fy;
        for (step, along) in along.iter().enumerate() {
            let at = row * view.steps() + step;
            let mut j = [[1.0f32; LANES]; 8];
            let mut weight: Lanes = [0.0; LANES];
            let mut weighted_residual: Lanes = [0.0; LANES];
            for lane in 0..LANES {
                // grad tau * d pi / d X, X = z (a, b, 1), then [I | -[X]x].
                let a = along[lane];
                let (x, y) = (gain * slope_x[at][lane], gain * slope_y[at][lane]);
                let z = -(x * a + y * b);
                let inverse = 1.0 / depth_m[at][lane];
                j[0][lane] = x * inverse;
                j[1][lane] = y * inverse;
                j[2][lane] = z * inverse;
                j[3][lane] = b * z - y;
                j[4][lane] = x - a * z;
                j[5][lane] = a * y - b * x;
                j[6][lane] = luminance[at][lane];
                // NaN left the image.
                let value = values[at][lane];
                let counts = value.abs() < tukey.cutoff;
                let share = value * inverse_cutoff;
                let kept = 1.0 - share * share;
                let inverse_sd = inverse_sd[at][lane];
                let w = kept * kept * inverse_sd * inverse_scale2;
                weight[lane] = if counts { w * inverse_sd } else { 0.0 };
                weighted_residual[lane] = if counts { w * value } else { 0.0 };
            }
            let mut entry = 0;
            for row in 0..8 {
                let mut weighted = [0.0f32; LANES];
                for lane in 0..LANES {
                    weighted[lane] = weight[lane] * j[row][lane];
                    parts[HESSIAN + row][lane] += weighted_residual[lane] * j[row][lane];
                }
                for j in &j[row..] {
                    for lane in 0..LANES {
                        parts[entry][lane] += weighted[lane] * j[lane];
                    }
                    entry += 1;
                }
            }
            // Single precision within some steps, double across: the sums keep their digits.
            steps += 1;
            if steps % STEPS_MAX == 0 {
                flush(&mut parts, &mut band.sums);
            }
        }
    }
    flush(&mut parts, &mut band.sums);
}

#[inline(always)]
fn flush(parts: &mut [[f32; LANES]; HESSIAN + 8], sums: &mut NormalSums) {
    for (sum, part) in sums.iter_mut().zip(parts) {
        *sum += part.iter().map(|&value| f64::from(value)).sum::<f64>();
        *part = [0.0; LANES];
    }
}
