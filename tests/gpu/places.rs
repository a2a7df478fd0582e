//! Places share a card: one device for all, and a bounded part of its memory for each.

use surprised::engine::gpu::residency::BYTES_PER_PIXEL;

use super::{
    CardRules, card_engines, counters,
    robot::{PIXELS, Robot, place},
};

#[test]
fn a_small_budget_makes_viewpoints_come_and_go_and_changes_no_result() {
    let small = CardRules {
        arena_bytes_max: 1,
        ..CardRules::any()
    };
    let (Some(roomy), Some(tight)) = (card_engines(CardRules::any()), card_engines(small)) else {
        return;
    };
    let (mut roomy, mut tight) = (Robot::new(&roomy), Robot::new(&tight));
    // There and back along more places than seven.
    for (scene, steps) in [
        (place(false), (0..22).collect::<Vec<usize>>()),
        (place(true), (0..22).rev().collect()),
    ] {
        for step in steps {
            let expected = roomy.see(&scene, step);
            assert_eq!(tight.see(&scene, step), expected, "step {step}");
            let (got, expected) = (tight.pipeline.maps(), roomy.pipeline.maps());
            assert_eq!(got.prior.data, expected.prior.data);
            assert_eq!(got.score.surprise, expected.score.surprise);
        }
    }
    assert_eq!(
        tight.pipeline.memory().viewpoints(),
        roomy.pipeline.memory().viewpoints()
    );
    let (tight, roomy) = (
        counters(tight.pipeline.engine()),
        counters(roomy.pipeline.engine()),
    );
    assert_eq!((roomy.evicted, roomy.views_brought), (0, 0), "{roomy:?}");
    assert!(tight.evicted > 10 && tight.views_brought > 10, "{tight:?}");
    assert_eq!(tight.on_processor, 0, "{tight:?}");
    // What a recall needs is granted, and no more.
    assert!(
        tight.resident_bytes <= 7 * (PIXELS + 4) * BYTES_PER_PIXEL,
        "{tight:?}"
    );
    assert!(roomy.resident_bytes > tight.resident_bytes);
}

#[test]
fn places_on_one_card_report_what_each_reports_alone_and_share_its_memory() {
    // Ten viewpoints of the robot's.
    let few = CardRules {
        arena_bytes_max: 10 * (PIXELS + 4) * BYTES_PER_PIXEL,
        ..CardRules::any()
    };
    let (Some(alone), Some(shared)) = (card_engines(few), card_engines(few)) else {
        return;
    };
    let mut alone = Robot::new(&alone);
    let mut first = Robot::new(&shared);
    for step in 0..22 {
        assert_eq!(
            first.see(&place(false), step),
            alone.see(&place(false), step)
        );
    }
    let before = counters(first.pipeline.engine()).resident_bytes;
    assert!(before > 8 * PIXELS * BYTES_PER_PIXEL, "{before}");
    let mut second = Robot::new(&shared);
    for step in (0..22).rev() {
        let expected = alone.see(&place(false), step);
        assert_eq!(first.see(&place(false), step), expected, "step {step}");
        second.see(&place(true), step);
    }
    for robot in [&first, &second] {
        let counters = counters(robot.pipeline.engine());
        assert!(
            counters.resident_bytes <= 7 * (PIXELS + 4) * BYTES_PER_PIXEL,
            "{counters:?}"
        );
    }
    // A device that is lost for one is lost for all, and replaced once.
    shared.card().expect("it was opened").destroy_device();
    let expected = alone.see(&place(false), 3);
    assert_eq!(first.see(&place(false), 3), expected);
    second.see(&place(true), 3);
    assert!(shared.card().expect("it was opened").works());
}
