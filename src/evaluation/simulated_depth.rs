//! How good computed depth is in the simulated room, against exact truth: the share of pixels within one label of it.
//!
//! A pixel at a silhouette is a mixture of two surfaces, and no camera tells which of them its centre hits. Where the
//! truth in its four quarters differs by more than a label, depth of any of them is right.

use std::sync::Arc;

use rayon::ThreadPool;
use serde::Serialize;

use crate::{
    config::Settings,
    isa::Isa,
    model::{
        camera::Intrinsics,
        frame::{DepthSource, Frame, Source},
    },
    pipeline::{Pipeline, depth_range},
    simulation::{
        room::is_on_cloth,
        scene::ObjectId,
        script::{Capture, Script, Views},
    },
    stages::depth::{InverseDepthRange, SidesDepth},
};

/// Shares of pixels whose computed depth is within one label of the truth, percent; `None` where there are no such
/// pixels. A pixel that is given no depth is not within it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct WithinLabel {
    pub frames: usize,
    pub labels: usize,
    /// Of inverse depth, 1/m.
    pub label_step: f64,
    /// Everything nearer than the farthest label but glass.
    pub within_one_label: Option<f64>,
    /// Of these, over those that are given a depth.
    pub within_one_label_of_valid: Option<f64>,
    /// Of these, against the truth at the pixel's centre alone.
    pub within_one_label_at_centre: Option<f64>,
    /// Of these, mixtures.
    pub mixed: Option<f64>,
    /// Of the tablecloth, whose pattern repeats.
    pub cloth: Option<f64>,
    /// Of what is neither glass nor cloth.
    pub besides_cloth: Option<f64>,
    /// Of the glass's own front.
    pub glass: Option<f64>,
    /// Of what is behind the glass, where it is seen through it.
    pub behind_glass: Option<f64>,
    /// Of all, given no depth.
    pub invalid: Option<f64>,
    /// Median of |computed - true| / true over pixels with depth, percent.
    pub median_error: Option<f64>,
}

#[derive(Default)]
struct Share {
    good: usize,
    all: usize,
}

impl Share {
    fn add(&mut self, good: bool) {
        self.good += usize::from(good);
        self.all += 1;
    }

    fn percent(&self) -> Option<f64> {
        (self.all > 0).then(|| 100.0 * self.good as f64 / self.all as f64)
    }
}

/// The same script with twice the pixels along each side: four to one of `camera`'s.
fn quartered(script: &Script, camera: &Intrinsics) -> Script {
    let mut script = script.clone();
    script.stations[0].rig.intrinsics = Intrinsics {
        width: 2 * camera.width,
        height: 2 * camera.height,
        fx: 2.0 * camera.fx,
        fy: 2.0 * camera.fy,
        cx: 2.0 * camera.cx + 0.5,
        cy: 2.0 * camera.cy + 0.5,
    };
    script
}

/// Whether a computed depth is right at a pixel, in metres, 0 = none.
struct Truth<'a> {
    capture: &'a Capture,
    /// Of twice the pixels along each side.
    quarters_m: &'a [f32],
    width: usize,
    label_step: f32,
}

impl Truth<'_> {
    fn near(&self, computed_m: f32, true_m: f32) -> bool {
        computed_m > 0.0 && (1.0 / computed_m - 1.0 / true_m).abs() <= self.label_step
    }

    fn quarters(&self, pixel: usize) -> [f32; 4] {
        let (u, v) = (pixel % self.width, pixel / self.width);
        let corner = 2 * (v * 2 * self.width + u);
        let below = corner + 2 * self.width;
        [corner, corner + 1, below, below + 1].map(|quarter| self.quarters_m[quarter])
    }

    /// More than one surface, labels apart.
    fn is_mixed(&self, pixel: usize) -> bool {
        let quarters = self.quarters(pixel);
        let farthest = quarters.into_iter().fold(0.0, f32::max);
        let nearest = quarters.into_iter().fold(f32::INFINITY, f32::min);
        1.0 / nearest - 1.0 / farthest > self.label_step
    }

    fn is_met(&self, pixel: usize, computed_m: f32) -> bool {
        let quarters = self.quarters(pixel);
        self.near(computed_m, self.capture.middle.depth_m[pixel])
            || self.is_mixed(pixel)
                && quarters
                    .into_iter()
                    .any(|true_m| self.near(computed_m, true_m))
    }
}

/// Share of pixels nearer than the farthest label but glass whose depth is within one label, percent, as
/// [`WithinLabel::within_one_label`], but as the service runs: one frame in `every` from the script's first goes through
/// a pipeline with nothing but three cameras and the tracked pose, so that what is expected is a memory of depths that
/// were computed likewise. Of those, `frames` are judged; they are multiples of `every`.
pub fn along_the_way(
    script: &Script,
    frames: &[u64],
    every: u64,
    settings: &Settings,
    pool: Arc<ThreadPool>,
) -> Option<f64> {
    let glass_id = script
        .names()
        .find(|(name, _)| *name == "glass")
        .map(|(_, id)| id);
    let range = depth_range(settings);
    let intrinsics = script.stations[0].rig.intrinsics;
    let quartered = quartered(script, &intrinsics);
    let mut pipeline = Pipeline::new(settings.clone(), pool);
    let mut share = Share::default();
    let last = frames.iter().copied().max()?;
    for number in (0..=last).step_by(every as usize) {
        let capture = script.capture(0, number, Views::Triple);
        let (Ok((world_from_camera, _)), Some(sides)) =
            (script.localised(0, &capture), script.sides(0, &capture))
        else {
            // The tracker lost the plate.
            continue;
        };
        let frame = Frame {
            source: Source {
                robot: "anna".into(),
                camera: "head".into(),
            },
            stamp_ns: script.stamp_ns(number),
            sequence: number,
            image: capture.middle.image.clone(),
            depth: DepthSource::Sides(Box::new(sides)),
            intrinsics,
            world_from_camera,
            pose_noise: None,
        };
        let learnt = pipeline
            .process(&frame)
            .ok()
            .and_then(|report| report.viewpoint_id);
        let viewpoints = pipeline.memory().viewpoints();
        let Some(viewpoint) = viewpoints.iter().find(|view| Some(view.id) == learnt) else {
            continue;
        };
        if !frames.contains(&number) {
            continue;
        }
        let quarters_m = quartered.capture(0, number, Views::Middle).middle.depth_m;
        let truth = Truth {
            capture: &capture,
            quarters_m: &quarters_m,
            width: intrinsics.width,
            label_step: range.step() as f32,
        };
        for (pixel, &computed_m) in viewpoint.mesh.depth_m.iter().enumerate() {
            let true_m = capture.middle.depth_m[pixel];
            let known = true_m > 0.0 && f64::from(true_m) <= 1.0 / range.far;
            if known && Some(capture.middle.object[pixel]) != glass_id {
                share.add(truth.is_met(pixel, computed_m));
            }
        }
    }
    share.percent()
}

/// Computes the depth of these frames of the script's first station, without a memory's expectation.
pub fn evaluate(script: &Script, frames: &[u64], range: InverseDepthRange) -> WithinLabel {
    let glass_id = script
        .names()
        .find(|(name, _)| *name == "glass")
        .map(|(_, id)| id);
    let mut depth = SidesDepth::new(range, Isa::detect());
    let intrinsics = script.stations[0].rig.intrinsics;
    let quartered = quartered(script, &intrinsics);
    let mut all = Share::default();
    let [mut of_valid, mut at_centre, mut mixed, mut invalid] = [(); 4].map(|()| Share::default());
    let [mut cloth, mut others, mut glass, mut behind] = [(); 4].map(|()| Share::default());
    let mut errors: Vec<f32> = Vec::new();
    for &frame in frames {
        let capture = script.capture(0, frame, Views::Triple);
        let sides = script
            .sides(0, &capture)
            .expect("all cameras were rendered");
        let middle = &capture.middle;
        let quarters_m = quartered.capture(0, frame, Views::Middle).middle.depth_m;
        let computed = depth.compute(&intrinsics, &middle.image, &sides, None);
        let truth = Truth {
            capture: &capture,
            quarters_m: &quarters_m,
            width: intrinsics.width,
            label_step: computed.label_step,
        };
        for (pixel, &computed_m) in computed.depth_m.iter().enumerate() {
            let near = |true_m: f32| truth.near(computed_m, true_m);
            let (true_m, seen) = (middle.depth_m[pixel], middle.object[pixel]);
            invalid.add(computed_m == 0.0);
            if true_m == 0.0 || f64::from(true_m) > 1.0 / range.far {
                continue;
            }
            if Some(seen) == glass_id {
                glass.add(near(true_m));
                behind.add(near(middle.depth_through_glass_m[pixel]));
                continue;
            }
            if computed_m > 0.0 {
                errors.push((computed_m - true_m).abs() / true_m);
            }
            let (u, v) = (pixel % intrinsics.width, pixel / intrinsics.width);
            let point = intrinsics.unproject(u as f64, v as f64, f64::from(true_m));
            let on_cloth =
                seen == ObjectId::ROOM && is_on_cloth(&(capture.world_from_camera * point));
            let is_mixed = truth.is_mixed(pixel);
            let good = truth.is_met(pixel, computed_m);
            all.add(good);
            if computed_m > 0.0 {
                of_valid.add(good);
            }
            at_centre.add(near(true_m));
            mixed.add(is_mixed);
            let share = if on_cloth { &mut cloth } else { &mut others };
            share.add(good);
        }
    }
    let median = errors.len() / 2;
    let median_error = (!errors.is_empty()).then(|| {
        let (_, error, _) = errors.select_nth_unstable_by(median, f32::total_cmp);
        100.0 * f64::from(*error)
    });
    WithinLabel {
        frames: frames.len(),
        labels: range.labels,
        label_step: range.step(),
        within_one_label: all.percent(),
        within_one_label_of_valid: of_valid.percent(),
        within_one_label_at_centre: at_centre.percent(),
        mixed: mixed.percent(),
        cloth: cloth.percent(),
        besides_cloth: others.percent(),
        glass: glass.percent(),
        behind_glass: behind.percent(),
        invalid: invalid.percent(),
        median_error,
    }
}
