//! While a camera's frame is being worked on, newer ones replace each other; those and the lost are counted.

use surprised::wire::{encode, keys};

use crate::rig::{Rig, camera, next_report, posed, poseless, wall};

#[tokio::test(flavor = "multi_thread")]
async fn the_newest_frame_wins_and_gaps_are_counted() {
    let rig = Rig::start(&["pose_wait_s=10"]).await;
    let head = camera("lab", "anna");
    let reports = rig.subscribe(&head, keys::REPORT).await;
    rig.put_calibration(&head).await;
    // The first keeps the worker's hand on this camera until its pose comes.
    rig.put(&head, keys::FRAME, &poseless(&head, 1)).await;
    rig.status_when("lab", |status| status["asks_busy"] == 0)
        .await;
    tokio::time::timeout(std::time::Duration::from_millis(200), reports.recv_async())
        .await
        .expect_err("no report before the pose");
    for sequence in 2..=6 {
        rig.put(&head, keys::FRAME, &posed(&head, sequence)).await;
    }
    let pose = encode::pose_sample(
        wall(&head, 1, 0.0).stamp_ns,
        &wall(&head, 1, 0.0).world_from_camera,
    );
    rig.put(&head, keys::POSE, &pose).await;
    assert_eq!(next_report(&reports).await.sequence, 1);
    assert_eq!(next_report(&reports).await.sequence, 6);
    // 7 to 9 never come.
    rig.put(&head, keys::FRAME, &posed(&head, 10)).await;
    assert_eq!(next_report(&reports).await.sequence, 10);
    let status = rig.status_when("lab", |status| status["frames"] == 3).await;
    let counted = &status["cameras"][0];
    assert_eq!(counted["frames_replaced"], 4, "{status}");
    assert_eq!(counted["frames_lost"], 3, "{status}");
    rig.stop().await.expect("a clean stop");
}
