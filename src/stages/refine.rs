//! Corrects a given pose against the image that the memory expects there (step 1 of the robust preset).
//!
//! Nearest viewpoints at half resolution, observed luminance, pose and its noise -> the refined pose. Inverse
//! compositional Gauss-Newton from coarse to fine over a rigid motion, a gain and an offset, with Tukey weights scaled by
//! the predicted variance and a prior from the stated noise. Pose error is the root of false alarms at edges; the paper
//! takes poses as given.

use nalgebra::{Isometry3, SMatrix, SVector, Translation3, UnitQuaternion, Vector3};

use crate::{
    isa::{Isa, for_each_isa},
    lanes::LANES,
    model::{
        camera::Intrinsics,
        pose::{Pose, PoseNoise},
        viewpoint::Coarse,
    },
    stages::interpolate::project::{
        ProjectScratch, Projector, Reach, Sample, draw, map_size, sample_depth_m, sample_position,
    },
};

/// Three views predict as well as seven, at less than half the cost.
pub const REFINE_VIEWS: usize = 3;

/// Less noise than this is not believed: it would tie refinement to a tracker's own errors.
const POSITION_SD_MIN_M: f64 = 0.002;
const ROTATION_SD_MIN_RAD: f64 = 0.2 * std::f64::consts::PI / 180.0;
/// Prior of the gain around 1 and of the offset around 0, grey levels.
const GAIN_SD: f64 = 0.2;
const OFFSET_SD: f64 = 10.0;
/// Errors are correlated from pixel to pixel: so many pixels of a 320x240 image count as one. With 25 instead of 1600
/// the memory's poses drift by 20 mm along a pass.
const CORRELATED_PIXELS: f64 = 1600.0;
const CORRELATED_PIXELS_OF: f64 = 320.0 * 240.0;
/// Variance of the sensor on top of what the belief predicts, squared grey levels.
const SENSOR_VARIANCE: f32 = 9.0;
/// Tukey's constant: 95 % efficiency for normal errors.
const TUKEY: f32 = 4.685;
/// Standard deviation of normal errors from the median of their magnitude.
const NORMAL_FROM_MEDIAN: f32 = 1.4826;
/// Bounds of the residuals' scale, in predicted standard deviations.
const SCALE_MIN: f32 = 0.1;
const SCALE_MAX: f32 = 3.0;
pub const ITERATIONS: usize = 4;
/// A correction beyond this many standard deviations of the stated noise is refused. 6 makes frames flash.
const CORRECTION_SD_MAX: f64 = 20.0;
/// Where a residual stops counting in the test whether refinement helped, predicted standard deviations.
const RESIDUAL_CAP: f32 = 4.0;
/// Mean of what counts from which the image shows another scene: half of it fits nothing that is expected. Gain and
/// offset alone make any two images fit better than before, so improvement is no proof.
const MISMATCH_MAX: f64 = 2.0;
/// Fewer comparable pixels on a level say nothing about a pose.
pub const PIXELS_MIN: usize = 200;
/// Expected pose error, pixels of the full image, from which a third and a fourth level are needed to catch it.
const THIRD_LEVEL_PX: f64 = 2.5;
const FOURTH_LEVEL_PX: f64 = 4.0;
pub const LEVELS_MAX: usize = 4;
/// Views whose depth differs by more than this share from the middle one do not predict a pixel.
const DEPTH_TOLERANCE: f32 = 0.03;

type Vector8 = SVector<f64, 8>;
type Matrix8 = SMatrix<f64, 8, 8>;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Refined {
    pub world_from_camera: Pose,
    pub correction_m: f64,
    pub correction_rad: f64,
}

impl Refined {
    pub fn unchanged(world_from_camera: Pose) -> Self {
        Self {
            world_from_camera,
            correction_m: 0.0,
            correction_rad: 0.0,
        }
    }

    pub fn moved(world_from_given: &Pose, given_from_real: &Pose) -> Self {
        Self {
            world_from_camera: world_from_given * given_from_real,
            correction_m: given_from_real.translation.vector.norm(),
            correction_rad: given_from_real.rotation.angle(),
        }
    }
}

/// The noise that refinement assumes.
pub fn believed(noise: PoseNoise) -> PoseNoise {
    PoseNoise {
        position_m: noise.position_m.max(POSITION_SD_MIN_M),
        rotation_rad: noise.rotation_rad.max(ROTATION_SD_MIN_RAD),
    }
}

/// How many pixels of a level count as one; level 0 is half the image, which has so many.
pub fn discount(image_pixels: usize, level: usize) -> f64 {
    let scale = image_pixels as f64 / CORRELATED_PIXELS_OF;
    (CORRELATED_PIXELS * scale / 4f64.powi(level as i32 + 1)).max(1.0)
}

/// Inverse variances of the prior of translation, rotation, gain and offset.
pub fn precision(noise: PoseNoise) -> [f64; 8] {
    let (m, rad) = (noise.position_m, noise.rotation_rad);
    [m, m, m, rad, rad, rad, GAIN_SD, OFFSET_SD].map(|sd| 1.0 / (sd * sd))
}

/// The refined pose, if it explains the image better than the given one and lies within what the noise allows.
/// Mismatches are mean capped residuals, predicted standard deviations.
fn accepted(
    world_from_given: &Pose,
    given_from_real: &Pose,
    noise: PoseNoise,
    mismatch_before: f64,
    mismatch_after: f64,
) -> Option<Refined> {
    let improved = mismatch_after < MISMATCH_MAX && mismatch_after < mismatch_before;
    let motion = logarithm(given_from_real);
    let in_bounds = (0..6).all(|axis| {
        let sd = if axis < 3 {
            noise.position_m
        } else {
            noise.rotation_rad
        };
        motion[axis].abs() < CORRECTION_SD_MAX * sd
    });
    (improved && in_bounds).then(|| Refined::moved(world_from_given, given_from_real))
}

/// Luminance, variance and depth that the memory predicts, or what was observed, at one resolution.
#[derive(Default)]
struct Level {
    width: usize,
    height: usize,
    /// Predicted Y; the depth is 0 where nothing is predicted.
    luminance: Vec<f32>,
    variance: Vec<f32>,
    depth_m: Vec<f32>,
    observed: Vec<f32>,
}

/// The comparable pixels: everything about them that does not change while the pose does, a plane a value, padded to
/// whole steps by points behind the camera.
#[derive(Default)]
struct Points {
    count: usize,
    in_camera: [Vec<f32>; 3],
    /// d tau / d (translation, rotation) of the template, without the gain.
    jacobian: [Vec<f32>; 6],
    luminance: Vec<f32>,
    inverse_sd: Vec<f32>,
}

impl Points {
    fn planes(&mut self) -> impl Iterator<Item = &mut Vec<f32>> {
        self.in_camera
            .iter_mut()
            .chain(&mut self.jacobian)
            .chain([&mut self.luminance, &mut self.inverse_sd])
    }

    fn clear(&mut self) {
        self.count = 0;
        self.planes().for_each(Vec::clear);
    }

    #[inline(always)]
    fn push(&mut self, in_camera: [f32; 3], jacobian: [f32; 6], luminance: f32, inverse_sd: f32) {
        let values = in_camera
            .into_iter()
            .chain(jacobian)
            .chain([luminance, inverse_sd]);
        for (plane, value) in self.planes().zip(values) {
            plane.push(value);
        }
        self.count += 1;
    }

    fn pad(&mut self) {
        let padded = self.count.next_multiple_of(LANES);
        self.planes().for_each(|plane| plane.resize(padded, 0.0));
        self.in_camera[2][self.count..].fill(-1.0);
    }
}

/// What is estimated: the real camera is `given * camera_from_real`, and Y = gain * tau + offset.
#[derive(Clone, Copy)]
struct Estimate {
    given_from_real: Isometry3<f64>,
    gain: f64,
    offset: f64,
}

/// Keeps its working memory between frames.
pub struct PoseRefiner {
    maps: Vec<Sample>,
    scratch: ProjectScratch,
    reach: Reach,
    residuals: Vec<f32>,
    magnitudes: Vec<f32>,
    points: Points,
    isa: Isa,
    pyramid: Vec<(Intrinsics, Level)>,
}

impl Default for PoseRefiner {
    fn default() -> Self {
        Self::new(Isa::detect())
    }
}

impl PoseRefiner {
    pub fn new(isa: Isa) -> Self {
        Self {
            isa,
            maps: Vec::new(),
            scratch: ProjectScratch::default(),
            reach: Reach::default(),
            residuals: Vec::new(),
            magnitudes: Vec::new(),
            points: Points::default(),
            pyramid: Vec::new(),
        }
    }

    /// `views` are nearest first with their weight in means; `observed` is the luminance of the full image. Returns the
    /// given pose where refinement does not help.
    pub fn refine(
        &mut self,
        views: &[(&Coarse, &Pose, f32)],
        observed: &[f32],
        intrinsics: &Intrinsics,
        world_from_camera: &Pose,
        noise: PoseNoise,
    ) -> Refined {
        let unchanged = Refined::unchanged(*world_from_camera);
        let noise = believed(noise);
        let mut pyramid = std::mem::take(&mut self.pyramid);
        pyramid.resize_with(LEVELS_MAX, Default::default);
        let refined = self.refine_levels(
            &mut pyramid,
            views,
            observed,
            intrinsics,
            world_from_camera,
            noise,
        );
        self.pyramid = pyramid;
        refined.unwrap_or(unchanged)
    }

    /// `None` where refinement does not help.
    fn refine_levels(
        &mut self,
        pyramid: &mut [(Intrinsics, Level)],
        views: &[(&Coarse, &Pose, f32)],
        observed: &[f32],
        intrinsics: &Intrinsics,
        world_from_camera: &Pose,
        noise: PoseNoise,
    ) -> Option<Refined> {
        let half = intrinsics.half();
        pyramid[0].0 = half;
        let finest = &mut pyramid[0].1;
        self.predict(views, &half, world_from_camera, finest);
        halve(
            self.isa,
            observed,
            intrinsics.width,
            intrinsics.height,
            &mut finest.observed,
        );
        let levels = self.level_count(finest, intrinsics, noise)?;
        for coarser in 1..levels {
            let (finer, rest) = pyramid.split_at_mut(coarser);
            let (camera, level) = &finer[coarser - 1];
            rest[0].0 = camera.half();
            halve_level(self.isa, level, &mut rest[0].1);
        }
        let pyramid = &pyramid[..levels];

        let start = Estimate {
            given_from_real: Isometry3::identity(),
            gain: 1.0,
            offset: 0.0,
        };
        let mut estimate = start;
        let mut mismatches = None;
        for (index, (camera, level)) in pyramid.iter().enumerate().rev() {
            collect_points(self.isa, level, camera, &mut self.points);
            if self.points.count < PIXELS_MIN {
                continue;
            }
            let discount = discount(intrinsics.pixels(), index);
            for _ in 0..ITERATIONS {
                let Some(next) = self.step(&estimate, level, camera, noise, discount) else {
                    break;
                };
                estimate = next;
            }
            if index == 0 {
                let before = self.mismatch(&start, level, camera);
                mismatches = Some((before, self.mismatch(&estimate, level, camera)));
            }
        }
        let (before, after) = mismatches?;
        accepted(
            world_from_camera,
            &estimate.given_from_real,
            noise,
            before,
            after,
        )
    }

    /// The views' luminance, variance and depth at the given pose.
    fn predict(
        &mut self,
        views: &[(&Coarse, &Pose, f32)],
        camera: &Intrinsics,
        world_from_camera: &Pose,
        level: &mut Level,
    ) {
        let map_size = map_size(camera.pixels());
        let views = &views[..views.len().min(REFINE_VIEWS)];
        self.maps.clear();
        self.maps.resize(map_size * REFINE_VIEWS, 0);
        for ((coarse, world_from_view, _), map) in
            views.iter().zip(self.maps.chunks_exact_mut(map_size))
        {
            let projector = Projector::new(
                &coarse.mesh,
                world_from_view,
                camera,
                world_from_camera,
                &mut self.reach,
            );
            let rows = 0..camera.height;
            draw(
                self.isa,
                &projector,
                camera.width,
                rows,
                map,
                &mut self.scratch,
            );
        }
        level.resize(camera.width, camera.height);
        expect(self.isa, views, &self.maps, level);
    }

    /// One Gauss-Newton step; `None` when too little of the view is left.
    fn step(
        &mut self,
        estimate: &Estimate,
        level: &Level,
        camera: &Intrinsics,
        noise: PoseNoise,
        discount: f64,
    ) -> Option<Estimate> {
        let compared = self.compute_residuals(estimate, level, camera);
        if compared < PIXELS_MIN {
            return None;
        }
        let scale = self.residual_scale();
        let cutoff = TUKEY * scale;
        let mut sums = [0.0f64; HESSIAN + 8];
        accumulate(
            self.isa,
            &self.points,
            &self.residuals,
            estimate.gain as f32,
            (scale, cutoff),
            &mut sums,
        );
        let (hessian_sum, gradient_sum) = sums.split_at(HESSIAN);
        let mut normal = Matrix8::zeros();
        let mut entry = 0;
        for row in 0..8 {
            for column in row..8 {
                normal[(row, column)] = hessian_sum[entry] / discount;
                normal[(column, row)] = normal[(row, column)];
                entry += 1;
            }
        }
        let mut right = Vector8::from_column_slice(gradient_sum) / discount;
        let motion = logarithm(&estimate.given_from_real);
        for (axis, precision) in precision(noise).into_iter().enumerate() {
            let deviation = match axis {
                0..6 => motion[axis],
                6 => estimate.gain - 1.0,
                _ => estimate.offset,
            };
            normal[(axis, axis)] += precision;
            right[axis] -= precision * deviation;
        }
        let d = normal.cholesky()?.solve(&right);
        // The template moved by d: the real camera sees its point X at (exp(d) E)^-1 X.
        Some(Estimate {
            given_from_real: exponential(&d) * estimate.given_from_real,
            gain: estimate.gain + d[6],
            offset: estimate.offset + d[7],
        })
    }

    /// Y(pi(M X)) - gain * tau - offset for every point, NaN where that leaves the image; returns how many do not.
    fn compute_residuals(
        &mut self,
        estimate: &Estimate,
        level: &Level,
        camera: &Intrinsics,
    ) -> usize {
        let real_from_given = estimate.given_from_real.inverse();
        let rotation = real_from_given
            .rotation
            .to_rotation_matrix()
            .matrix()
            .cast::<f32>();
        let translation = real_from_given.translation.vector.cast::<f32>();
        let (gain, offset) = (estimate.gain as f32, estimate.offset as f32);
        let (fx, fy) = (camera.fx as f32, camera.fy as f32);
        let (cx, cy) = (camera.cx as f32, camera.cy as f32);
        let motion = Motion {
            rotation: rotation.into(),
            translation: translation.into(),
            focal: (fx, fy),
            center: (cx, cy),
            gain,
            offset,
        };
        self.residuals.resize(self.points.luminance.len(), 0.0);
        let mut compared = 0;
        compare(
            self.isa,
            &self.points,
            level,
            &motion,
            &mut self.residuals,
            &mut compared,
        );
        compared
    }

    /// How many levels catch the expected error; `None` when nothing is predicted.
    fn level_count(
        &mut self,
        finest: &Level,
        intrinsics: &Intrinsics,
        noise: PoseNoise,
    ) -> Option<usize> {
        let depths = finest.depth_m.iter().copied().filter(|z| *z > 0.0);
        if depths.clone().count() < PIXELS_MIN {
            return None;
        }
        let median_m = middle(depths, &mut self.magnitudes);
        let from_position = intrinsics.fx * noise.position_m / f64::from(median_m);
        let from_rotation = intrinsics.fx * noise.rotation_rad;
        let error_px = from_position.hypot(from_rotation);
        Some(2 + usize::from(error_px > THIRD_LEVEL_PX) + usize::from(error_px > FOURTH_LEVEL_PX))
    }

    /// 1.4826 times the median of the residuals' magnitude in predicted standard deviations.
    fn residual_scale(&mut self) -> f32 {
        let magnitudes = self
            .residuals
            .iter()
            .zip(&self.points.inverse_sd)
            .filter(|(residual, _)| !residual.is_nan())
            .map(|(residual, inverse_sd)| residual.abs() * inverse_sd);
        let median = middle(magnitudes, &mut self.magnitudes);
        (NORMAL_FROM_MEDIAN * median).clamp(SCALE_MIN, SCALE_MAX)
    }

    /// Mean capped residual, predicted standard deviations.
    fn mismatch(&mut self, estimate: &Estimate, level: &Level, camera: &Intrinsics) -> f64 {
        let compared = self.compute_residuals(estimate, level, camera);
        let sum: f64 = self
            .residuals
            .iter()
            .zip(&self.points.inverse_sd)
            .filter(|(residual, _)| !residual.is_nan())
            .map(|(residual, inverse_sd)| {
                f64::from((residual.abs() * inverse_sd).min(RESIDUAL_CAP))
            })
            .sum();
        if compared == 0 {
            f64::INFINITY
        } else {
            sum / compared as f64
        }
    }
}

impl Level {
    fn resize(&mut self, width: usize, height: usize) {
        (self.width, self.height) = (width, height);
        for plane in [&mut self.luminance, &mut self.variance, &mut self.depth_m] {
            plane.clear();
            plane.resize(width * height, 0.0);
        }
    }
}

for_each_isa! {
    /// Means over 2x2; predicted where at least three of the four are.
    fn halve_level(fine: &Level, level: &mut Level) = halve_level_kernel;
}

#[inline(always)]
fn halve_level_kernel(fine: &Level, level: &mut Level) {
    let (width, height) = (fine.width / 2, fine.height / 2);
    level.resize(width, height);
    halve_kernel(&fine.observed, fine.width, fine.height, &mut level.observed);
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
    fn halve(plane: &[f32], width: usize, height: usize, half: &mut Vec<f32>) = halve_kernel;
}

#[inline(always)]
fn halve_kernel(plane: &[f32], width: usize, height: usize, half: &mut Vec<f32>) {
    half.clear();
    for rows in plane.chunks_exact(2 * width).take(height / 2) {
        let (upper, lower) = rows.split_at(width);
        half.extend(
            upper
                .chunks_exact(2)
                .zip(lower.chunks_exact(2))
                .map(|(upper, lower)| (upper[0] + upper[1] + lower[0] + lower[1]) / 4.0),
        );
    }
}

/// The value with as many below as above, of positive values and zeros; 0 of none. Two passes over the bits find the
/// same as sorting would.
fn middle(values: impl Iterator<Item = f32> + Clone, work: &mut Vec<f32>) -> f32 {
    const SHIFT: u32 = 20;
    let mut histogram = [0usize; 1 << (32 - SHIFT)];
    let mut count = 0;
    for value in values.clone() {
        histogram[(value.to_bits() >> SHIFT) as usize] += 1;
        count += 1;
    }
    let mut rank = count / 2;
    for (bin, &members) in histogram.iter().enumerate() {
        if rank < members {
            work.clear();
            work.extend(values.filter(|value| (value.to_bits() >> SHIFT) as usize == bin));
            return *work.select_nth_unstable_by(rank, f32::total_cmp).1;
        }
        rank -= members;
    }
    0.0
}

/// Products of two of eight derivatives.
const HESSIAN: usize = 36;

for_each_isa! {
    /// Adds up the weighted normal equations: the upper triangle row by row, then the gradient. `(scale, cutoff)` are
    /// Tukey's, predicted standard deviations.
    fn accumulate(
        points: &Points,
        residuals: &[f32],
        gain: f32,
        tukey: (f32, f32),
        sums: &mut [f64; HESSIAN + 8],
    ) = accumulate_kernel;
}

#[inline(always)]
fn accumulate_kernel(
    points: &Points,
    residuals: &[f32],
    gain: f32,
    (scale, cutoff): (f32, f32),
    sums: &mut [f64; HESSIAN + 8],
) {
    let inverse_scale2 = 1.0 / (scale * scale);
    let mut parts = [[0.0f32; LANES]; HESSIAN + 8];
    for (step, residuals) in residuals.chunks_exact(LANES).enumerate() {
        let at = step * LANES..(step + 1) * LANES;
        let inverse_sd = &points.inverse_sd[at.clone()];
        let luminance = &points.luminance[at.clone()];
        let mut j = [[1.0f32; LANES]; 8];
        for (j, jacobian) in j.iter_mut().zip(&points.jacobian) {
            for (j, jacobian) in j.iter_mut().zip(&jacobian[at.clone()]) {
                *j = gain * jacobian;
            }
        }
        j[6].copy_from_slice(luminance);
        let mut weight = [0.0f32; LANES];
        let mut residual = [0.0f32; LANES];
        for lane in 0..LANES {
            // In predicted standard deviations; NaN left the image.
            let normalised = residuals[lane] * inverse_sd[lane];
            let counts = normalised.abs() < cutoff;
            let share = normalised / cutoff;
            let tukey = 1.0 - share * share;
            let w = tukey * tukey * inverse_sd[lane] * inverse_sd[lane] * inverse_scale2;
            weight[lane] = if counts { w } else { 0.0 };
            residual[lane] = if counts { residuals[lane] } else { 0.0 };
        }
        let mut entry = 0;
        for row in 0..8 {
            let mut weighted = [0.0f32; LANES];
            for lane in 0..LANES {
                weighted[lane] = weight[lane] * j[row][lane];
                parts[HESSIAN + row][lane] += weighted[lane] * residual[lane];
            }
            for j in &j[row..] {
                for lane in 0..LANES {
                    parts[entry][lane] += weighted[lane] * j[lane];
                }
                entry += 1;
            }
        }
        // Single precision within a chunk, double across: the sums keep their digits.
        if step % 64 == 63 {
            flush(&mut parts, sums);
        }
    }
    flush(&mut parts, sums);
}

#[inline(always)]
fn flush(parts: &mut [[f32; LANES]; HESSIAN + 8], sums: &mut [f64; HESSIAN + 8]) {
    for (sum, part) in sums.iter_mut().zip(parts) {
        *sum += part.iter().map(|&value| f64::from(value)).sum::<f64>();
        *part = [0.0; LANES];
    }
}

/// How the points are seen by an estimate.
struct Motion {
    /// Column by column.
    rotation: [[f32; 3]; 3],
    translation: [f32; 3],
    focal: (f32, f32),
    center: (f32, f32),
    gain: f32,
    offset: f32,
}

for_each_isa! {
    /// Residuals of all points, NaN where they leave the image, and how many do not.
    fn compare(
        points: &Points,
        level: &Level,
        motion: &Motion,
        residuals: &mut [f32],
        compared: &mut usize,
    ) = compare_kernel;
}

#[inline(always)]
fn compare_kernel(
    points: &Points,
    level: &Level,
    motion: &Motion,
    residuals: &mut [f32],
    compared: &mut usize,
) {
    let (right, bottom) = ((level.width - 1) as f32, (level.height - 1) as f32);
    let [a, b, c] = motion.rotation;
    let t = motion.translation;
    for (step, residuals) in residuals.chunks_exact_mut(LANES).enumerate() {
        let at = step * LANES..(step + 1) * LANES;
        let [xs, ys, zs] = &points.in_camera;
        let (xs, ys, zs) = (&xs[at.clone()], &ys[at.clone()], &zs[at.clone()]);
        let luminance = &points.luminance[at];
        let mut pixel = [0usize; LANES];
        let mut inside = [false; LANES];
        let mut fraction = [[0.0f32; LANES]; 2];
        for lane in 0..LANES {
            let (x, y, z) = (xs[lane], ys[lane], zs[lane]);
            let q: [f32; 3] =
                [0, 1, 2].map(|axis| a[axis] * x + b[axis] * y + c[axis] * z + t[axis]);
            let u = motion.focal.0 * q[0] / q[2] + motion.center.0;
            let v = motion.focal.1 * q[1] / q[2] + motion.center.1;
            inside[lane] =
                (z > 0.0) & (q[2] > 0.0) & (u >= 0.0) & (v >= 0.0) & (u < right) & (v < bottom);
            let (u, v) = if inside[lane] { (u, v) } else { (0.0, 0.0) };
            // Of at most 2^13.
            let (column, row) = (u as i32, v as i32);
            fraction[0][lane] = u - column as f32;
            fraction[1][lane] = v - row as f32;
            pixel[lane] = row as usize * level.width + column as usize;
        }
        for lane in 0..LANES {
            if !inside[lane] {
                residuals[lane] = f32::NAN;
                continue;
            }
            *compared += 1;
            let (right, down) = (fraction[0][lane], fraction[1][lane]);
            let upper = &level.observed[pixel[lane]..][..2];
            let lower = &level.observed[pixel[lane] + level.width..][..2];
            let upper = upper[0] * (1.0 - right) + upper[1] * right;
            let lower = lower[0] * (1.0 - right) + lower[1] * right;
            let observed = upper * (1.0 - down) + lower * down;
            residuals[lane] = observed - motion.gain * luminance[lane] - motion.offset;
        }
    }
}

for_each_isa! {
    /// Luminance, variance and depth from the maps of the views, each as [`map_size`] says.
    fn expect(
        views: &[(&Coarse, &Pose, f32)],
        maps: &[Sample],
        level: &mut Level,
    ) = expect_kernel;
}

#[inline(always)]
fn expect_kernel(views: &[(&Coarse, &Pose, f32)], maps: &[Sample], level: &mut Level) {
    let pixels = level.luminance.len();
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
        if count > 0 {
            let (luminance, variance, depth_m) = merge(&mut seen[..count]);
            level.luminance[pixel] = luminance;
            level.variance[pixel] = variance;
            level.depth_m[pixel] = depth_m;
        }
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
    /// The comparable pixels of a level: predicted together with their four neighbours.
    fn collect_points(level: &Level, camera: &Intrinsics, points: &mut Points) = collect_kernel;
}

#[inline(always)]
fn collect_kernel(level: &Level, camera: &Intrinsics, points: &mut Points) {
    points.clear();
    let width = level.width;
    let (fx, fy) = (camera.fx as f32, camera.fy as f32);
    let (cx, cy) = (camera.cx as f32, camera.cy as f32);
    for y in 1..level.height.saturating_sub(1) {
        for x in 1..width.saturating_sub(1) {
            let pixel = y * width + x;
            let around = [pixel, pixel - 1, pixel + 1, pixel - width, pixel + width];
            if around.iter().any(|&pixel| level.depth_m[pixel] <= 0.0) {
                continue;
            }
            let tau = |pixel: usize| level.luminance[pixel];
            let slope_x = (tau(pixel + 1) - tau(pixel - 1)) / 2.0 * fx;
            let slope_y = (tau(pixel + width) - tau(pixel - width)) / 2.0 * fy;
            let z = level.depth_m[pixel];
            let (a, b) = ((x as f32 - cx) / fx, (y as f32 - cy) / fy);
            // grad tau * d pi / d X, X = z (a, b, 1), then [I | -[X]x].
            let g = [slope_x / z, slope_y / z, -(slope_x * a + slope_y * b) / z];
            let in_camera = [a * z, b * z, z];
            let [px, py, pz] = in_camera;
            let jacobian = [
                g[0],
                g[1],
                g[2],
                py * g[2] - pz * g[1],
                pz * g[0] - px * g[2],
                px * g[1] - py * g[0],
            ];
            let inverse_sd = 1.0 / (level.variance[pixel] + SENSOR_VARIANCE).sqrt();
            points.push(in_camera, jacobian, tau(pixel), inverse_sd);
        }
    }
    points.pad();
}

/// (translation, rotation vector) of a small motion.
fn logarithm(motion: &Isometry3<f64>) -> SVector<f64, 6> {
    let (t, r) = (motion.translation.vector, motion.rotation.scaled_axis());
    SVector::from([t.x, t.y, t.z, r.x, r.y, r.z])
}

fn exponential(d: &Vector8) -> Isometry3<f64> {
    Isometry3::from_parts(
        Translation3::new(d[0], d[1], d[2]),
        UnitQuaternion::from_scaled_axis(Vector3::new(d[3], d[4], d[5])),
    )
}
