//! `evaluate DIR --prior`: how well the memory tells what is seen from where nobody stood.

use serde_json::json;

use crate::{
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
            ]);
        }
        results.push((&recording.name, held_out));
    }
    if as_json {
        let results: Vec<_> = results
            .iter()
            .map(|(name, held_out)| json!({ "recording": name, "held_out": held_out }))
            .collect();
        println!("{}", json!(results));
        return Ok(());
    }
    for (name, held_out) in &results {
        println!(
            "{name}: {} frames learnt into {} viewpoints, {} left out",
            held_out.learnt, held_out.viewpoints, held_out.left_out
        );
    }
    print!("{table}");
    Ok(())
}
