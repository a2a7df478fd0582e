//! `evaluate DIR --prior`: how well the memory tells what is seen from where nobody stood.

use serde_json::json;

use crate::{
    commands::output,
    config::Settings,
    dataset::Recording,
    engine::Engines,
    evaluation::{
        held_out,
        table::{Table, number},
    },
};

/// # Errors
/// Files that cannot be read, and frames that cannot be used.
pub fn run(
    recordings: &[Recording],
    settings: &Settings,
    engines: &Engines,
    as_json: bool,
) -> anyhow::Result<()> {
    let mut table = Table::new(&[
        "prediction",
        "covered %",
        "PSNR dB",
        "|Y| error",
        "| where all tell: PSNR dB",
        "|Y| error",
        "| with one gain: PSNR dB",
        "|Y| error",
        "gain",
    ]);
    let mut results = Vec::new();
    for recording in recordings {
        let held_out = held_out::evaluate(recording, settings, engines)?;
        for of in &held_out.predictions {
            table.row(vec![
                of.name.to_owned(),
                number(100.0 * of.coverage, 1),
                number(of.own.psnr_db, 2),
                number(of.own.error_grey, 2),
                number(of.common.psnr_db, 2),
                number(of.common.error_grey, 2),
                number(of.with_gain.psnr_db, 2),
                number(of.with_gain.error_grey, 2),
                number(of.gain, 2),
            ]);
        }
        results.push((&recording.name, held_out));
    }
    if as_json {
        let results: Vec<_> = results
            .iter()
            .map(|(name, held_out)| json!({ "recording": name, "held_out": held_out }))
            .collect();
        return output::line(json!(results));
    }
    for (name, held_out) in &results {
        output::line(format_args!(
            "{name}: {} frames learnt into {} viewpoints, {} left out; found {:.1} mm and {:.2} degrees from their poses",
            held_out.learnt,
            held_out.viewpoints,
            held_out.left_out,
            1000.0 * held_out.correction_m,
            held_out.correction_rad.to_degrees()
        ))?;
    }
    output::lines(table)
}
