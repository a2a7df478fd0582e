//! What holds wherever viewpoints are stored.

use std::{collections::BTreeMap, time::Duration};

use futures_util::TryStreamExt;
use object_store::{ObjectMeta, ObjectStoreExt, path::Path};
use surprised::{
    memory::store::{PlaceOptions, Role, form},
    model::{
        frame::Source,
        mode::{Mode, Modes},
        viewpoint::Viewpoint,
    },
};

use super::rig::{Backend, PLACE, STEP_M, Service, options};

macro_rules! on_every_backend {
    ($($promise:ident,)*) => {
        mod in_a_folder {
            $(#[test] fn $promise() { super::$promise(&super::Backend::folder()); })*
        }
        mod in_an_object_store {
            $(#[test] fn $promise() { super::$promise(&super::Backend::objects()); })*
        }
        /// All of them, by name.
        pub const SUITE: &[(&str, fn(&Backend))] = &[$((stringify!($promise), $promise)),*];
    };
}

on_every_backend! {
    what_was_learnt_is_there_after_a_stop_bit_for_bit,
    what_was_learnt_is_stored_without_a_stop,
    only_the_newest_state_is_kept,
    what_changed_later_may_change_again_before_it_is_written,
    nothing_goes_before_what_came_in_its_room_is_stored,
    what_was_removed_stays_removed,
    a_damaged_viewpoint_is_set_aside_and_named_and_the_others_are_there,
    objects_that_are_none_are_set_aside,
    what_another_version_wrote_is_left_as_it_is,
    an_earlier_state_serves_where_the_newest_is_damaged,
    a_second_service_answers_what_the_first_learns_and_learns_nothing,
    a_second_service_takes_over_when_the_first_stops,
    a_second_service_takes_over_when_the_first_is_gone,
    places_are_apart_and_listed,
    what_was_said_about_modes_holds_after_a_crash_and_for_who_takes_over,
    damaged_modes_are_set_aside_and_what_was_said_before_holds,
    the_newest_state_of_every_event_is_there_after_a_crash_and_for_who_follows,
    a_damaged_event_is_set_aside_and_an_earlier_state_serves,
}

/// Blocks on a look at the objects themselves.
fn look<T>(work: impl Future<Output = object_store::Result<T>>) -> T {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .worker_threads(1)
        .build()
        .expect("a runtime");
    runtime.block_on(work).expect("the store answers")
}

fn objects_below(backend: &Backend, folder: &str) -> Vec<ObjectMeta> {
    let (objects, root) = backend.objects_at();
    let at = root.join(PLACE).join(folder);
    let mut found: Vec<ObjectMeta> = look(objects.list(Some(&at)).try_collect());
    found.sort_by(|a, b| a.location.cmp(&b.location));
    found
}

fn read(backend: &Backend, path: &Path) -> Vec<u8> {
    let (objects, _) = backend.objects_at();
    look(async { objects.get(path).await?.bytes().await }).to_vec()
}

fn write(backend: &Backend, path: &Path, bytes: Vec<u8>) {
    let (objects, _) = backend.objects_at();
    look(objects.put(path, bytes.into()));
}

/// What a service finds that starts now.
fn recovered(backend: &Backend, count: usize) -> BTreeMap<u64, Viewpoint> {
    let mut service = Service::writer(&backend.store());
    service.until_known(count);
    let content = service.content();
    service.stop();
    content
}

fn what_was_learnt_is_there_after_a_stop_bit_for_bit(backend: &Backend) {
    let mut service = Service::writer(&backend.store());
    service.learn_row(12);
    service.learn(0.01, 100);
    service.learn(0.51, 101);
    let learnt = service.content();
    assert_eq!(learnt.len(), 12);
    service.stop();
    assert_eq!(recovered(backend, 12), learnt);
    // Ids go on where they ended.
    let mut service = Service::writer(&backend.store());
    service.until_known(12);
    assert_eq!(service.learn(5.0, 102), 13);
    service.stop();
}

fn what_was_learnt_is_stored_without_a_stop(backend: &Backend) {
    let mut service = Service::writer(&backend.store());
    service.learn_row(5);
    let learnt = service.content();
    service.until_stored();
    assert_eq!(service.store.status().written, 5);
    service.crash();
    assert_eq!(recovered(backend, 5), learnt);
}

fn only_the_newest_state_is_kept(backend: &Backend) {
    let mut service = Service::writer(&backend.store());
    for round in 0..3 {
        for seed in 0..50 {
            service.learn(0.0, 50 * round + seed);
        }
        service.until_stored();
    }
    let status = service.store.status();
    assert!(
        (3..50).contains(&status.written),
        "{} writes of 150 changes",
        status.written
    );
    let learnt = service.content();
    assert_eq!(learnt[&1].updates, 150);
    service.stop();
    assert_eq!(objects_below(backend, "viewpoints").len(), 1);
    assert_eq!(recovered(backend, 1), learnt);
}

/// Long enough for what is done at once to be done, on a busy machine too.
fn slowly() -> PlaceOptions {
    PlaceOptions {
        write_behind: Duration::from_secs(4),
        ..options()
    }
}

fn slow_writer(backend: &Backend) -> Service {
    let mut service = Service::with(&backend.store(), PLACE, slowly());
    service.until("it writes the place", |service| {
        service.store.role() == Role::Writer
    });
    service
}

fn what_changed_later_may_change_again_before_it_is_written(backend: &Backend) {
    let mut service = slow_writer(backend);
    service.learn(0.0, 1);
    std::thread::sleep(slowly().write_behind_half() / 2);
    service.learn(STEP_M, 2);
    service.until("the first is stored, and the batch it was in", |service| {
        let status = service.store.status();
        status.written > 0 && status.pending < 2
    });
    assert_eq!(service.store.status().written, 1);
    service.learn(STEP_M, 3);
    service.until_stored();
    let status = service.store.status();
    assert_eq!((status.written, status.late), (2, 0));
    let learnt = service.content();
    service.crash();
    assert_eq!(recovered(backend, 2), learnt);
}

fn nothing_goes_before_what_came_in_its_room_is_stored(backend: &Backend) {
    let mut service = slow_writer(backend);
    service.learn_row(2);
    service.until_stored();
    // It changes, and is removed for another much later.
    service.learn(0.0, 3);
    std::thread::sleep(slowly().write_behind_half() / 2);
    assert_eq!(service.memory.remove(|head| head.id == 1), 1);
    service.learn(5.0 * STEP_M, 4);
    service.until("one is gone", |service| service.store.status().removed == 1);
    service.crash();
    let left = recovered(backend, 2);
    assert_eq!(left.into_keys().collect::<Vec<_>>(), [2, 3]);
}

fn what_was_removed_stays_removed(backend: &Backend) {
    let mut service = Service::writer(&backend.store());
    service.learn_row(6);
    service.until_stored();
    let gone = service.memory.remove(|head| head.id % 2 == 0);
    assert_eq!(gone, 3);
    // Also what had changed just before.
    service.learn(0.01, 9);
    assert_eq!(service.memory.remove(|head| head.id == 1), 1);
    service.until_stored();
    service.crash();
    let left = recovered(backend, 2);
    assert_eq!(left.into_keys().collect::<Vec<_>>(), [3, 5]);
}

/// Flips one bit of every second object, each in another part of it.
fn a_damaged_viewpoint_is_set_aside_and_named_and_the_others_are_there(backend: &Backend) {
    let mut service = Service::writer(&backend.store());
    service.learn_row(8);
    let learnt = service.content();
    service.stop();
    let objects = objects_below(backend, "viewpoints");
    let mut names = Vec::new();
    for (index, object) in objects.iter().enumerate().step_by(2) {
        let mut bytes = read(backend, &object.location);
        let length = bytes.len();
        match index {
            // In the head, in the planes, in the last checksum, and cut off.
            0 => bytes[30] ^= 4,
            2 => bytes[length / 2] ^= 1,
            4 => bytes[length - 1] ^= 128,
            _ => bytes.truncate(length - 5),
        }
        write(backend, &object.location, bytes);
        names.push(object.location.filename().expect("a name").to_owned());
    }

    let mut service = Service::writer(&backend.store());
    service.until("damaged ones are found", |service| {
        service.store.status().damaged == 4 && service.memory.known() == 4
    });
    let content = service.content();
    assert_eq!(content.keys().copied().collect::<Vec<_>>(), [2, 4, 6, 8]);
    for (id, viewpoint) in &content {
        assert_eq!(viewpoint, &learnt[id]);
    }
    service.until("they are set aside and named", |service| {
        let named = service.store.status().damaged_names.join(" ");
        let is_named = |name: &String| named.contains(&format!("damaged/{name}"));
        names.iter().all(is_named)
    });
    assert_eq!(objects_below(backend, "damaged").len(), 4);
    service.stop();
    // They are there, and not a second time.
    let service = Service::writer(&backend.store());
    assert_eq!(service.store.status().damaged, 4);
    assert_eq!(service.store.status().recovered, 4);
    service.stop();
    assert_eq!(objects_below(backend, "damaged").len(), 4);
    assert_eq!(objects_below(backend, "viewpoints").len(), 4);
}

fn objects_that_are_none_are_set_aside(backend: &Backend) {
    let mut service = Service::writer(&backend.store());
    service.learn_row(2);
    service.stop();
    let first = objects_below(backend, "viewpoints").swap_remove(0).location;
    let (_, root) = backend.objects_at();
    let folder = root.join(PLACE).join("viewpoints");
    let bytes = read(backend, &first);
    for (name, bytes) in [
        ("notes.txt", b"not a viewpoint".to_vec()),
        ("00000000000000ff-00000001-0000000000000001", Vec::new()),
        // Whole, but another's.
        ("0000000000000100-00000001-0000000000000001", bytes),
    ] {
        write(backend, &folder.clone().join(name), bytes);
    }
    let service = Service::writer(&backend.store());
    let status = service.store.status();
    assert_eq!((status.recovered, status.damaged), (2, 3));
    service.stop();
    assert_eq!(objects_below(backend, "damaged").len(), 3);
}

fn what_another_version_wrote_is_left_as_it_is(backend: &Backend) {
    let mut service = Service::writer(&backend.store());
    service.learn_row(3);
    service.stop();
    let last = objects_below(backend, "viewpoints").swap_remove(2).location;
    let mut bytes = read(backend, &last);
    bytes[8] = 2;
    let head_bytes = u32::from_le_bytes(bytes[12..16].try_into().expect("four bytes")) as usize;
    for end in [head_bytes, bytes.len()] {
        let sum = form::checksum(&bytes[..end - 8]).to_le_bytes();
        bytes[end - 8..end].copy_from_slice(&sum);
    }
    write(backend, &last, bytes.clone());
    let mut service = Service::writer(&backend.store());
    service.until_known(2);
    let status = service.store.status();
    assert_eq!((status.damaged, status.left_unread), (0, 1));
    // Its id is taken.
    assert_eq!(service.learn(7.0, 7), 4);
    service.stop();
    assert_eq!(read(backend, &last), bytes);
}

fn an_earlier_state_serves_where_the_newest_is_damaged(backend: &Backend) {
    let mut service = Service::writer(&backend.store());
    service.learn_row(1);
    service.until_stored();
    let first = objects_below(backend, "viewpoints").swap_remove(0).location;
    let bytes = read(backend, &first);
    let learnt = service.content();
    service.learn(0.0, 77);
    service.until_stored();
    service.crash();
    // As if it had crashed before the earlier one was deleted.
    write(backend, &first, bytes);
    let second = objects_below(backend, "viewpoints")
        .into_iter()
        .find(|object| object.location != first)
        .expect("the newer state");
    let mut damaged = read(backend, &second.location);
    damaged[100] ^= 1;
    write(backend, &second.location, damaged);
    assert_eq!(recovered(backend, 1), learnt);
    assert_eq!(objects_below(backend, "damaged").len(), 1);
}

fn a_second_service_answers_what_the_first_learns_and_learns_nothing(backend: &Backend) {
    let mut first = Service::writer(&backend.store());
    first.learn_row(4);
    first.until_stored();
    let mut second = Service::start(&backend.store());
    second.until("it has read the place", |service| {
        service.memory.known() == 4 && matches!(service.store.role(), Role::Reader { .. })
    });
    let refusal = second.store.may_learn().expect_err("the first one does");
    assert_eq!(refusal.code, "place_held");
    assert!(refusal.detail.contains("process"), "{refusal}");
    assert_eq!(second.content(), first.content());

    // It follows.
    first.learn(0.0, 50);
    first.learn(9.0, 51);
    first.memory.remove(|head| head.id == 2);
    first.until_stored();
    let learnt = first.content();
    second.until("it has followed", |service| {
        let heads = service.memory.heads();
        heads == first.memory.heads()
    });
    assert_eq!(second.content(), learnt);
    second.stop();
    assert_eq!(first.store.role(), Role::Writer);
    first.stop();
}

fn a_second_service_takes_over_when_the_first_stops(backend: &Backend) {
    let mut first = Service::writer(&backend.store());
    let mut second = Service::start(&backend.store());
    first.learn_row(3);
    let learnt = first.content();
    first.stop();
    second.until("it has taken over", |service| {
        service.store.role() == Role::Writer
    });
    assert_eq!(second.content(), learnt);
    second.learn(8.0, 1);
    assert_eq!(second.store.status().epoch, 2);
    second.stop();
}

fn a_second_service_takes_over_when_the_first_is_gone(backend: &Backend) {
    let mut first = Service::writer(&backend.store());
    let mut second = Service::start(&backend.store());
    first.learn_row(3);
    first.until_stored();
    let learnt = first.content();
    // Not stored yet: lost.
    first.learn(STEP_M * 7.0, 70);
    first.crash();
    second.until("it has taken over", |service| {
        service.store.role() == Role::Writer
    });
    let mut content = second.content();
    // What was learnt within `write_behind` may be there or not.
    content.retain(|id, _| *id <= 3);
    assert_eq!(content, learnt);
    second.stop();
}

fn said_of(robot: &str, mode: Mode) -> Modes {
    let source = Source {
        robot: robot.into(),
        camera: "head".into(),
    };
    Modes::said(Some(&source), mode)
}

fn what_was_said_about_modes_holds_after_a_crash_and_for_who_takes_over(backend: &Backend) {
    let mut first = Service::writer(&backend.store());
    assert_eq!(first.store.take_modes(), Some(Modes::default()));
    assert_eq!(first.store.take_modes(), None, "nothing is new");
    first.store.say(&said_of("anna", Mode::Learn));
    let frozen = Modes::said(None, Mode::Freeze);
    first.store.say(&frozen);
    first.until_stored();
    assert_eq!(first.store.take_modes(), Some(frozen.clone()));

    // Another one follows, and keeps what it is told itself until the place is its own.
    let mut second = Service::start(&backend.store());
    second.until("it reads", |service| {
        matches!(service.store.role(), Role::Reader { .. })
    });
    assert_eq!(second.store.take_modes(), Some(frozen.clone()));
    let bert = said_of("bert", Mode::Observe);
    second.store.say(&bert);
    assert_eq!(second.store.take_modes(), Some(frozen.then(&bert)));
    first.store.say(&said_of("anna", Mode::Observe));
    first.until_stored();
    let all = frozen.then(&said_of("anna", Mode::Observe)).then(&bert);
    second.until("it has followed", |service| {
        service.store.take_modes().as_ref() == Some(&all)
    });
    first.crash();
    second.until("it has taken over", |service| {
        service.store.role() == Role::Writer
    });
    second.until_stored();
    second.crash();

    let third = Service::writer(&backend.store());
    assert_eq!(third.store.take_modes(), Some(all));
    third.stop();
    assert_eq!(objects_below(backend, "modes").len(), 1);
}

fn damaged_modes_are_set_aside_and_what_was_said_before_holds(backend: &Backend) {
    let mut service = Service::writer(&backend.store());
    let frozen = Modes::said(None, Mode::Freeze);
    service.store.say(&frozen);
    service.until_stored();
    service.stop();
    let before = objects_below(backend, "modes").swap_remove(0).location;
    let (_, root) = backend.objects_at();
    let newer = root
        .join(PLACE)
        .join("modes")
        .join("00000001-00000000000000ff");
    let mut bytes = read(backend, &before);
    bytes[12] ^= 1;
    write(backend, &newer, bytes);
    let service = Service::writer(&backend.store());
    assert_eq!(service.store.take_modes(), Some(frozen));
    let status = service.store.status();
    assert_eq!(status.damaged, 1);
    assert!(
        status.damaged_names[0].ends_with("damaged/modes-00000001-00000000000000ff"),
        "{:?}",
        status.damaged_names
    );
    service.stop();
    assert_eq!(objects_below(backend, "modes").len(), 1);
}

/// What a service has read of events since it was asked last, by id.
fn events(service: &Service) -> Vec<(u64, Vec<u8>)> {
    let events = service.store.take_events().into_iter();
    let mut events: Vec<(u64, Vec<u8>)> =
        events.map(|(id, content)| (id, content.to_vec())).collect();
    events.sort();
    events
}

fn the_newest_state_of_every_event_is_there_after_a_crash_and_for_who_follows(backend: &Backend) {
    let mut first = Service::writer(&backend.store());
    let keep = |service: &Service, id: u64, content: &[u8]| {
        service.store.keep_event(id, Some(content.to_vec()));
    };
    keep(&first, 7, b"a cup");
    keep(&first, 8, b"a hat");
    first.until_stored();
    keep(&first, 7, b"a cup, higher");
    keep(&first, 9, b"");
    first.store.keep_event(8, None);
    first.until_stored();
    assert_eq!(objects_below(backend, "events").len(), 2);
    assert!(events(&first).is_empty(), "it said all of it itself");

    let mut second = Service::start(&backend.store());
    second.until("it reads", |service| {
        matches!(service.store.role(), Role::Reader { .. })
    });
    let kept = [(7, b"a cup, higher".to_vec()), (9, Vec::new())];
    assert_eq!(events(&second), kept);
    keep(&second, 7, b"not its own place");
    first.crash();
    second.until("it has taken over", |service| {
        service.store.role() == Role::Writer
    });
    assert!(events(&second).is_empty(), "nothing is new");
    keep(&second, 7, b"gone");
    second.until_stored();
    second.crash();

    let third = Service::writer(&backend.store());
    assert_eq!(events(&third), [(7, b"gone".to_vec()), (9, Vec::new())]);
    third.stop();
    assert_eq!(objects_below(backend, "events").len(), 2);
}

fn a_damaged_event_is_set_aside_and_an_earlier_state_serves(backend: &Backend) {
    let mut service = Service::writer(&backend.store());
    service.store.keep_event(1, Some(b"a cup".to_vec()));
    service.until_stored();
    service.stop();
    let before = objects_below(backend, "events").swap_remove(0).location;
    let name = "0000000000000001-00000001-00000000000000ff";
    let (_, root) = backend.objects_at();
    let newer = root.join(PLACE).join("events").join(name);
    let mut bytes = read(backend, &before);
    bytes[2] ^= 1;
    write(backend, &newer, bytes);
    let service = Service::writer(&backend.store());
    assert_eq!(events(&service), [(1, b"a cup".to_vec())]);
    let status = service.store.status();
    assert_eq!(status.damaged, 1);
    let aside = &status.damaged_names[0];
    assert!(aside.ends_with(&format!("damaged/event-{name}")), "{aside}");
    service.stop();
    assert_eq!(objects_below(backend, "events").len(), 1);
}

fn places_are_apart_and_listed(backend: &Backend) {
    let store = backend.store();
    for (place, count) in [("kitchen", 2), ("lab", 1), ("attic", 0)] {
        let mut service = Service::with(&store, place, super::rig::options());
        service.until("it writes the place", |service| {
            service.store.role() == Role::Writer
        });
        service.learn_row(count);
        service.stop();
    }
    let runtime = tokio::runtime::Runtime::new().expect("a runtime");
    let places = runtime.block_on(store.places()).expect("it answers");
    assert_eq!(places, ["kitchen", "lab"]);
    assert_eq!(recovered(backend, 1).len(), 1);
}
