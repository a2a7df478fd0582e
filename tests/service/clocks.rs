//! Stamps that go back are refused; one wild stamp or a reset clock never locks a robot out.

use surprised::wire::{encode::timestamp, keys};

use crate::rig::{NOON, Rig, SECOND, camera, next_rejection, next_report, posed};

#[tokio::test(flavor = "multi_thread")]
async fn a_wild_stamp_and_a_reset_clock_lock_nobody_out() {
    let rig = Rig::start(&[]).await;
    let head = camera("lab", "anna");
    let reports = rig.subscribe(&head, keys::REPORT).await;
    let rejections = rig.subscribe(&head, keys::REJECTED).await;
    rig.put_calibration(&head).await;
    let year = 365 * 24 * 3600 * SECOND;
    let story = [
        (NOON, true),
        (NOON + SECOND, true),
        (NOON + SECOND / 2, false),
        (NOON + 2 * SECOND, true),
        // Wild, ahead.
        (NOON + year, true),
        (NOON + 3 * SECOND, true),
        // Wild, back.
        (0, false),
        (NOON + 4 * SECOND, true),
        // A clock that starts at zero after a reset.
        (5 * SECOND, false),
        (6 * SECOND, false),
        (7 * SECOND, true),
        (8 * SECOND, true),
    ];
    for (sequence, (stamp_ns, accepted)) in (1..).zip(story) {
        let mut frame = posed(&head, sequence);
        frame.stamp = Some(timestamp(stamp_ns));
        rig.put(&head, keys::FRAME, &frame).await;
        if accepted {
            assert_eq!(next_report(&reports).await.sequence, sequence);
        } else {
            let rejection = next_rejection(&rejections).await;
            assert_eq!(
                (rejection.sequence, rejection.code.as_str()),
                (sequence, "stamp_order")
            );
        }
    }
    rig.stop().await.expect("a clean stop");
}
