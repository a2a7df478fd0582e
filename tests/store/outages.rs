//! What happens while the store cannot be reached, and to a service whose place another one has taken meanwhile.

use std::{sync::Arc, time::Duration};

use object_store::{memory::InMemory, path::Path};
use surprised::{
    memory::store::{Role, Store},
    model::mode::{Mode, Modes},
};

use super::{
    flaky::{Flaky, Interrupted},
    rig::{STEP_M, Service},
};

fn at() -> Path {
    Path::from("outages")
}

#[test]
fn a_service_goes_on_in_ram_and_stores_everything_when_the_store_is_back() {
    let flaky = Flaky::new(Arc::new(InMemory::new()));
    let store = Store::with_objects(flaky.clone(), at());
    let mut service = Service::writer(&store);
    service.learn_row(3);
    service.until_stored();
    flaky.cut_off(true);
    for index in 3..9 {
        service.learn(STEP_M * index as f64, index);
    }
    service.until("the trouble is known", |service| {
        let status = service.store.status();
        status
            .trouble
            .is_some_and(|trouble| trouble.contains("cut off"))
            && status.write_failures > 0
    });
    assert_eq!(service.store.status().pending, 6);
    service.learn(0.0, 80);
    let learnt = service.content();
    assert_eq!(learnt.len(), 9);
    flaky.cut_off(false);
    service.until("everything is stored", |service| {
        let status = service.store.status();
        status.pending == 0 && status.trouble.is_none()
    });
    assert!(service.store.status().late > 0);
    service.crash();
    let mut again = Service::writer(&store);
    again.until_known(9);
    assert_eq!(again.content(), learnt);
    again.stop();
}

#[test]
fn what_a_store_was_interrupted_at_is_written_again_unless_it_is_whole() {
    let inner = Arc::new(InMemory::new());
    let flaky = Flaky::new(inner.clone());
    let store = Store::with_objects(flaky.clone(), at());
    let mut service = Service::writer(&store);
    flaky.interrupt([Interrupted::Half, Interrupted::Whole, Interrupted::Half]);
    service.learn_row(4);
    service.until("everything is stored", |service| {
        let status = service.store.status();
        flaky.to_interrupt() == 0 && status.pending == 0 && status.trouble.is_none()
    });
    assert!(service.store.status().write_failures > 0);
    let learnt = service.content();
    assert_eq!(learnt.len(), 4);
    let said = Modes::said(None, Mode::Freeze);
    flaky.interrupt([Interrupted::Half]);
    service.store.say(&said);
    service.until_stored();
    service.crash();
    let mut again = Service::writer(&Store::with_objects(inner, at()));
    again.until_known(4);
    assert_eq!(again.content(), learnt);
    assert_eq!(again.store.status().damaged, 0);
    assert_eq!(again.store.take_modes(), Some(said));
    again.stop();
}

#[test]
fn a_service_that_cannot_read_its_place_refuses_frames_until_it_can() {
    let inner = Arc::new(InMemory::new());
    let mut service = Service::writer(&Store::with_objects(inner.clone(), at()));
    service.learn_row(2);
    service.stop();
    let flaky = Flaky::new(inner);
    flaky.cut_off(true);
    let mut service = Service::start(&Store::with_objects(flaky.clone(), at()));
    assert!(!service.store.wait_read(Duration::from_millis(200)));
    let refusal = service.store.may_learn().expect_err("nothing is known");
    assert_eq!(refusal.code, "memory_unread");
    assert!(refusal.detail.contains("cut off"), "{refusal}");
    let refusal = service.store.may_recall().expect_err("nothing is known");
    assert_eq!(refusal.code, "memory_unread");
    flaky.cut_off(false);
    service.until("it writes the place", |service| {
        service.store.role() == Role::Writer && service.memory.known() == 2
    });
    service.store.may_recall().expect("it has been read");
    service.stop();
}

#[test]
fn a_service_that_lost_its_place_while_it_was_cut_off_writes_nothing_any_more() {
    let inner = Arc::new(InMemory::new());
    let flaky = Flaky::new(inner.clone());
    let mut first = Service::writer(&Store::with_objects(flaky.clone(), at()));
    first.learn_row(3);
    first.until_stored();
    flaky.cut_off(true);
    // In RAM only; the same viewpoint that the other one changes as well.
    first.learn(0.0, 500);
    let mut second = Service::start(&Store::with_objects(inner.clone(), at()));
    second.until("it has taken over", |service| {
        service.store.role() == Role::Writer
    });
    second.learn(0.0, 600);
    second.learn(STEP_M * 5.0, 601);
    second.until_stored();
    let learnt = second.content();

    flaky.cut_off(false);
    first.until("it knows that it lost the place", |service| {
        matches!(service.store.role(), Role::Reader { .. }) && service.store.status().lost > 0
    });
    first.until("it has read what the other one wrote", |service| {
        service.memory.heads() == second.memory.heads()
    });
    assert_eq!(first.content(), learnt);
    assert_eq!(
        first.store.may_learn().expect_err("lost").code,
        "place_held"
    );
    first.stop();
    second.stop();
    let mut third = Service::writer(&Store::with_objects(inner, at()));
    third.until_known(learnt.len());
    assert_eq!(third.content(), learnt);
    third.stop();
}

#[test]
fn a_stop_without_a_store_ends_in_time_and_says_what_is_lost() {
    let flaky = Flaky::new(Arc::new(InMemory::new()));
    let mut service = Service::writer(&Store::with_objects(flaky.clone(), at()));
    flaky.cut_off(true);
    service.learn_row(2);
    let Service { store, memory, .. } = &mut service;
    assert!(!store.close(memory, Duration::from_millis(300)));
}
