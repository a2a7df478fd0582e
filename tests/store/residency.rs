//! A place may be larger than RAM.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use object_store::{memory::InMemory, path::Path};
use surprised::{
    memory::store::{Brought, PlaceOptions, Store},
    model::frame::Source,
};

use super::{
    flaky::Flaky,
    rig::{Backend, DEADLINE, PLACE, STEP_M, Service, any_viewpoint, at, options, viewpoint_bytes},
};

/// Viewpoints in RAM, of [`KNOWN`].
const ROOM: usize = 80;
const KNOWN: usize = 400;

fn small() -> PlaceOptions {
    PlaceOptions {
        memory_bytes: ROOM * viewpoint_bytes(),
        ..options()
    }
}

fn walker() -> Source {
    Source {
        robot: "r".into(),
        camera: "c".into(),
    }
}

#[test]
fn a_place_larger_than_ram_is_learnt_and_everything_of_it_is_there() {
    let backend = Backend::folder();
    let mut service = Service::with(&backend.store(), PLACE, small());
    service.until("it may learn", |service| service.store.may_learn().is_ok());
    for index in 0..KNOWN {
        let id = service.learn(STEP_M * index as f64, index as u64);
        assert_eq!(id, index as u64 + 1);
        // What is not stored yet cannot leave: learning is faster here than any robot.
        if index % 20 == 0 {
            service.until_stored();
        }
    }
    service.until_stored();
    assert_eq!(service.memory.known(), KNOWN);
    assert!(service.memory.bytes() <= ROOM * viewpoint_bytes());
    assert_eq!(service.memory.replaced_for_room(), 0);
    // The way back finds every viewpoint as it was, and adds none.
    for index in (0..KNOWN).rev().step_by(7) {
        let x_m = STEP_M * index as f64;
        service.store.bring(&mut service.memory, &at(x_m));
        let found = service
            .memory
            .viewpoints()
            .iter()
            .find(|viewpoint| viewpoint.id == index as u64 + 1)
            .expect("it was brought");
        assert_eq!(found.records, any_viewpoint(x_m, index as u64).records);
        assert!(service.memory.bytes() <= ROOM * viewpoint_bytes());
    }
    assert!(service.memory.evicted() as usize > KNOWN - ROOM);
    service.stop();
}

#[test]
fn in_steady_motion_no_frame_waits_for_the_store() {
    let flaky = Flaky::new(Arc::new(InMemory::new()));
    let store = Store::with_objects(flaky.clone(), Path::from("walk"));
    let mut service = Service::with(&store, PLACE, small());
    service.until("it may learn", |service| service.store.may_learn().is_ok());
    for index in 0..KNOWN {
        service.learn(STEP_M * index as f64, index as u64);
        if index % 20 == 0 {
            service.until_stored();
        }
    }
    service.until_stored();

    // A read takes a while, as over a network.
    flaky.slow_reads(Duration::from_millis(15));
    let walk = |service: &mut Service, from_m: f64, frames: usize| {
        let before = service.store.status();
        for frame in 0..frames {
            // 0.5 m/s at 10 frames a second.
            let x_m = from_m + 0.05 * frame as f64;
            service.store.bring(&mut service.memory, &at(x_m));
            let passed = (100_000_000 * frame as i64, at(x_m));
            service
                .store
                .prefetch(&mut service.memory, &walker(), passed);
            // The pace of the frames, a tenth of what it would be.
            std::thread::sleep(Duration::from_millis(10));
            service.store.sync(&mut service.memory);
        }
        let after = service.store.status();
        (after.hits - before.hits, after.misses - before.misses)
    };
    let (hits, misses) = walk(&mut service, 0.0, 400);
    println!("{hits} frames found everything in RAM, {misses} waited");
    // At the beginning nobody could know where it would go.
    assert!(misses <= 3, "{misses} of {} frames waited", hits + misses);
    assert!(hits >= 397);
    assert!(service.memory.evicted() > 0 && service.memory.bytes() <= ROOM * viewpoint_bytes());
    assert_eq!(service.store.status().incomplete, 0);
    service.stop();
}

#[test]
fn a_frame_does_not_wait_long_for_a_store_that_is_gone() {
    let flaky = Flaky::new(Arc::new(InMemory::new()));
    let store = Store::with_objects(flaky.clone(), Path::from("walk"));
    let mut service = Service::with(&store, PLACE, small());
    service.until("it may learn", |service| service.store.may_learn().is_ok());
    for index in 0..2 * ROOM {
        service.learn(STEP_M * index as f64, index as u64);
        if index % 20 == 0 {
            service.until_stored();
        }
    }
    service.until_stored();
    flaky.cut_off(true);
    for _ in 0..20 {
        service.store.bring(&mut service.memory, &at(0.0));
    }
    let status = service.store.status();
    assert_eq!(status.incomplete, 20);
    flaky.cut_off(false);
    service.until("it can be brought", |service| {
        service.store.status().trouble.is_none()
    });
    // What is there is still known, and can be had again.
    service.store.bring(&mut service.memory, &at(0.0));
    assert!(
        service
            .memory
            .viewpoints()
            .iter()
            .any(|viewpoint| viewpoint.id == 1)
    );
    service.stop();
}

#[test]
fn a_question_about_what_is_far_away_gives_its_turn_back_until_that_is_loaded() {
    let flaky = Flaky::new(Arc::new(InMemory::new()));
    let store = Store::with_objects(flaky.clone(), Path::from("walk"));
    let mut service = Service::with(&store, PLACE, small());
    service.until("it may learn", |service| service.store.may_learn().is_ok());
    for index in 0..2 * ROOM {
        service.learn(STEP_M * index as f64, index as u64);
        if index % 20 == 0 {
            service.until_stored();
        }
    }
    service.until_stored();
    let before = service.store.status();
    flaky.hold_reads(true);
    let mut since = None;
    let Service { store, memory, .. } = &mut service;
    for _ in 0..5 {
        assert!(!store.bring_step(memory, &at(0.0), &mut since));
        assert!(since.is_some());
        // A frame of a robot that is where it was finds what it needs.
        let here = at(STEP_M * (2 * ROOM - 1) as f64);
        assert_eq!(store.bring(memory, &here), Brought::Hit);
    }
    flaky.hold_reads(false);
    let end = Instant::now() + DEADLINE;
    while !store.bring_step(memory, &at(0.0), &mut since) {
        assert!(Instant::now() < end, "it is never there");
    }
    assert!(since.is_none(), "the next question begins anew");
    assert!(
        memory
            .viewpoints()
            .iter()
            .any(|viewpoint| viewpoint.id == 1)
    );
    let after = store.status();
    assert_eq!(
        (after.misses - before.misses, after.hits - before.hits),
        (1, 5),
        "a question is counted once however often it waits"
    );
    assert_eq!(after.incomplete, before.incomplete);
    service.stop();
}
