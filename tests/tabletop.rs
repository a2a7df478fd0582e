//! On real images the paper's surprise beats plain image differencing: a new cup stands out more, and its removal is
//! less surprising than its coming.

use std::{path::PathBuf, sync::Arc};

use surprised::{
    config::{Preset, Settings},
    dataset::{self, Recording},
    engine::{EngineKind, Engines},
    evaluation::{
        measure::{Conditions, measure},
        method::{Method, MethodKind},
        summary::{Headline, headline, passes},
    },
    isa::Isa,
};

fn recordings() -> Option<Vec<Recording>> {
    let data = std::env::var_os("SURPRISED_DATA")
        .map_or_else(|| PathBuf::from("../shared/data"), PathBuf::from);
    let folder = data.join("tabletop");
    folder
        .is_dir()
        .then(|| dataset::open(&folder).expect("the recording can be read"))
}

#[test]
fn the_paper_finds_a_new_cup_better_than_differencing_and_forgives_its_removal() {
    let Some(recordings) = recordings() else {
        println!("skipped: no recordings");
        return;
    };
    let settings = Settings::layered(Preset::Paper, None, &["viewpoints=25".to_owned()])
        .expect("settings are valid");
    let pool = Arc::new(
        rayon::ThreadPoolBuilder::new()
            .build()
            .expect("threads start"),
    );
    let engines = Engines::new(EngineKind::Cpu, pool, Isa::detect()).expect("there is a processor");
    let run = |kind: MethodKind| -> Headline {
        let mut method = Method::new(kind, &settings, &engines);
        let rows = measure(
            &recordings,
            &mut method,
            &settings,
            &Conditions::default(),
            |_| {},
        )
        .expect("every frame can be used");
        headline(&passes(&rows))
    };
    let paper = run(MethodKind::Preset);
    let plain = run(MethodKind::Diff);
    let cup = paper.c.expect("phase C evaluates the cup");
    let cup_by_difference = plain.c.expect("phase C evaluates the cup");
    assert!(
        cup.as_db >= cup_by_difference.as_db + 0.5,
        "AS {:.2} dB against {:.2} dB",
        cup.as_db,
        cup_by_difference.as_db
    );
    assert!(cup.auc > 0.98, "AUC {:.3}", cup.auc);
    assert!(
        cup.average_precision > 0.80,
        "AP {:.3}",
        cup.average_precision
    );
    assert!(cup.iou > 0.7, "IoU {:.2}", cup.iou);
    let removal_db = paper.d_over_c_db.expect("phases C and D evaluate the cup");
    assert!(removal_db <= -1.5, "removal {removal_db:.1} dB");
}
