//! One method over recordings, frame by frame, against whatever truth they have.

use nalgebra::{Point3, Translation3, UnitQuaternion, Vector3};

use crate::{
    config::Settings,
    dataset::{
        DatasetError, Recording,
        truth::{ChangeKind, Moment, TruthBox},
    },
    evaluation::{
        method::{Method, Verdict},
        ranking::{average_precision, roc_auc},
        selectivity::{Sides, mask_box},
    },
    model::{
        camera::Intrinsics,
        frame::{Frame, FrameError, Source},
        pose::Pose,
        report::{PixelBox, Region},
    },
};

/// A ball in the world whose inside is left out of the judgement, for instance a screen that changes by itself.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ignored {
    pub center_in_world: Point3<f64>,
    pub radius_m: f64,
}

/// How the recordings are played.
#[derive(Debug, Clone, Default)]
pub struct Conditions {
    pub ignored: Vec<Ignored>,
    /// Added to every pose.
    pub pose_noise: Option<AddedNoise>,
    /// Learn the first run only and compare the others with it.
    pub first_run_only: bool,
}

/// Normal noise per axis with standard deviations in metres and degrees.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AddedNoise {
    pub position_m: f64,
    pub rotation_deg: f64,
    pub seed: u64,
}

/// What a frame gave.
#[derive(Debug, Clone)]
pub struct FrameRow {
    pub run: String,
    pub stamp_s: f64,
    pub moment: Moment,
    /// Counts the passes: frames with one number belong together.
    pub group: usize,
    pub object: Option<ObjectScore>,
    /// The blocks behind [`Self::object`].
    pub sides: Sides,
    /// Of the blocks outside every mask and whatever is ignored.
    pub largest_outside: f64,
    /// The same of all blocks but the ignored.
    pub largest: f64,
    pub threshold: f64,
    pub regions: usize,
    pub viewpoints: usize,
    pub correction_m: f64,
    pub boxes: Option<BoxScore>,
}

/// The evaluated object in one frame; scores are nats, or grey levels for differencing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ObjectScore {
    pub as_db: f64,
    pub pas_db: f64,
    pub mean_inside: f64,
    pub max_inside: f64,
    pub max_outside: f64,
    pub auc: f64,
    pub average_precision: f64,
    pub iou: f64,
    /// Mean of |Y - tau_Y| in the mask, grey levels.
    pub error_grey: Option<f64>,
}

/// Regions against boxes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct BoxScore {
    /// Boxes that should be found.
    pub wanted: usize,
    pub found: usize,
    /// Regions where nothing differs from the first run.
    pub false_regions: usize,
    /// Of these, where something stood in the run before.
    pub taken_away: usize,
}

#[derive(Debug, thiserror::Error)]
pub enum MeasureError {
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    #[error("frame at {stamp_s:.6} s of {run}: {error}")]
    Frame {
        run: String,
        stamp_s: f64,
        error: FrameError,
    },
}

/// What is there of a frame while it is being measured.
pub struct Seen<'a> {
    pub frame: &'a Frame,
    pub method: &'a Method,
    pub verdict: &'a Verdict,
    pub row: &'a FrameRow,
}

/// Plays the recordings in order through one method.
///
/// # Errors
/// Files that cannot be read and frames that cannot be used.
pub fn measure(
    recordings: &[Recording],
    method: &mut Method,
    settings: &Settings,
    conditions: &Conditions,
    mut each: impl FnMut(&Seen),
) -> Result<Vec<FrameRow>, MeasureError> {
    let source = Source {
        robot: "evaluate".into(),
        camera: "recording".into(),
    };
    let mut chance = conditions.pose_noise.map(Chance::new);
    let mut rows: Vec<FrameRow> = Vec::new();
    let mut previous: Option<&Recording> = None;
    for (number, recording) in recordings.iter().enumerate() {
        let learn = number == 0 || !conditions.first_run_only;
        for index in 0..recording.entries.len() {
            let mut frame = recording.frame(index, &source)?;
            if let Some(chance) = &mut chance {
                frame.world_from_camera *= chance.pose();
            }
            let stamp_s = recording.entries[index].stamp_s;
            let verdict = method
                .judge(&frame, learn)
                .map_err(|error| MeasureError::Frame {
                    run: recording.name.clone(),
                    stamp_s,
                    error,
                })?;
            let moment = recording
                .truth
                .moments
                .get(index)
                .cloned()
                .unwrap_or_default();
            let group = rows.last().map_or(0, |last| {
                let same = last.run == recording.name
                    && (&last.moment.phase, &last.moment.pass) == (&moment.phase, &moment.pass);
                last.group + usize::from(!same)
            });
            let mut ignored = ignored_pixels(&frame, &conditions.ignored);
            let Intrinsics { width, height, .. } = frame.intrinsics;
            if let Some(marked) = recording.truth.ignored(index, (width, height))? {
                ignored
                    .iter_mut()
                    .zip(marked)
                    .for_each(|(all, one)| *all |= one);
            }
            let (largest, largest_outside) =
                largest_blocks(recording, index, &frame, &verdict, &ignored, settings)?;
            let mask = match &moment.evaluated {
                Some(object) => recording.truth.mask(object, index, (width, height))?,
                None => None,
            };
            let (object, sides) = mask.map_or_else(
                || (None, Sides::default()),
                |mask| object_score(&mask, &ignored, &frame, method, &verdict, settings),
            );
            let boxes = recording.truth.boxes.get(index).map(|boxes| {
                let before = previous.and_then(|run| run.truth.boxes.get(index));
                box_score(
                    &verdict.regions,
                    boxes,
                    before.map_or(&[], Vec::as_slice),
                    conditions.first_run_only,
                )
            });
            let row = FrameRow {
                run: recording.name.clone(),
                stamp_s,
                moment,
                group,
                object,
                sides,
                largest_outside,
                largest,
                threshold: f64::from(method.threshold()),
                regions: verdict.regions.len(),
                viewpoints: method.viewpoints(),
                correction_m: verdict.correction_m,
                boxes,
            };
            each(&Seen {
                frame: &frame,
                method,
                verdict: &verdict,
                row: &row,
            });
            rows.push(row);
        }
        previous = Some(recording);
    }
    Ok(rows)
}

fn object_score(
    mask: &[bool],
    ignored: &[bool],
    frame: &Frame,
    method: &Method,
    verdict: &Verdict,
    settings: &Settings,
) -> (Option<ObjectScore>, Sides) {
    let width = frame.intrinsics.width;
    let sides = Sides::new(&verdict.evidence, mask, ignored, width, settings.border_px);
    let (Some(auc), Some(precision)) = (
        roc_auc(&sides.inside, &sides.outside),
        average_precision(&sides.inside, &sides.outside),
    ) else {
        // In the border strip.
        return (None, Sides::default());
    };
    let iou = mask_box(mask, width)
        .zip(verdict.best_box(frame, settings))
        .map_or(0.0, |(truth, found)| truth.iou(&found));
    let score = ObjectScore {
        as_db: sides.selectivity_db(),
        pas_db: sides.peak_selectivity_db(),
        mean_inside: sides.mean_inside(),
        max_inside: sides.max_inside(),
        max_outside: sides.max_outside(),
        auc,
        average_precision: precision,
        iou,
        error_grey: method.error_in(frame, verdict.gain, mask),
    };
    (Some(score), sides)
}

/// Of all blocks, and of those outside every object's mask.
fn largest_blocks(
    recording: &Recording,
    index: usize,
    frame: &Frame,
    verdict: &Verdict,
    ignored: &[bool],
    settings: &Settings,
) -> Result<(f64, f64), DatasetError> {
    let Intrinsics { width, height, .. } = frame.intrinsics;
    let mut masked = vec![false; width * height];
    for object in recording.truth.objects() {
        if let Some(mask) = recording.truth.mask(object, index, (width, height))? {
            masked
                .iter_mut()
                .zip(mask)
                .for_each(|(all, one)| *all |= one);
        }
    }
    let largest = |mask: &[bool]| {
        Sides::new(&verdict.evidence, mask, ignored, width, settings.border_px).max_outside()
    };
    Ok((largest(ignored), largest(&masked)))
}

/// Pixels within the ignored balls' outlines, a value a pixel.
fn ignored_pixels(frame: &Frame, ignored: &[Ignored]) -> Vec<bool> {
    let Intrinsics {
        width, height, fx, ..
    } = frame.intrinsics;
    let mut pixels = vec![false; width * height];
    for ball in ignored {
        let center = frame.world_from_camera.inverse() * ball.center_in_world;
        let Some((u, v)) = frame.intrinsics.project(&center) else {
            continue;
        };
        let radius_px = fx * ball.radius_m / center.z;
        for (index, pixel) in pixels.iter_mut().enumerate() {
            let (x, y) = ((index % width) as f64, (index / width) as f64);
            *pixel |= (x - u).hypot(y - v) <= radius_px;
        }
    }
    pixels
}

/// Boxes that overlap this much are of the same thing.
const SAME_BOX_IOU: f64 = 0.2;

/// A region tells of a box if its peak or its box's centre lies in it, or the two boxes overlap by an IoU of 0.2.
fn tells_of(region: &Region, truth: &PixelBox) -> bool {
    let within = |x: f64, y: f64| {
        x >= f64::from(truth.x_min)
            && x < f64::from(truth.x_max)
            && y >= f64::from(truth.y_min)
            && y < f64::from(truth.y_max)
    };
    let found = region.pixel_box;
    within(f64::from(region.peak_x), f64::from(region.peak_y))
        || within(
            f64::from(found.x_min + found.x_max) / 2.0,
            f64::from(found.y_min + found.y_max) / 2.0,
        )
        || found.iou(truth) >= SAME_BOX_IOU
}

fn box_score(
    regions: &[Region],
    boxes: &[TruthBox],
    before: &[TruthBox],
    first_run_only: bool,
) -> BoxScore {
    let mut score = BoxScore::default();
    for truth in boxes {
        let is_new = first_run_only || truth.new_since_previous;
        if truth.kind == ChangeKind::Added && is_new && !truth.minor {
            score.wanted += 1;
            let pixel_box = truth.pixel_box();
            score.found += usize::from(regions.iter().any(|region| tells_of(region, &pixel_box)));
        }
    }
    let of_any = |region: &Region, boxes: &[TruthBox]| {
        boxes
            .iter()
            .any(|truth| tells_of(region, &truth.pixel_box()))
    };
    for region in regions.iter().filter(|region| !of_any(region, boxes)) {
        score.false_regions += 1;
        score.taken_away += usize::from(of_any(region, before));
    }
    score
}

/// Seeded noise on poses.
struct Chance {
    noise: AddedNoise,
    state: u64,
}

impl Chance {
    fn new(noise: AddedNoise) -> Self {
        Self {
            noise,
            state: noise.seed,
        }
    }

    /// `given_from_true`.
    fn pose(&mut self) -> Pose {
        let AddedNoise {
            position_m,
            rotation_deg,
            ..
        } = self.noise;
        let position = Vector3::from_fn(|_, _| position_m * self.normal());
        let rotation = Vector3::from_fn(|_, _| rotation_deg.to_radians() * self.normal());
        Pose::from_parts(Translation3::from(position), UnitQuaternion::new(rotation))
    }

    /// SplitMix64, 0 < x <= 1.
    fn uniform(&mut self) -> f64 {
        self.state = self.state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.state;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^= z >> 31;
        ((z >> 11) + 1) as f64 / (1u64 << 53) as f64
    }

    /// Mean 0, standard deviation 1 (Box and Muller).
    fn normal(&mut self) -> f64 {
        let radius = (-2.0 * self.uniform().ln()).sqrt();
        radius * (std::f64::consts::TAU * self.uniform()).cos()
    }
}
