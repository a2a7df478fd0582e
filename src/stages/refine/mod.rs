//! Corrects a given pose against the image that the memory expects there (step 1 of the robust preset).
//!
//! Nearest viewpoints at half resolution, observed luminance, pose and its noise -> the refined pose. Inverse
//! compositional Gauss-Newton from coarse to fine over a rigid motion, a gain and an offset, with Tukey weights scaled by
//! the predicted variance and a prior from the stated noise. Pose error is the root of false alarms at edges; the paper
//! takes poses as given.

mod band;

mod level;

use arrayvec::ArrayVec;
use nalgebra::{Isometry3, SMatrix, SVector, Translation3, UnitQuaternion, Vector3};
use rayon::prelude::*;

use crate::{
    isa::Isa,
    lanes::LANES,
    model::{
        camera::Intrinsics,
        pose::{Pose, PoseNoise},
        viewpoint::Coarse,
    },
    pool::Pool,
    stages::interpolate::{project::Projector, reach::Reach},
};

use band::{Band, HESSIAN, LevelView, Mismatch, Motion, Tukey, band_rows, divide, middle};
use level::{Level, LevelRows, halve, halve_level};

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
/// Tukey's constant: 95 % efficiency for normal errors.
const TUKEY: f32 = 4.685;
/// Standard deviation of normal errors from the median of their magnitude.
const NORMAL_FROM_MEDIAN: f32 = 1.4826;
/// Bounds of the residuals' scale, in predicted standard deviations.
const SCALE_MIN: f32 = 0.1;
const SCALE_MAX: f32 = 3.0;
pub const ITERATIONS: usize = 4;
/// A step below this share of the least standard deviations that are believed is the last of its level: some hundredths
/// of its pixels, and those after it are shorter still.
const SETTLED: f64 = 0.01;
/// A correction beyond this many standard deviations of the stated noise is refused. 6 makes frames flash.
const CORRECTION_SD_MAX: f64 = 20.0;
/// Mean of what counts from which the image shows another scene: half of it fits nothing that is expected. Gain and
/// offset alone make any two images fit better than before, so improvement is no proof.
const MISMATCH_MAX: f64 = 2.0;
/// Fewer comparable pixels on a level say nothing about a pose.
pub const PIXELS_MIN: usize = 200;
/// Expected pose error, pixels of the full image, from which a third and a fourth level are needed to catch it.
const THIRD_LEVEL_PX: f64 = 2.5;
const FOURTH_LEVEL_PX: f64 = 4.0;
pub const LEVELS_MAX: usize = 4;

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

/// What is estimated: the real camera is `given * camera_from_real`, and Y = gain * tau + offset.
#[derive(Clone, Copy)]
struct Estimate {
    given_from_real: Isometry3<f64>,
    gain: f64,
    offset: f64,
}

impl Estimate {
    fn motion(&self) -> Motion {
        let real_from_given = self.given_from_real.inverse();
        let rotation = real_from_given.rotation.to_rotation_matrix();
        Motion {
            rotation: rotation.matrix().cast::<f32>().into(),
            translation: real_from_given.translation.vector.cast::<f32>().into(),
            gain: self.gain as f32,
            offset: self.offset as f32,
        }
    }

    /// One step of Gauss-Newton, and whether it matters on a level.
    fn moved(&self, d: &Vector8, level: usize) -> (Self, bool) {
        let (m, rad) = (POSITION_SD_MIN_M, ROTATION_SD_MIN_RAD);
        let settled = SETTLED * f64::from(1 << level);
        let matters = [m, m, m, rad, rad, rad, GAIN_SD, OFFSET_SD]
            .into_iter()
            .zip(d)
            .any(|(sd, d)| d.abs() > settled * sd);
        // The template moved by d: the real camera sees its point X at (exp(d) E)^-1 X.
        let moved = Self {
            given_from_real: exponential(d) * self.given_from_real,
            gain: self.gain + d[6],
            offset: self.offset + d[7],
        };
        (moved, matters)
    }
}

/// Keeps its working memory between frames.
pub struct PoseRefiner {
    isa: Isa,
    /// `None`: the caller's thread alone.
    pool: Option<Pool>,
    work: Work,
}

#[derive(Default)]
struct Work {
    reaches: [Reach; REFINE_VIEWS],
    pyramid: Vec<(Intrinsics, Level)>,
    bands: Vec<Band>,
    /// As [`LevelView`] has it.
    along: Vec<f32>,
}

/// Fewer bands are done sooner than they are shared out.
const SHARED_BANDS_MIN: usize = 4;

/// How the bands are worked on.
#[derive(Clone, Copy)]
struct Crew {
    isa: Isa,
    is_alone: bool,
}

impl Crew {
    fn each(self, bands: &mut [Band], work: impl Fn(&mut Band) + Send + Sync) {
        self.sum(bands, |band| {
            work(band);
            0
        });
    }

    fn sum(self, bands: &mut [Band], work: impl Fn(&mut Band) -> usize + Send + Sync) -> usize {
        if self.is_alone || bands.len() < SHARED_BANDS_MIN {
            bands.iter_mut().map(work).sum()
        } else {
            bands.par_iter_mut().with_max_len(1).map(work).sum()
        }
    }
}

impl Default for PoseRefiner {
    fn default() -> Self {
        Self {
            isa: Isa::detect(),
            pool: None,
            work: Work::default(),
        }
    }
}

impl PoseRefiner {
    /// `pool` may be shared.
    pub fn new(pool: impl Into<Pool>, isa: Isa) -> Self {
        Self {
            isa,
            pool: Some(pool.into()),
            work: Work::default(),
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
        let pool = self.pool.as_ref().filter(|pool| !pool.is_taken());
        let crew = Crew {
            isa: self.isa,
            is_alone: pool.is_none(),
        };
        let question = Question {
            views: &views[..views.len().min(REFINE_VIEWS)],
            observed,
            intrinsics,
            world_from_camera,
            noise: believed(noise),
        };
        let work = &mut self.work;
        let refined = match pool {
            Some(pool) => pool.install(|| work.refine(crew, &question)),
            None => work.refine(crew, &question),
        };
        refined.unwrap_or(Refined::unchanged(*world_from_camera))
    }
}

/// What [`PoseRefiner::refine`] is asked.
struct Question<'a> {
    views: &'a [(&'a Coarse, &'a Pose, f32)],
    observed: &'a [f32],
    intrinsics: &'a Intrinsics,
    world_from_camera: &'a Pose,
    noise: PoseNoise,
}

impl Work {
    /// `None` where refinement does not help.
    fn refine(&mut self, crew: Crew, question: &Question) -> Option<Refined> {
        let noise = question.noise;
        if question.intrinsics.half().pixels() < PIXELS_MIN {
            return None;
        }
        self.pyramid.resize_with(LEVELS_MAX, Default::default);
        self.predict(crew, question);
        let levels = self.level_count(question)?;
        for coarser in 1..levels {
            let (finer, rest) = self.pyramid.split_at_mut(coarser);
            let (camera, level) = &finer[coarser - 1];
            rest[0].0 = camera.half();
            halve_level(crew.isa, level, &mut rest[0].1);
        }
        let start = Estimate {
            given_from_real: Isometry3::identity(),
            gain: 1.0,
            offset: 0.0,
        };
        let mut estimate = start;
        let mut mismatches = None;
        for index in (0..levels).rev() {
            let (camera, level) = &self.pyramid[index];
            if level.width < 3 || level.height < 3 {
                continue;
            }
            let (fx, cx) = (camera.fx as f32, camera.cx as f32);
            let columns = 0..level.width.next_multiple_of(LANES);
            self.along.clear();
            self.along.extend(columns.map(|x| (x as f32 - cx) / fx));
            let view = LevelView {
                level,
                camera,
                along: &self.along,
            };
            let mut comparison = Comparison {
                crew,
                view,
                bands: divide(&mut self.bands, level.width, level.height),
            };
            if comparison.begin(&estimate) < PIXELS_MIN {
                continue;
            }
            let discount = discount(question.intrinsics.pixels(), index);
            for iteration in 1..=ITERATIONS {
                let Some(d) = comparison.step(&estimate, noise, discount) else {
                    break;
                };
                let (next, matters) = estimate.moved(&d, index);
                estimate = next;
                if !matters || iteration == ITERATIONS {
                    break;
                }
                comparison.compare(&estimate);
            }
            if index == 0 {
                mismatches = Some(comparison.mismatches([&start, &estimate]));
            }
        }
        let [before, after] = mismatches?;
        accepted(
            question.world_from_camera,
            &estimate.given_from_real,
            noise,
            before,
            after,
        )
    }

    /// The finest level: the views' luminance, variance and depth at the given pose, and what was observed. The bands hold
    /// the depths then.
    fn predict(&mut self, crew: Crew, question: &Question) {
        let Question {
            views,
            observed,
            intrinsics,
            world_from_camera,
            ..
        } = *question;
        let half = intrinsics.half();
        let (camera, level) = &mut self.pyramid[0];
        *camera = half;
        level.resize(half.width, half.height);
        for ((coarse, world_from_view, _), reach) in views.iter().zip(&mut self.reaches) {
            reach.aim(
                crew.isa,
                &coarse.mesh,
                world_from_view,
                &half,
                world_from_camera,
            );
        }
        let projectors: ArrayVec<Projector, REFINE_VIEWS> = views
            .iter()
            .zip(&self.reaches)
            .map(|((coarse, _, _), reach)| Projector::new(&coarse.mesh, reach))
            .collect();
        let bands = divide(&mut self.bands, half.width, half.height);
        let band_pixels = band_rows(half.width) * half.width;
        let predict = |(band, (((luminance, variance), depth_m), halved)): (&mut Band, Planes)| {
            let first_row = band.rows.start;
            let observed = &observed[2 * first_row * intrinsics.width..];
            halve(crew.isa, observed, intrinsics.width, halved);
            let mut rows = LevelRows {
                luminance,
                variance,
                depth_m,
            };
            band.predict.predict(
                crew.isa,
                views,
                &projectors,
                half.width,
                first_row,
                &mut rows,
            );
            band.hold_depths(crew.isa, rows.depth_m);
        };
        type Planes<'a> = (
            ((&'a mut [f32], &'a mut [f32]), &'a mut [f32]),
            &'a mut [f32],
        );
        let Level {
            luminance,
            variance,
            depth_m,
            observed,
            ..
        } = level;
        if crew.is_alone {
            let planes = luminance
                .chunks_mut(band_pixels)
                .zip(variance.chunks_mut(band_pixels))
                .zip(depth_m.chunks_mut(band_pixels))
                .zip(observed.chunks_mut(band_pixels));
            bands.iter_mut().zip(planes).for_each(predict);
        } else {
            let planes = luminance
                .par_chunks_mut(band_pixels)
                .zip(variance.par_chunks_mut(band_pixels))
                .zip(depth_m.par_chunks_mut(band_pixels))
                .zip(observed.par_chunks_mut(band_pixels));
            let bands = bands.par_iter_mut().zip(planes);
            bands.with_max_len(1).for_each(predict);
        }
    }

    /// How many levels catch the expected error; `None` when nothing is predicted.
    fn level_count(&mut self, question: &Question) -> Option<usize> {
        let Level { width, height, .. } = self.pyramid[0].1;
        let bands = divide(&mut self.bands, width, height);
        let (count, median_m) = middle(bands);
        if count < PIXELS_MIN {
            return None;
        }
        let Question {
            intrinsics, noise, ..
        } = question;
        let from_position = intrinsics.fx * noise.position_m / f64::from(median_m);
        let from_rotation = intrinsics.fx * noise.rotation_rad;
        let error_px = from_position.hypot(from_rotation);
        Some(2 + usize::from(error_px > THIRD_LEVEL_PX) + usize::from(error_px > FOURTH_LEVEL_PX))
    }
}

/// A level whose points were collected.
struct Comparison<'a> {
    crew: Crew,
    view: LevelView<'a>,
    bands: &'a mut [Band],
}

impl Comparison<'_> {
    /// Collects the points and compares them with an estimate; returns how many they are.
    fn begin(&mut self, estimate: &Estimate) -> usize {
        let (isa, view, motion) = (self.crew.isa, &self.view, estimate.motion());
        self.crew.sum(self.bands, |band| {
            let comparable = band.collect(isa, view);
            band.compare(isa, view, &motion);
            comparable
        })
    }

    /// One Gauss-Newton step from an estimate that the points were compared with: how the template moves, and gain and
    /// offset change. `None` when too little of the view is left.
    fn step(&mut self, estimate: &Estimate, noise: PoseNoise, discount: f64) -> Option<Vector8> {
        let (compared, median) = middle(self.bands);
        if compared < PIXELS_MIN {
            return None;
        }
        let scale = (NORMAL_FROM_MEDIAN * median).clamp(SCALE_MIN, SCALE_MAX);
        let tukey = Tukey {
            scale,
            cutoff: TUKEY * scale,
        };
        let (isa, view, gain) = (self.crew.isa, &self.view, estimate.gain as f32);
        self.crew.each(self.bands, |band| {
            band.accumulate(isa, view, gain, tukey);
        });
        let mut sums = [0.0f64; HESSIAN + 8];
        for band in self.bands.iter() {
            for (sum, part) in sums.iter_mut().zip(band.sums()) {
                *sum += part;
            }
        }
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
        Some(normal.cholesky()?.solve(&right))
    }

    /// Residuals of all points.
    fn compare(&mut self, estimate: &Estimate) {
        let (isa, view, motion) = (self.crew.isa, &self.view, estimate.motion());
        self.crew
            .each(self.bands, |band| band.compare(isa, view, &motion));
    }

    /// Mean capped residuals of two estimates, predicted standard deviations.
    fn mismatches(&mut self, estimates: [&Estimate; 2]) -> [f64; 2] {
        let (isa, view) = (self.crew.isa, &self.view);
        let motions = estimates.map(Estimate::motion);
        self.crew
            .each(self.bands, |band| band.judge(isa, view, &motions));
        [0, 1].map(|index| {
            let of_bands = self.bands.iter().map(|band| band.mismatches()[index]);
            let all = of_bands.fold(Mismatch::default(), |all, band| Mismatch {
                compared: all.compared + band.compared,
                sum: all.sum + band.sum,
            });
            if all.compared == 0 {
                f64::INFINITY
            } else {
                all.sum / all.compared as f64
            }
        })
    }
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
