//! A place as one file.

use std::fs;

use bytes::Bytes;
use futures_util::TryStreamExt;
use object_store::ObjectStoreExt;
use surprised::{
    memory::store::{Store, archive::ArchiveError, form},
    model::{
        frame::Source,
        mode::{Mode, Modes},
    },
};
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

fn anna() -> Source {
    Source {
        robot: "anna".into(),
        camera: "head".into(),
    }
}

fn said() -> Modes {
    Modes::said(None, Mode::Freeze).then(&Modes::said(Some(&anna()), Mode::Observe))
}

/// A service that knows more than viewpoints.
fn service_with_notes(store: &Store, viewpoints: usize) -> Service {
    let mut service = Service::writer(store);
    service.learn_row(viewpoints);
    service.store.say(&said());
    for (id, content) in [(3, "a cup, gone since"), (7, "a cup, and its picture")] {
        service.store.keep_event(id, Some(content.into()));
    }
    service.store.keep_calibration(&anna(), b"lenses".to_vec());
    service
}

/// What a service is told at its start beside viewpoints.
fn notes_of(service: &Service) -> (Option<Modes>, Vec<(u64, Bytes)>, Vec<Bytes>) {
    let store = &service.store;
    (
        store.take_modes(),
        store.take_events(),
        store.take_calibrations(),
    )
}

#[test]
fn modes_events_and_calibrations_travel_with_a_place_also_where_there_are_no_viewpoints() {
    for viewpoints in [2, 0] {
        let backend = Backend::folder();
        service_with_notes(&backend.store(), viewpoints).stop();
        let folder = TempDir::new().expect("a folder");
        let file = folder.path().join("lab.place");
        let exported = runtime().block_on(backend.store().export(PLACE, &file));
        let exported = exported.expect("it is exported");
        assert_eq!(
            (exported.viewpoints, exported.events),
            (viewpoints as u64, 2)
        );
        let other = Backend::objects();
        let store = other.store();
        let imported = runtime().block_on(store.import("attic", &file));
        assert_eq!(imported.expect("it is imported").events, 2);
        assert_eq!(
            runtime().block_on(store.places()).expect("it answers"),
            ["attic"]
        );
        let twice = runtime().block_on(store.import("attic", &file));
        assert!(
            matches!(twice, Err(ArchiveError::NotEmpty { .. })),
            "{twice:?}"
        );

        let mut service = Service::with(&store, "attic", options());
        service.until("it may learn", |service| service.store.may_learn().is_ok());
        let (modes, events, calibrations) = notes_of(&service);
        assert_eq!(modes, Some(said()));
        let content = |text: &'static str| Bytes::from(text);
        assert_eq!(
            events,
            [
                (3, content("a cup, gone since")),
                (7, content("a cup, and its picture"))
            ]
        );
        assert_eq!(calibrations, [content("lenses")]);
        assert_eq!(service.store.status().damaged, 0);
        // The next state of an event takes the place of the imported one.
        service.store.keep_event(7, Some(b"it was taken".to_vec()));
        service.stop();
        let mut service = Service::with(&store, "attic", options());
        service.until("it may learn", |service| service.store.may_learn().is_ok());
        assert_eq!(notes_of(&service).1[1], (7, content("it was taken")));
        service.stop();
    }
}

#[test]
fn a_file_of_the_version_before_is_read() {
    let backend = Backend::objects();
    let mut service = Service::writer(&backend.store());
    service.learn_row(3);
    service.until_stored();
    let learnt = service.content();
    service.stop();
    let (objects, at) = backend.objects_at();
    let runtime = runtime();
    let at = at.join(PLACE).join("viewpoints");
    let mut bytes = b"\x89SPLACE\n".to_vec();
    bytes.extend(1u32.to_le_bytes());
    runtime.block_on(async {
        let listed: Vec<_> = objects
            .list(Some(&at))
            .try_collect()
            .await
            .expect("a listing");
        assert_eq!(listed.len(), 3);
        for object in listed {
            let got = objects.get(&object.location).await.expect("it is there");
            let object = got.bytes().await.expect("it can be read");
            bytes.extend((object.len() as u64).to_le_bytes());
            bytes.extend(&object);
        }
    });
    bytes.extend(0u64.to_le_bytes());
    bytes.extend(3u64.to_le_bytes());
    bytes.extend(form::checksum(&bytes).to_le_bytes());
    let folder = TempDir::new().expect("a folder");
    let file = folder.path().join("lab.place");
    fs::write(&file, &bytes).expect("it can be written");

    let other = Backend::objects();
    let imported = runtime.block_on(other.store().import("attic", &file));
    assert_eq!(imported.expect("it is imported").viewpoints, 3);
    let mut service = Service::with(&other.store(), "attic", options());
    service.until_known(3);
    assert_eq!(service.content(), learnt);
    service.stop();
}

#[test]
fn a_damaged_file_is_refused_before_anything_of_it_is_stored() {
    let backend = Backend::objects();
    service_with_notes(&backend.store(), 2).stop();
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
