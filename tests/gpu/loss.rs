//! A device that is lost: no frame that was reported is lost with it, and the processor takes over where it may.

use super::{
    CardRules, card_engines, counters, processor,
    robot::{Robot, assert_same_report, place},
};

#[test]
fn a_lost_device_loses_no_frame_that_was_reported() {
    let (Some(one), Some(other)) = (
        card_engines(CardRules::any()),
        card_engines(CardRules::any()),
    ) else {
        return;
    };
    let card = other.card().expect("it was opened");
    let (mut undisturbed, mut disturbed) = (Robot::new(&one), Robot::new(&other));
    for round in 0..3 {
        for step in 0..4 {
            let scene = place(round == 2);
            let expected = undisturbed.see(&scene, step);
            if step == 2 {
                card.destroy_device();
                // Whether the maps of the frame before were read in time or not: asking does no harm.
                disturbed.pipeline.maps();
            }
            assert_eq!(
                disturbed.see(&scene, step),
                expected,
                "round {round}, step {step}"
            );
            assert!(card.works() && !card.is_awaited());
            if step == 2 {
                let (got, expected) = (disturbed.pipeline.maps(), undisturbed.pipeline.maps());
                assert_eq!(got.score.surprise, expected.score.surprise);
                assert_eq!(got.prior.data, expected.prior.data);
            }
        }
    }
    assert_eq!(
        disturbed.pipeline.memory().viewpoints(),
        undisturbed.pipeline.memory().viewpoints()
    );
    assert_eq!(counters(disturbed.pipeline.engine()).losses, 3);
    assert_eq!(counters(undisturbed.pipeline.engine()).losses, 0);
}

#[test]
fn the_processor_takes_over_where_no_device_is_left_and_loses_no_frame() {
    let rules = CardRules {
        falls_back: true,
        ..CardRules::any()
    };
    let Some(engines) = card_engines(rules) else {
        return;
    };
    let card = engines.card().expect("it was opened");
    let mut other_place = Robot::new(&engines);
    let (mut disturbed, mut on_processor) = (Robot::new(&engines), Robot::new(&processor()));
    let mut found = 0;
    for round in 0..3 {
        for step in 0..4 {
            let scene = place(round == 2);
            let expected = on_processor.see(&scene, step);
            let learnt = disturbed.pipeline.memory().viewpoints().to_vec();
            let is_lost_now = round == 1 && step == 2;
            if is_lost_now {
                assert_ne!(disturbed.pipeline.engine().name(), "processor");
                card.unplug();
            }
            let report = disturbed.see(&scene, step);
            found += assert_same_report(&report, &expected);
            if is_lost_now {
                assert_eq!(disturbed.pipeline.engine().name(), "processor");
                // Of what was learnt only the viewpoint that the frame went into has changed.
                let known = disturbed.pipeline.memory().viewpoints();
                let changed = |view: &&_| !known.contains(*view);
                assert!(learnt.iter().filter(changed).count() <= 1);
                assert!(report.viewpoint_id.is_some());
                // The processor is there, so nothing is waited for.
                assert!(!card.works() && !card.is_awaited());
            }
        }
    }
    assert!(found >= 2, "the box was found {found} times");
    // The other places find out for themselves, and new ones begin on the processor.
    other_place.see(&place(false), 0);
    assert_eq!(other_place.pipeline.engine().name(), "processor");
    let new = Robot::new(&engines);
    assert_eq!(new.pipeline.engine().name(), "processor");
}

#[test]
fn without_a_processor_to_fall_back_on_frames_are_refused_and_the_card_is_awaited() {
    let Some(engines) = card_engines(CardRules::any()) else {
        return;
    };
    let card = engines.card().expect("it was opened");
    let mut robot = Robot::new(&engines);
    robot.see(&place(false), 0);
    card.unplug();
    let known = robot.pipeline.memory().viewpoints().to_vec();
    let error = robot.try_see(&place(false), 1).expect_err("no device");
    assert!(error.to_string().contains("graphics device"), "{error}");
    assert!(card.is_awaited());
    assert_eq!(robot.pipeline.memory().viewpoints(), known);
}
