//! `evaluate --depth`: how good the depth from three cameras is, on a stereo folder or on simulated frames.

use std::{path::Path, sync::Arc};

use rayon::ThreadPool;
use serde_json::json;

use crate::{
    commands::output,
    config::Settings,
    evaluation::{
        simulated_depth,
        stereo::{self, Cameras, StereoScene},
        table::{Table, number},
    },
    pipeline::depth_range,
    simulation::script::Script,
    stages::depth::DepthSettings,
};

/// In place of a folder.
pub const SIMULATED: &str = "simulated";
/// Of the tabletop script: one in so many, from this one on. Some of them show the glass, some the cup.
const SIMULATED_FIRST: u64 = 40;
const SIMULATED_EVERY: u64 = 160;
/// The memory that the service would have then sees one in so many.
const REMEMBERED_EVERY: u64 = 10;

/// # Errors
/// A folder that cannot be read.
pub fn run(what: &str, settings: &Settings, seed: u64, as_json: bool) -> anyhow::Result<()> {
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(settings.threads)
        .build()?;
    if what == SIMULATED {
        let pool = Arc::new(pool);
        pool.install(|| simulated(settings, seed, as_json, &pool))
    } else {
        pool.install(|| stereo_folder(Path::new(what), settings.depth_labels, as_json))
    }
}

fn stereo_folder(folder: &Path, labels: usize, as_json: bool) -> anyhow::Result<()> {
    let scene = StereoScene::open(folder)?;
    let range = scene.disparities(labels);
    let bad = |cameras| stereo::evaluate(&scene, DepthSettings::default(), cameras, &range);
    let (three, two) = (bad(Cameras::Three), bad(Cameras::Two));
    if as_json {
        let mut report = json!(three);
        report["folder"] = json!(folder.display().to_string());
        report["most_disparity_px"] = json!(range.near);
        report["labels"] = json!(range.labels);
        report["two_cameras"] = json!(two);
        return output::line(report);
    }
    let mut table = Table::new(&[
        "cameras",
        "bad > 1 px %",
        "> 0.5 px %",
        "at jumps %",
        "half hidden %",
        "of valid %",
        "no depth %",
        "mean error px",
    ]);
    for (cameras, bad) in [("3", three), ("2", two)] {
        table.row(vec![
            cameras.to_owned(),
            number(Some(bad.bad_over_1px), 2),
            number(Some(bad.bad_over_half_px), 2),
            number(Some(bad.near_discontinuities), 2),
            number(Some(bad.half_occluded), 2),
            number(Some(bad.bad_of_valid), 2),
            number(Some(bad.invalid), 2),
            number(Some(bad.mean_error_px), 3),
        ]);
    }
    output::lines(table)
}

fn simulated(
    settings: &Settings,
    seed: u64,
    as_json: bool,
    pool: &Arc<ThreadPool>,
) -> anyhow::Result<()> {
    let script = Script::tabletop(seed);
    let end = script.frames.unwrap_or(0);
    let frames: Vec<u64> = (SIMULATED_FIRST..end)
        .step_by(SIMULATED_EVERY as usize)
        .collect();
    let within = simulated_depth::evaluate(&script, &frames, depth_range(settings));
    let along_the_way =
        simulated_depth::along_the_way(&script, &frames, REMEMBERED_EVERY, settings, pool.clone());
    if as_json {
        let mut report = json!(within);
        report["along_the_way"] = json!(along_the_way);
        return output::line(report);
    }
    let mut table = Table::new(&[
        "frames",
        "labels",
        "within one %",
        "along the way %",
        "of valid %",
        "at centres %",
        "mixed %",
        "cloth %",
        "besides %",
        "glass %",
        "behind glass %",
        "no depth %",
        "median error %",
    ]);
    table.row(vec![
        within.frames.to_string(),
        within.labels.to_string(),
        number(within.within_one_label, 2),
        number(along_the_way, 2),
        number(within.within_one_label_of_valid, 2),
        number(within.within_one_label_at_centre, 2),
        number(within.mixed, 2),
        number(within.cloth, 2),
        number(within.besides_cloth, 2),
        number(within.glass, 2),
        number(within.behind_glass, 2),
        number(within.invalid, 2),
        number(within.median_error, 2),
    ]);
    output::lines(table)
}
