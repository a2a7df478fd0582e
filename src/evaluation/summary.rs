//! Frames into numbers: a line for each pass, and the headline of a method.

use serde::Serialize;

use super::{
    measure::{FrameRow, ObjectScore},
    ranking::{average_precision, roc_auc},
    selectivity::{Sides, score_ratio_db},
};

/// The passes of a recording have these names in `phases.csv`; the first of a phase goes forward.
const FORWARD: &str = "fwd";
const BACK: &str = "back";

/// Means over the frames of one pass.
#[derive(Debug, Clone, Serialize)]
pub struct PassSummary {
    pub run: String,
    pub phase: String,
    pub pass: String,
    pub frames: usize,
    /// `None` where no object is evaluated.
    pub object: Option<ObjectSummary>,
    /// The largest block of each frame outside every mask: median, 95th percentile, maximum.
    pub outside_p50: f64,
    pub outside_p95: f64,
    pub outside_max: f64,
    /// Frames with a block above the threshold outside every mask.
    pub alarms: usize,
    pub viewpoints: usize,
}

#[derive(Debug, Clone, Serialize)]
pub struct ObjectSummary {
    pub name: String,
    /// Frames in which it is in view.
    pub frames: usize,
    pub as_db: f64,
    pub pas_db: f64,
    /// Of the blocks of all frames together, so that one threshold must serve the whole pass.
    pub auc: f64,
    pub average_precision: f64,
    pub iou: f64,
    pub mean_inside: f64,
    pub max_inside: f64,
    pub max_outside: f64,
    pub error_grey: Option<f64>,
    /// Frames whose largest block inside exceeds the threshold.
    pub detected: usize,
}

/// The experiment of the paper's Table I in one line. B: a weak object comes; C: a strong one; D: that one is gone.
#[derive(Debug, Clone, Serialize)]
pub struct Headline {
    pub b: Option<ObjectSummary>,
    pub c: Option<ObjectSummary>,
    pub c_back: Option<ObjectSummary>,
    pub d: Option<ObjectSummary>,
    /// Surprise in the region in the first run over the way back, dB.
    pub c_drop_db: Option<f64>,
    /// Removal over addition: surprise in the region in the first run of D over that of C, dB.
    pub d_over_c_db: Option<f64>,
    /// Frames with false alarms, and all: passes after the first before anything comes; ways back after.
    pub alarms_learnt: (usize, usize),
    pub alarms_back: (usize, usize),
    pub viewpoints: usize,
}

pub fn passes(rows: &[FrameRow]) -> Vec<PassSummary> {
    rows.chunk_by(|a, b| a.group == b.group)
        .map(|rows| {
            let mut outside: Vec<f64> = rows.iter().map(|row| row.largest_outside).collect();
            outside.sort_by(f64::total_cmp);
            let first = &rows[0];
            PassSummary {
                run: first.run.clone(),
                phase: first.moment.phase.clone(),
                pass: first.moment.pass.clone(),
                frames: rows.len(),
                object: object_summary(rows),
                outside_p50: percentile(&outside, 0.5),
                outside_p95: percentile(&outside, 0.95),
                outside_max: percentile(&outside, 1.0),
                alarms: rows
                    .iter()
                    .filter(|row| row.largest_outside > row.threshold)
                    .count(),
                viewpoints: rows[rows.len() - 1].viewpoints,
            }
        })
        .collect()
}

pub fn headline(passes: &[PassSummary]) -> Headline {
    let object = |phase: &str, pass: &str| {
        passes
            .iter()
            .find(|summary| summary.phase == phase && summary.pass == pass)
            .and_then(|summary| summary.object.clone())
    };
    let (b, c, c_back, d) = (
        object("B", FORWARD),
        object("C", FORWARD),
        object("C", BACK),
        object("D", FORWARD),
    );
    let ratio = |a: &Option<ObjectSummary>, b: &Option<ObjectSummary>| {
        let (a, b) = (a.as_ref()?, b.as_ref()?);
        Some(score_ratio_db(a.mean_inside, b.mean_inside))
    };
    let alarms = |passes: &mut dyn Iterator<Item = &PassSummary>| {
        passes.fold((0, 0), |(alarms, frames), summary| {
            (alarms + summary.alarms, frames + summary.frames)
        })
    };
    let is_learning = |summary: &&PassSummary| summary.object.is_none();
    Headline {
        c_drop_db: ratio(&c, &c_back),
        d_over_c_db: ratio(&d, &c),
        alarms_learnt: alarms(&mut passes.iter().take_while(is_learning).skip(1)),
        alarms_back: alarms(
            &mut passes
                .iter()
                .skip_while(is_learning)
                .filter(|summary| summary.pass == BACK),
        ),
        viewpoints: passes.last().map_or(0, |summary| summary.viewpoints),
        b,
        c,
        c_back,
        d,
    }
}

fn object_summary(rows: &[FrameRow]) -> Option<ObjectSummary> {
    let name = rows[0].moment.evaluated.clone()?;
    let scored: Vec<(&FrameRow, ObjectScore)> = rows
        .iter()
        .filter_map(|row| Some((row, row.object?)))
        .collect();
    if scored.is_empty() {
        return None;
    }
    let mean = |value: &dyn Fn(&ObjectScore) -> f64| {
        scored.iter().map(|(_, score)| value(score)).sum::<f64>() / scored.len() as f64
    };
    let errors: Vec<f64> = scored
        .iter()
        .filter_map(|(_, score)| score.error_grey)
        .collect();
    let pooled = |side: fn(&Sides) -> &Vec<f32>| -> Vec<f32> {
        rows.iter()
            .flat_map(|row| side(&row.sides))
            .copied()
            .collect()
    };
    let inside = pooled(|sides| &sides.inside);
    let outside = pooled(|sides| &sides.outside);
    Some(ObjectSummary {
        name,
        frames: scored.len(),
        as_db: mean(&|score| score.as_db),
        pas_db: mean(&|score| score.pas_db),
        auc: roc_auc(&inside, &outside)?,
        average_precision: average_precision(&inside, &outside)?,
        iou: mean(&|score| score.iou),
        mean_inside: mean(&|score| score.mean_inside),
        max_inside: mean(&|score| score.max_inside),
        max_outside: mean(&|score| score.max_outside),
        error_grey: (!errors.is_empty()).then(|| errors.iter().sum::<f64>() / errors.len() as f64),
        detected: scored
            .iter()
            .filter(|(row, score)| score.max_inside > row.threshold)
            .count(),
    })
}

/// Regions against boxes, over all frames that were compared with a memory.
#[derive(Debug, Clone, Copy, Default, Serialize)]
pub struct BoxSummary {
    pub images: usize,
    pub wanted: usize,
    pub found: usize,
    pub false_regions: usize,
    pub taken_away: usize,
}

impl BoxSummary {
    pub fn recall(&self) -> f64 {
        self.found as f64 / self.wanted as f64
    }

    pub fn false_per_image(&self) -> f64 {
        self.false_regions as f64 / self.images as f64
    }
}

/// Of the runs after the first; `None` without boxes.
pub fn boxes(rows: &[FrameRow]) -> Option<BoxSummary> {
    let first_run = &rows.first()?.run;
    let mut sum = BoxSummary::default();
    for (row, score) in rows.iter().filter_map(|row| Some((row, row.boxes?))) {
        if row.run != *first_run {
            sum.images += 1;
            sum.wanted += score.wanted;
            sum.found += score.found;
            sum.false_regions += score.false_regions;
            sum.taken_away += score.taken_away;
        }
    }
    (sum.images > 0).then_some(sum)
}

/// Of sorted values; between two of them the line that joins them.
pub fn percentile(sorted: &[f64], share: f64) -> f64 {
    let Some(last) = sorted.len().checked_sub(1) else {
        return 0.0;
    };
    let at = share * last as f64;
    let below = at.floor() as usize;
    let above = at.ceil() as usize;
    sorted[below] + (at - at.floor()) * (sorted[above] - sorted[below])
}
