//! How well a memory tells what is seen from where nobody stood: frames of a recording are left out, the rest is learnt,
//! and what is expected at the poses of the left out is compared with them.
//!
//! Beside it, what the memory tells where the left out frame itself is found by refinement, and what the nearest learnt
//! frame alone tells: copied as it is, and warped, that is its surface projected into the other pose with its colours.
//! Pictures are compared in grey levels, as they came, and with one gain a frame that is fitted to the left out frame: a
//! memory that looks past exposures has the exposure of its first frames.

use serde::Serialize;

use crate::{
    config::Settings,
    dataset::Recording,
    engine::{
        Engines,
        cpu::{CpuEngine, RecallView},
    },
    evaluation::measure::MeasureError,
    model::{
        belief::{Belief, CHANNELS, Record, rgb_from_ycbcr, ycbcr_from_rgb},
        frame::{Frame, Source},
        pose::view_distance_m,
        viewpoint::{Coarse, Mesh, Viewpoint},
    },
    pipeline::Pipeline,
    stages::interpolate::prior::{self, Prior},
};

/// How often one is left out.
pub const EVERY: usize = 5;

const PREDICTIONS: usize = 4;

/// Means over the frames that were left out.
#[derive(Debug, Clone, Serialize)]
pub struct HeldOut {
    pub learnt: usize,
    pub left_out: usize,
    pub viewpoints: usize,
    /// How far from the given pose refinement finds a frame, metres and radians.
    pub correction_m: f64,
    pub correction_rad: f64,
    /// The memory's prior at the given pose, and where the frame is found; the nearest learnt frame warped, and copied.
    pub predictions: [Prediction; PREDICTIONS],
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Prediction {
    pub name: &'static str,
    /// Share of the pixels that it tells, 0..1.
    pub coverage: f64,
    /// Over these.
    pub own: Likeness,
    /// Over the pixels that all predictions tell.
    pub common: Likeness,
    /// The same with one gain a frame.
    pub with_gain: Likeness,
    /// What the left out frames are brighter than predicted, a factor.
    pub gain: f64,
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Likeness {
    /// Of the three colours, decibels; mean of the frames'.
    pub psnr_db: f64,
    /// Mean of |Y - predicted Y|, grey levels.
    pub error_grey: f64,
}

/// What a pixel is predicted to be: Y, Cb, Cr; `None`: nothing is said.
type Predicted = Vec<Option<[f32; CHANNELS]>>;

/// The frames that a recording begins with, every fifth of them left out, the rest learnt in order. Begins with: the
/// first phase of its experiment, or its first pass where it has no phases, or all of it without truth.
///
/// # Errors
/// Files that cannot be read, and frames that cannot be used.
pub fn evaluate(
    recording: &Recording,
    settings: &Settings,
    engines: &Engines,
) -> Result<HeldOut, MeasureError> {
    let moments = &recording.truth.moments;
    let begins = (0..recording.entries.len()).filter(|&index| {
        let (Some(first), Some(moment)) = (moments.first(), moments.get(index)) else {
            return true;
        };
        moment.phase == first.phase && (!first.phase.is_empty() || moment.pass == first.pass)
    });
    let (mut learnt, mut left_out) = (Vec::new(), Vec::new());
    for (number, index) in begins.enumerate() {
        if number % EVERY == EVERY - 1 {
            left_out.push(index);
        } else {
            learnt.push(index);
        }
    }
    let source = Source {
        robot: "recording".into(),
        camera: "camera".into(),
    };
    let refused = |index: usize, error| MeasureError::Frame {
        run: recording.name.clone(),
        stamp_s: recording.entries[index].stamp_s,
        error,
    };
    let mut pipeline = Pipeline::on(engines, settings.clone());
    for &index in &learnt {
        let frame = recording.frame(index, &source)?;
        pipeline
            .process(&frame)
            .map_err(|error| refused(index, error))?;
    }
    let engine = CpuEngine::new(settings, engines.pool().clone(), engines.isa());
    let names = [
        "prior",
        "prior, pose refined",
        "nearest warped",
        "nearest copied",
    ];
    let mut sums = names.map(|name| Prediction {
        name,
        ..Prediction::default()
    });
    let (mut correction_m, mut correction_rad) = (0.0, 0.0);
    for &index in &left_out {
        let seen = recording.frame(index, &source)?;
        let distance_m = |other: &usize| {
            let other = &recording.entries[*other].world_from_camera;
            view_distance_m(other, &seen.world_from_camera, settings.metres_per_radian)
        };
        let nearest = learnt
            .iter()
            .min_by(|a, b| distance_m(a).total_cmp(&distance_m(b)))
            .expect("four of five frames are learnt");
        let nearest = recording.frame(*nearest, &source)?;
        let at = pipeline.prior(&seen.intrinsics, &seen.world_from_camera);
        let found = pipeline.evaluate(&seen);
        let found = found.map_err(|error| refused(index, error))?;
        correction_m += found.pose_correction_m;
        correction_rad += found.pose_correction_rad;
        let at_refined = pipeline.prior(&seen.intrinsics, &found.world_from_camera);
        let predictions = [
            told(&at.prior),
            told(&at_refined.prior),
            warped(&nearest, &seen, settings, &engine),
            colours(&nearest).into_iter().map(Some).collect(),
        ];
        add(&mut sums, &predictions, &seen);
    }
    let frames = left_out.len().max(1) as f64;
    let mean = |likeness: Likeness| Likeness {
        psnr_db: likeness.psnr_db / frames,
        error_grey: likeness.error_grey / frames,
    };
    Ok(HeldOut {
        learnt: learnt.len(),
        left_out: left_out.len(),
        viewpoints: pipeline.memory().viewpoints().len(),
        correction_m: correction_m / frames,
        correction_rad: correction_rad / frames,
        predictions: sums.map(|sum| Prediction {
            coverage: sum.coverage / frames,
            own: mean(sum.own),
            common: mean(sum.common),
            with_gain: mean(sum.with_gain),
            gain: sum.gain / frames,
            ..sum
        }),
    })
}

fn colours(frame: &Frame) -> Vec<[f32; CHANNELS]> {
    let pixels = frame.image.data.as_chunks().0.iter();
    pixels
        .map(|rgb: &[u8; CHANNELS]| ycbcr_from_rgb(rgb.map(f32::from)))
        .collect()
}

fn told(prior: &Prior) -> Predicted {
    let pixels = (0..prior.height).flat_map(|y| (0..prior.width).map(move |x| (x, y)));
    pixels
        .map(|(x, y)| {
            let seen = prior.row(y).plane(prior::COVERAGE)[x] > 0.0;
            seen.then(|| prior.belief(x, y).tau)
        })
        .collect()
}

/// The surface that `nearest` saw, in its colours, as it lies before the camera of `seen`.
fn warped(nearest: &Frame, seen: &Frame, settings: &Settings, engine: &CpuEngine) -> Predicted {
    let depth_m = nearest
        .depth
        .given_m()
        .expect("a recording's frames have depth");
    let record = |tau| {
        Record::pack(&Belief {
            tau,
            ..Belief::unknown()
        })
    };
    let viewpoint = Viewpoint {
        id: 1,
        world_from_camera: nearest.world_from_camera,
        world_from_home: nearest.world_from_camera,
        mesh: Mesh::new(nearest.intrinsics, depth_m.to_vec(), settings.mesh_cut),
        records: colours(nearest).into_iter().map(record).collect(),
        coarse: Coarse::default(),
        source: nearest.source.clone(),
        stamp_ns: nearest.stamp_ns,
        updates: 1,
    };
    let view = RecallView {
        viewpoint: &viewpoint,
        weight: 1.0,
        fresh: false,
    };
    let mut prior = Prior::default();
    engine.recall(
        &[view],
        &seen.intrinsics,
        &seen.world_from_camera,
        &mut prior,
    );
    told(&prior)
}

fn add(sums: &mut [Prediction; PREDICTIONS], predictions: &[Predicted; PREDICTIONS], seen: &Frame) {
    let observed = colours(seen);
    let common: Vec<bool> = (0..observed.len())
        .map(|pixel| predictions.iter().all(|told| told[pixel].is_some()))
        .collect();
    for (sum, told) in sums.iter_mut().zip(predictions) {
        let covered = told.iter().flatten().count();
        sum.coverage += covered as f64 / told.len().max(1) as f64;
        let gain = gain(told, &observed);
        sum.gain += f64::from(gain);
        let of_frame = [
            (&mut sum.own, likeness(told, seen, &observed, 1.0, |_| true)),
            (
                &mut sum.common,
                likeness(told, seen, &observed, 1.0, |pixel| common[pixel]),
            ),
            (
                &mut sum.with_gain,
                likeness(told, seen, &observed, gain, |pixel| common[pixel]),
            ),
        ];
        for (sum, of_frame) in of_frame {
            sum.psnr_db += of_frame.psnr_db;
            sum.error_grey += of_frame.error_grey;
        }
    }
}

/// The median of Y over the predicted Y, where neither is dark or saturated.
fn gain(told: &Predicted, observed: &[[f32; CHANNELS]]) -> f32 {
    let pairs = told.iter().zip(observed);
    let mut ratios: Vec<f32> = pairs
        .filter_map(|(told, observed)| Some((told.as_ref()?[0], observed[0])))
        .filter(|(told, observed)| *told > 20.0 && (10.0..245.0).contains(observed))
        .map(|(told, observed)| observed / told)
        .collect();
    let middle = ratios.len() / 2;
    match ratios.get(middle) {
        Some(_) => *ratios.select_nth_unstable_by(middle, f32::total_cmp).1,
        None => 1.0,
    }
}

/// Over the pixels that are told and wanted.
fn likeness(
    told: &Predicted,
    seen: &Frame,
    observed: &[[f32; CHANNELS]],
    gain: f32,
    wanted: impl Fn(usize) -> bool,
) -> Likeness {
    let (mut squares, mut errors, mut count) = (0.0f64, 0.0f64, 0usize);
    let rgb: &[[u8; CHANNELS]] = seen.image.data.as_chunks().0;
    for (pixel, predicted) in told.iter().enumerate() {
        let Some(predicted) = predicted.filter(|_| wanted(pixel)) else {
            continue;
        };
        let predicted = predicted.map(|value| gain * value);
        count += 1;
        errors += f64::from((predicted[0] - observed[pixel][0]).abs());
        let drawn = rgb_from_ycbcr(predicted);
        for (a, b) in drawn.into_iter().zip(rgb[pixel]) {
            squares += f64::from(a.abs_diff(b)).powi(2);
        }
    }
    let count = count.max(1) as f64;
    let mean_square = squares / (count * CHANNELS as f64);
    Likeness {
        // A picture that is the same to the last bit is as good as one off by a hundredth of a grey level.
        psnr_db: 10.0 * (255.0 * 255.0 / mean_square.max(1e-4)).log10(),
        error_grey: errors / count,
    }
}
