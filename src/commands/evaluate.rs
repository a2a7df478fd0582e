//! `evaluate`: how good settings are on recordings with truth, beside image differencing.
//!
//! In the recording `revisit` a TV changes by itself: `--ignore-world 0.58,-1.42,2.90,0.5` leaves it out. The ball lies
//! around its bezel, placed by the depth there at 2004.43 s; the screen itself has no depth and is never predicted.

mod depth;

mod prior;

use std::{
    fmt::Write as _,
    fs,
    path::{Path, PathBuf},
    str::FromStr,
    sync::Arc,
};

use anyhow::Context;
use nalgebra::Point3;
use serde::Serialize;
use tempfile::TempDir;

use super::{Usage, output};
use crate::{
    config::{Evidence, Preset, Settings},
    dataset::{self, Recording},
    engine::{EngineKind, Engines},
    evaluation::{
        figures,
        measure::{AddedNoise, Conditions, FrameRow, Ignored, Seen, measure},
        method::{Method, MethodKind},
        summary::{BoxSummary, Headline, ObjectSummary, PassSummary, boxes, headline, passes},
        table::{Table, number},
    },
    isa::Isa,
    pipeline::depth_range,
    simulation::{
        script::Script,
        write::{self, Truth},
    },
};

/// Judge settings on a recording with truth, beside image differencing.
#[derive(Debug, clap::Args)]
pub struct EvaluateArgs {
    /// A recording in TUM RGB-D layout, or a folder of them (runs of one place, in the order of their names), or
    /// `simulated`: the paper's experiment in the simulated world.
    #[arg(required_unless_present = "depth", value_name = "DIR|simulated")]
    dir: Option<PathBuf>,
    /// With `simulated`: the robot has no depth camera, depth is computed from its three cameras.
    #[arg(long, conflicts_with = "depth")]
    rig: bool,
    /// Judge computed depth instead, on a folder with left.png, middle.png, right.png and disparity.png (value / 16 =
    /// pixels), or `simulated`: frames of the tabletop script.
    #[arg(long, value_name = "DIR|simulated", conflicts_with_all = ["dir", "csv", "figures", "leave_one_out"])]
    depth: Option<String>,
    /// Judge instead what the memory expects where nobody stood: every fifth frame that the recording begins with is left
    /// out of what is learnt, and compared with the prior there.
    #[arg(long, conflicts_with_all = ["depth", "csv", "figures", "leave_one_out", "pose_noise_m", "pose_noise_deg", "ignore_world"])]
    prior: bool,
    #[arg(long, value_enum, default_value_t)]
    preset: Preset,
    /// A setting by name; may be repeated.
    #[arg(long = "set", value_name = "NAME=VALUE")]
    pairs: Vec<String>,
    /// Settings (TOML) over the preset.
    #[arg(long, value_name = "FILE")]
    settings: Option<PathBuf>,
    /// Where recall and surprise are computed.
    #[arg(long, value_enum, default_value_t)]
    engine: EngineKind,
    /// Write a row for each frame and method.
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,
    /// Print one JSON object in place of tables.
    #[arg(long)]
    json: bool,
    /// Draw the curves of the paper's Figs. 9, 10 and 13 (SVG), and what is seen, expected and surprising (PNG).
    #[arg(long, value_name = "DIR")]
    figures: Option<PathBuf>,
    /// In place of image differencing, the settings with each step turned off in turn.
    #[arg(long)]
    leave_one_out: bool,
    /// Noise added to the poses per axis, standard deviation in metres. The settings' stated noise stays.
    #[arg(long, value_name = "SD", default_value_t = 0.0)]
    pose_noise_m: f64,
    /// The same in degrees.
    #[arg(long, value_name = "SD", default_value_t = 0.0)]
    pose_noise_deg: f64,
    /// Of the noise, and of what is simulated.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// A ball in the world, metres, where change is not counted as a false alarm, as a screen's; may be repeated.
    #[arg(long, value_name = "X,Y,Z,RADIUS", allow_hyphen_values = true)]
    ignore_world: Vec<Ball>,
}

#[derive(Debug, Clone, Copy)]
struct Ball(Ignored);

impl FromStr for Ball {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let numbers: Option<Vec<f64>> = text
            .split(',')
            .map(|word| word.trim().parse().ok())
            .map(|number: Option<f64>| number.filter(|number| number.is_finite()))
            .collect();
        match numbers.as_deref() {
            Some(&[x, y, z, radius_m]) if radius_m > 0.0 => Ok(Self(Ignored {
                center_in_world: Point3::new(x, y, z),
                radius_m,
            })),
            _ => Err("write it as x,y,z,radius in metres".to_owned()),
        }
    }
}

/// In place of a folder; figures are named after it.
const SIMULATED: &str = "simulated";

/// The paper's sequence I1 as its robot records it, in a folder that goes when it is dropped.
fn simulate(seed: u64, truth: Truth) -> anyhow::Result<TempDir> {
    let folder = tempfile::tempdir().context("no temporary folder can be made")?;
    let script = Script::tabletop(seed);
    let options = write::Options {
        truth,
        ..write::Options::whole(&script, u64::MAX)
    };
    write::recording(&folder.path().join(SIMULATED), &script, &options)?;
    Ok(folder)
}

/// One line of the tables.
struct Trial {
    name: &'static str,
    kind: MethodKind,
    settings: Settings,
}

#[derive(Serialize)]
struct Outcome {
    method: &'static str,
    passes: Vec<PassSummary>,
    /// Where objects are evaluated.
    headline: Option<Headline>,
    /// Where there are boxes: the memory learns run after run.
    boxes: Option<BoxSummary>,
    /// The same with a memory that learnt the first run only.
    boxes_first_run_only: Option<BoxSummary>,
    #[serde(skip)]
    rows: Vec<FrameRow>,
}

/// # Errors
/// Settings that are wrong, recordings that cannot be read, files that cannot be written.
pub fn run(arguments: EvaluateArgs) -> anyhow::Result<()> {
    let file = arguments
        .settings
        .as_ref()
        .map(|path| {
            fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))
        })
        .transpose()?;
    let settings = Settings::layered(arguments.preset, file.as_deref(), &arguments.pairs)?;
    if let Some(what) = &arguments.depth {
        return depth::run(what, &settings, arguments.seed, arguments.json);
    }
    let dir = arguments
        .dir
        .as_deref()
        .context("name a recording to evaluate, or --depth")?;
    // Dropped, and so removed, at the end.
    let is_simulated = dir == Path::new(SIMULATED);
    if arguments.rig && !is_simulated {
        let why = "--rig is for `simulated`: a recording has the depth that it has";
        return Err(Usage(why).into());
    }
    let truth = if arguments.rig {
        Truth::Computed(depth_range(&settings))
    } else {
        Truth::Measured
    };
    let simulated = is_simulated
        .then(|| simulate(arguments.seed, truth))
        .transpose()?;
    let recordings = match &simulated {
        Some(folder) => dataset::open(&folder.path().join(SIMULATED))?,
        None => dataset::open(dir)?,
    };
    if let Some(folder) = &arguments.figures {
        fs::create_dir_all(folder).with_context(|| format!("cannot make {}", folder.display()))?;
    }
    let pool = Arc::new(
        rayon::ThreadPoolBuilder::new()
            .num_threads(settings.threads)
            .build()?,
    );
    let engines = Engines::new(arguments.engine, pool, Isa::detect())?;
    if arguments.prior {
        return prior::run(&recordings, &settings, &engines, arguments.json);
    }
    let noisy = arguments.pose_noise_m > 0.0 || arguments.pose_noise_deg > 0.0;
    let conditions = Conditions {
        ignored: arguments.ignore_world.iter().map(|ball| ball.0).collect(),
        pose_noise: noisy.then_some(AddedNoise {
            position_m: arguments.pose_noise_m,
            rotation_deg: arguments.pose_noise_deg,
            seed: arguments.seed,
        }),
        first_run_only: false,
    };
    // Before minutes of work that would be lost. What is there already stays until there is something better.
    if let Some(path) = &arguments.csv {
        let opened = fs::OpenOptions::new().create(true).append(true).open(path);
        opened.with_context(|| format!("cannot write {}", path.display()))?;
    }
    let trials = if arguments.leave_one_out {
        leave_one_out(&settings)
    } else {
        beside_differencing(&settings)
    };
    let outcomes = trials
        .iter()
        .enumerate()
        .map(|(number, trial)| {
            let figures = arguments.figures.as_deref().filter(|_| number == 0);
            outcome(trial, &recordings, &conditions, &engines, figures)
        })
        .collect::<anyhow::Result<Vec<_>>>()?;

    if let Some(path) = &arguments.csv {
        fs::write(path, csv(&outcomes))
            .with_context(|| format!("cannot write {}", path.display()))?;
    }
    if let Some(folder) = &arguments.figures {
        let rows: Vec<(&str, &[FrameRow])> = outcomes
            .iter()
            .map(|outcome| (outcome.method, outcome.rows.as_slice()))
            .collect();
        figures::curves(folder, &rows)?;
    }
    if arguments.json {
        let report = serde_json::json!({
            "recording": dir.display().to_string(),
            "settings": settings,
            "methods": outcomes,
        });
        output::line(report)
    } else {
        output::lines(tables(&outcomes))
    }
}

fn beside_differencing(settings: &Settings) -> Vec<Trial> {
    [
        ("preset", MethodKind::Preset),
        ("diff", MethodKind::Diff),
        ("diff_all", MethodKind::DiffAll),
    ]
    .map(|(name, kind)| Trial {
        name,
        kind,
        settings: settings.clone(),
    })
    .into()
}

/// The settings with one step less.
type TurnOff = fn(&mut Settings);

fn leave_one_out(settings: &Settings) -> Vec<Trial> {
    let steps: [(&str, TurnOff); 11] = [
        ("preset", |_| ()),
        ("- refine_pose", |s| s.refine_pose = false),
        ("- fresh_views", |s| s.fresh_views = false),
        ("- colour_vote", |s| s.colour_vote = false),
        ("- depth_vote", |s| s.depth_vote = false),
        ("- view_variance", |s| s.view_variance = false),
        ("- earlier_appearance", |s| s.earlier_appearance = false),
        ("- second_look", |s| s.second_look = false),
        ("- exposure_gain", |s| s.exposure_gain = false),
        ("- edge_error_px", |s| s.edge_error_px = 0.0),
        ("- block_median", |s| s.evidence = Evidence::Blocks),
    ];
    steps
        .map(|(name, turn_off)| {
            let mut settings = settings.clone();
            turn_off(&mut settings);
            Trial {
                name,
                kind: MethodKind::Preset,
                settings,
            }
        })
        .into()
}

fn outcome(
    trial: &Trial,
    recordings: &[Recording],
    conditions: &Conditions,
    engines: &Engines,
    figures: Option<&Path>,
) -> anyhow::Result<Outcome> {
    let sampled = figures::sample_frames(recordings);
    let mut drawn = Ok(());
    let mut draw = |seen: &Seen| {
        if let Some(folder) = figures
            && drawn.is_ok()
            && sampled.contains(&seen.frame.stamp_ns)
        {
            let moment = &seen.row.moment;
            let parts = [&seen.row.run, &moment.phase, &moment.pass];
            let words: Vec<&str> = parts
                .iter()
                .flat_map(|part| part.split_whitespace())
                .collect();
            drawn = figures::triptych(folder, &words.join("-"), seen);
        }
    };
    let play = |conditions: &Conditions, each: &mut dyn FnMut(&Seen)| {
        let mut method = Method::new(trial.kind, &trial.settings, engines);
        measure(recordings, &mut method, &trial.settings, conditions, each)
    };
    let rows = play(conditions, &mut draw)?;
    drawn?;
    let in_order = boxes(&rows);
    let first_only = if in_order.is_some() {
        let conditions = Conditions {
            first_run_only: true,
            ..conditions.clone()
        };
        boxes(&play(&conditions, &mut |_| ())?)
    } else {
        None
    };
    let passes = passes(&rows);
    let has_objects = passes.iter().any(|pass| pass.object.is_some());
    Ok(Outcome {
        method: trial.name,
        headline: has_objects.then(|| headline(&passes)),
        passes,
        boxes: in_order,
        boxes_first_run_only: first_only,
        rows,
    })
}

/// What the recording has truth for.
fn tables(outcomes: &[Outcome]) -> String {
    let mut text = String::new();
    if outcomes.iter().any(|outcome| outcome.headline.is_some()) {
        for outcome in outcomes.iter().filter(|_| outcomes.len() <= 3) {
            let _ = writeln!(
                text,
                "{}\n{}",
                outcome.method,
                object_table(&outcome.passes)
            );
        }
        text += &headline_table(outcomes).to_string();
    } else if outcomes.iter().any(|outcome| outcome.boxes.is_some()) {
        text += &box_table(outcomes).to_string();
    } else {
        text += &alarm_table(outcomes).to_string();
    }
    text
}

fn object_table(passes: &[PassSummary]) -> Table {
    let mut table = Table::new(&[
        "pass", "object", "frames", "AS", "PAS", "AUC", "AP", "IoU", "err", "inside", "outside",
        "found", "out p50", "p95", "max", "alarms", "views",
    ]);
    for pass in passes {
        let of = |value: fn(&ObjectSummary) -> f64, digits: usize| {
            number(pass.object.as_ref().map(value), digits)
        };
        table.row(vec![
            format!("{} {}", pass.phase, pass.pass),
            pass.object
                .as_ref()
                .map_or("-".to_owned(), |object| object.name.clone()),
            pass.frames.to_string(),
            of(|o| o.as_db, 2),
            of(|o| o.pas_db, 2),
            of(|o| o.auc, 3),
            of(|o| o.average_precision, 2),
            of(|o| o.iou, 2),
            of(|o| o.error_grey.unwrap_or(f64::NAN), 0),
            of(|o| o.mean_inside, 2),
            of(|o| o.max_outside, 2),
            pass.object.as_ref().map_or("-".to_owned(), |object| {
                format!("{}/{}", object.detected, object.frames)
            }),
            number(pass.outside_p50, 2),
            number(pass.outside_p95, 2),
            number(pass.outside_max, 2),
            pass.alarms.to_string(),
            pass.viewpoints.to_string(),
        ]);
    }
    table
}

fn headline_table(outcomes: &[Outcome]) -> Table {
    let mut table = Table::new(&[
        "method",
        "B_AS",
        "B_PAS",
        "B_AP",
        "C_AS",
        "C_PAS",
        "C_AUC",
        "C_AP",
        "C_IoU",
        "drop",
        "C_err",
        "Cb_AS",
        "D_AS",
        "D/C",
        "FA learnt",
        "FA back",
        "views",
    ]);
    for (method, line) in outcomes
        .iter()
        .filter_map(|outcome| Some((outcome.method, outcome.headline.as_ref()?)))
    {
        let of = |object: &Option<ObjectSummary>,
                  value: fn(&ObjectSummary) -> f64,
                  digits: usize| { number(object.as_ref().map(value), digits) };
        let share = |(alarms, frames): (usize, usize)| format!("{alarms}/{frames}");
        table.row(vec![
            method.to_owned(),
            of(&line.b, |o| o.as_db, 2),
            of(&line.b, |o| o.pas_db, 2),
            of(&line.b, |o| o.average_precision, 2),
            of(&line.c, |o| o.as_db, 2),
            of(&line.c, |o| o.pas_db, 2),
            of(&line.c, |o| o.auc, 3),
            of(&line.c, |o| o.average_precision, 2),
            of(&line.c, |o| o.iou, 2),
            number(line.c_drop_db, 1),
            of(&line.c_back, |o| o.error_grey.unwrap_or(f64::NAN), 0),
            of(&line.c_back, |o| o.as_db, 2),
            of(&line.d, |o| o.as_db, 2),
            number(line.d_over_c_db, 1),
            share(line.alarms_learnt),
            share(line.alarms_back),
            line.viewpoints.to_string(),
        ]);
    }
    table
}

fn box_table(outcomes: &[Outcome]) -> Table {
    let mut table = Table::new(&[
        "method",
        "images",
        "new found",
        "recall %",
        "false/image",
        "of these taken away",
        "| memory = first run only: found",
        "recall %",
        "false/image",
    ]);
    for outcome in outcomes {
        let (Some(order), Some(first)) = (outcome.boxes, outcome.boxes_first_run_only) else {
            continue;
        };
        table.row(vec![
            outcome.method.to_owned(),
            order.images.to_string(),
            format!("{}/{}", order.found, order.wanted),
            number(100.0 * order.recall(), 1),
            number(order.false_per_image(), 2),
            order.taken_away.to_string(),
            format!("{}/{}", first.found, first.wanted),
            number(100.0 * first.recall(), 1),
            number(first.false_per_image(), 2),
        ]);
    }
    table
}

fn alarm_table(outcomes: &[Outcome]) -> Table {
    let mut table = Table::new(&[
        "method",
        "pass",
        "frames",
        "largest block p50",
        "p95",
        "max",
        "alarms",
        "views",
    ]);
    for outcome in outcomes {
        for pass in &outcome.passes {
            table.row(vec![
                outcome.method.to_owned(),
                format!("{} {}", pass.phase, pass.pass).trim().to_owned(),
                pass.frames.to_string(),
                number(pass.outside_p50, 2),
                number(pass.outside_p95, 2),
                number(pass.outside_max, 2),
                pass.alarms.to_string(),
                pass.viewpoints.to_string(),
            ]);
        }
    }
    table
}

fn csv(outcomes: &[Outcome]) -> String {
    let mut text = "method,run,timestamp,phase,pass,object,as_db,pas_db,mean_inside,max_inside,max_outside,\
        auc,average_precision,iou,error_grey,largest,largest_outside,threshold,regions,viewpoints,correction_m,\
        boxes_wanted,boxes_found,false_regions\n"
        .to_owned();
    for outcome in outcomes {
        for row in &outcome.rows {
            let object = row.object.as_ref();
            let cells: Vec<String> = [
                object.map(|o| o.as_db),
                object.map(|o| o.pas_db),
                object.map(|o| o.mean_inside),
                object.map(|o| o.max_inside),
                object.map(|o| o.max_outside),
                object.map(|o| o.auc),
                object.map(|o| o.average_precision),
                object.map(|o| o.iou),
                object.and_then(|o| o.error_grey),
                Some(row.largest),
                Some(row.largest_outside),
                Some(row.threshold),
                Some(row.regions as f64),
                Some(row.viewpoints as f64),
                Some(row.correction_m),
                row.boxes.map(|boxes| boxes.wanted as f64),
                row.boxes.map(|boxes| boxes.found as f64),
                row.boxes.map(|boxes| boxes.false_regions as f64),
            ]
            .iter()
            .map(|cell| cell.map_or(String::new(), |value| value.to_string()))
            .collect();
            let _ = writeln!(
                text,
                "{},{},{:.6},{},{},{},{}",
                outcome.method,
                row.run,
                row.stamp_s,
                row.moment.phase,
                row.moment.pass,
                row.moment.evaluated.as_deref().unwrap_or_default(),
                cells.join(",")
            );
        }
    }
    text
}
