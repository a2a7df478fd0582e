//! What `evaluate` says of a recording does not depend on the engine.

use std::{io::Write, path::PathBuf};

use surprised::{
    config::Settings,
    dataset::{self, Recording},
    engine::Engines,
    evaluation::{
        measure::{Conditions, measure},
        method::{Method, MethodKind},
        summary::{PassSummary, passes},
    },
};

use super::{CardRules, card_engines, processor, skipped};

fn recordings() -> Option<Vec<Recording>> {
    let data = std::env::var_os("SURPRISED_DATA")
        .map_or_else(|| PathBuf::from("../shared/data"), PathBuf::from);
    let folder = data.join("tabletop");
    folder
        .is_dir()
        .then(|| dataset::open(&folder).expect("the recording can be read"))
}

fn evaluate(recordings: &[Recording], engines: &Engines) -> Vec<PassSummary> {
    let settings = Settings::robust();
    let mut method = Method::new(MethodKind::Preset, &settings, engines);
    let rows = measure(
        recordings,
        &mut method,
        &settings,
        &Conditions::default(),
        |_| {},
    );
    passes(&rows.expect("every frame can be used"))
}

#[test]
fn selectivities_of_the_tabletop_are_those_of_the_processor() {
    let Some(recordings) = recordings() else {
        skipped("no recordings");
        return;
    };
    let Some(card) = card_engines(CardRules::any()) else {
        return;
    };
    let got = evaluate(&recordings, &card);
    let expected = evaluate(&recordings, &processor());
    assert_eq!(got.len(), expected.len());
    let mut compared = 0;
    for (got, expected) in got.iter().zip(&expected) {
        assert_eq!((&got.phase, &got.pass), (&expected.phase, &expected.pass));
        let (Some(a), Some(b)) = (&got.object, &expected.object) else {
            assert!(got.object.is_none() && expected.object.is_none());
            continue;
        };
        let name = format!("{} {} {}", got.phase, got.pass, a.name);
        writeln!(
            std::io::stderr(),
            "{name}: AS {:.3} {:.3} dB, PAS {:.3} {:.3} dB, AUC {:.4} {:.4}, alarms {} {}",
            a.as_db,
            b.as_db,
            a.pas_db,
            b.pas_db,
            a.auc,
            b.auc,
            got.alarms,
            expected.alarms
        )
        .unwrap();
        assert!((a.as_db - b.as_db).abs() < 0.1, "{name}");
        assert!((a.pas_db - b.pas_db).abs() < 0.1, "{name}");
        assert!((a.auc - b.auc).abs() < 0.002, "{name}");
        compared += 1;
    }
    assert!(compared >= 4, "only {compared} passes have an object");
}
