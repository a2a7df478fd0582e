//! `evaluate`: how good the settings are on recordings with truth, beside image differencing.

use std::{path::PathBuf, sync::Arc};

use anyhow::Context;

use crate::{
    config::{Preset, Settings},
    dataset,
    evaluation::{
        measure::{Conditions, FrameRow, measure},
        method::{Method, MethodKind},
        summary::{Headline, ObjectSummary, PassSummary, headline, passes},
    },
};

/// Judge settings on a recording with truth, beside image differencing.
#[derive(Debug, clap::Args)]
pub struct EvaluateArgs {
    /// A recording in TUM RGB-D layout, or a folder of them (runs of one place).
    dir: PathBuf,
    #[arg(long, value_enum, default_value_t)]
    preset: Preset,
    /// A setting by name, `name=value`; may be repeated.
    #[arg(long = "set", value_name = "NAME=VALUE")]
    pairs: Vec<String>,
    /// Settings (TOML) over the preset.
    #[arg(long, value_name = "FILE")]
    settings: Option<PathBuf>,
}

/// # Errors
/// Settings that are wrong, recordings that cannot be read, files that cannot be written.
pub fn run(arguments: EvaluateArgs) -> anyhow::Result<()> {
    let file = arguments
        .settings
        .as_ref()
        .map(|path| {
            std::fs::read_to_string(path).with_context(|| format!("reading {}", path.display()))
        })
        .transpose()?;
    let settings = Settings::layered(arguments.preset, file.as_deref(), &arguments.pairs)?;
    let recordings = dataset::open(&arguments.dir)?;
    let pool = Arc::new(
        rayon::ThreadPoolBuilder::new()
            .num_threads(settings.threads)
            .build()?,
    );
    let conditions = Conditions::default();
    let methods = [
        ("preset", MethodKind::Preset),
        ("diff", MethodKind::Diff),
        ("diff_all", MethodKind::DiffAll),
    ];
    let mut headlines = Vec::new();
    for (name, kind) in methods {
        let mut method = Method::new(kind, &settings, &pool);
        let rows: Vec<FrameRow> =
            measure(&recordings, &mut method, &settings, &conditions, |_| {})?;
        let summaries = passes(&rows);
        print_passes(name, &summaries);
        headlines.push((name, headline(&summaries)));
    }
    print_headlines(&headlines);
    Ok(())
}

fn print_passes(method: &str, passes: &[PassSummary]) {
    println!("{method}");
    println!(
        "  {:<10} {:<14} {:>3} | {:>6} {:>6} {:>5} {:>5} {:>5} {:>5} {:>6} {:>6} | {:>6} {:>6} {:>6} {:>6} {:>5}",
        "pass",
        "object",
        "n",
        "AS",
        "PAS",
        "AUC",
        "AP",
        "IoU",
        "err",
        "in",
        "det",
        "out p50",
        "p95",
        "max",
        "alarms",
        "views"
    );
    for pass in passes {
        let name = format!("{} {} {}", pass.run, pass.phase, pass.pass);
        let object = match &pass.object {
            Some(o) => format!(
                "{:<8} {:>3} | {:>6.2} {:>6.2} {:>5.3} {:>5.2} {:>5.2} {:>5.0} {:>6.2} {:>6}",
                o.name,
                o.frames,
                o.as_db,
                o.pas_db,
                o.auc,
                o.average_precision,
                o.iou,
                o.error_grey.unwrap_or(f64::NAN),
                o.mean_inside,
                o.detected
            ),
            None => format!("{:<8} {:>3} | {:>48}", "", pass.frames, ""),
        };
        println!(
            "  {:<18} {object} | {:>6.2} {:>6.2} {:>6.2} {:>6} {:>5}",
            name,
            pass.outside_p50,
            pass.outside_p95,
            pass.outside_max,
            pass.alarms,
            pass.viewpoints
        );
    }
}

fn print_headlines(headlines: &[(&str, Headline)]) {
    println!(
        "{:<16} {:>6} {:>6} {:>5} | {:>6} {:>6} {:>5} {:>5} {:>5} {:>5} {:>5} {:>6} | {:>6} {:>6} | {:>8} {:>8} {:>5}",
        "method",
        "B_AS",
        "B_PAS",
        "B_AP",
        "C_AS",
        "C_PAS",
        "AUC",
        "AP",
        "IoU",
        "drop",
        "err",
        "Cb_AS",
        "D_AS",
        "D/C",
        "FA learn",
        "FA back",
        "views"
    );
    for (name, line) in headlines {
        let of = |object: &Option<ObjectSummary>, value: &dyn Fn(&ObjectSummary) -> f64| {
            object.as_ref().map_or(f64::NAN, value)
        };
        println!(
            "{:<16} {:>6.2} {:>6.2} {:>5.2} | {:>6.2} {:>6.2} {:>5.3} {:>5.2} {:>5.2} {:>5.1} {:>5.0} {:>6.2} | {:>6.2} {:>6.2} | {:>4}/{:<3} {:>4}/{:<3} {:>5}",
            name,
            of(&line.b, &|o| o.as_db),
            of(&line.b, &|o| o.pas_db),
            of(&line.b, &|o| o.average_precision),
            of(&line.c, &|o| o.as_db),
            of(&line.c, &|o| o.pas_db),
            of(&line.c, &|o| o.auc),
            of(&line.c, &|o| o.average_precision),
            of(&line.c, &|o| o.iou),
            line.c_drop_db.unwrap_or(f64::NAN),
            of(&line.c_back, &|o| o.error_grey.unwrap_or(f64::NAN)),
            of(&line.c_back, &|o| o.as_db),
            of(&line.d, &|o| o.as_db),
            line.d_over_c_db.unwrap_or(f64::NAN),
            line.alarms_learnt.0,
            line.alarms_learnt.1,
            line.alarms_back.0,
            line.alarms_back.1,
            line.viewpoints
        );
    }
}
