//! A place as one file.

use std::fs;

use surprised::memory::store::{Store, archive::ArchiveError};
use tempfile::TempDir;
use tokio::runtime::Runtime;

use super::rig::{Backend, PLACE, Service, options};

fn runtime() -> Runtime {
    Runtime::new().expect("a runtime")
}

#[test]
fn an_exported_place_is_imported_elsewhere_bit_for_bit() {
    let backend = Backend::folder();
    let mut service = Service::writer(&backend.store());
    service.learn_row(9);
    service.learn(0.0, 90);
    service.until_stored();
    let learnt = service.content();
    let folder = TempDir::new().expect("a folder");
    let file = folder.path().join("lab.place");
    // The service goes on meanwhile.
    let exported = runtime().block_on(backend.store().export(PLACE, &file));
    assert_eq!(exported.expect("it is exported").viewpoints, 9);
    service.stop();

    let other = Backend::objects();
    let imported = runtime().block_on(other.store().import("attic", &file));
    assert_eq!(imported.expect("it is imported").viewpoints, 9);
    let mut service = Service::with(&other.store(), "attic", options());
    service.until("it may learn", |service| service.store.may_learn().is_ok());
    assert_eq!(service.content(), learnt);
    assert_eq!(service.store.status().damaged, 0);
    // It is a place as any other.
    service.learn(0.0, 91);
    service.stop();
    let mut service = Service::with(&other.store(), "attic", options());
    service.until_known(9);
    assert_eq!(service.content()[&1].updates, learnt[&1].updates + 1);
    service.stop();
}

#[test]
fn a_damaged_file_is_refused_before_anything_of_it_is_stored() {
    let backend = Backend::objects();
    let mut service = Service::writer(&backend.store());
    service.learn_row(2);
    service.stop();
    let folder = TempDir::new().expect("a folder");
    let file = folder.path().join("lab.place");
    let runtime = runtime();
    let exported = runtime.block_on(backend.store().export(PLACE, &file));
    exported.expect("it is exported");
    let whole = fs::read(&file).expect("it is there");
    let store = backend.store();
    let refused = |bytes: &[u8]| {
        fs::write(&file, bytes).expect("it can be written");
        matches!(
            runtime.block_on(store.import("attic", &file)),
            Err(ArchiveError::Damaged { .. })
        )
    };
    for at in (0..whole.len()).step_by(7) {
        let mut flipped = whole.clone();
        flipped[at] ^= 1 << (at % 8);
        assert!(refused(&flipped), "byte {at} of {}", whole.len());
        assert!(refused(&whole[..at]), "cut to {at} of {}", whole.len());
    }
    let mut longer = whole.clone();
    longer.push(0);
    assert!(refused(&longer));
    assert_eq!(
        runtime.block_on(store.places()).expect("it answers"),
        [PLACE]
    );
    fs::write(&file, &whole).expect("it can be written");
    let imported = runtime.block_on(store.import("attic", &file));
    assert_eq!(imported.expect("it is whole").viewpoints, 2);
}

#[test]
fn a_place_is_imported_over_no_other_and_under_no_service() {
    let backend = Backend::folder();
    let store: Store = backend.store();
    let mut service = Service::writer(&store);
    service.learn_row(2);
    service.until_stored();
    let folder = TempDir::new().expect("a folder");
    let file = folder.path().join("lab.place");
    let runtime = runtime();
    runtime
        .block_on(store.export(PLACE, &file))
        .expect("it is exported");
    let held = runtime.block_on(store.import(PLACE, &file));
    assert!(matches!(held, Err(ArchiveError::Held { .. })), "{held:?}");
    service.stop();
    let full = runtime.block_on(store.import(PLACE, &file));
    assert!(
        matches!(full, Err(ArchiveError::NotEmpty { .. })),
        "{full:?}"
    );
    let unknown = runtime.block_on(store.export("cellar", &file));
    let sentence = unknown.expect_err("it is not there").to_string();
    assert!(
        sentence.contains("cellar") && sentence.contains(PLACE),
        "{sentence}"
    );
    // What is there was not touched.
    let mut service = Service::writer(&store);
    service.until_known(2);
    assert_eq!(service.content().len(), 2);
    service.stop();
}
