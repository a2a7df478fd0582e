//! Frames without a pose are placed between the samples of the `pose` key.

use surprised::{
    model::pose::Pose,
    wire::{encode, keys},
};

use crate::rig::{Rig, SECOND, camera, next_rejection, next_report, poseless, wall};

#[tokio::test(flavor = "multi_thread")]
async fn a_frame_waits_for_the_pose_after_it_and_stands_between_the_two() {
    let rig = Rig::start(&["pose_wait_s=10", "refine_pose=false"]).await;
    let head = camera("lab", "anna");
    let reports = rig.subscribe(&head, keys::REPORT).await;
    rig.put_calibration(&head).await;
    let stamp_ns = wall(&head, 1, 0.0).stamp_ns;
    let before = encode::pose_sample(stamp_ns - SECOND / 10, &Pose::translation(1.0, 0.0, 0.0));
    let after = encode::pose_sample(
        stamp_ns + SECOND * 3 / 10,
        &Pose::translation(3.0, 0.0, 0.0),
    );
    rig.put(&head, keys::POSE, &before).await;
    rig.put(&head, keys::FRAME, &poseless(&head, 1)).await;
    rig.status_when("lab", |status| status["cameras"][0]["robot"] == "anna")
        .await;
    assert!(reports.is_empty(), "the pose after the frame has not come");
    rig.put(&head, keys::POSE, &after).await;
    let pose = next_report(&reports)
        .await
        .world_from_camera
        .expect("a pose");
    let position = pose.position.expect("a position");
    assert!((position.x - 1.5).abs() < 1e-9, "{position:?}");
    rig.stop().await.expect("a clean stop");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_frame_beyond_the_newest_pose_is_refused_when_its_wait_is_over() {
    let rig = Rig::start(&["pose_wait_s=0.05"]).await;
    let head = camera("lab", "anna");
    let rejections = rig.subscribe(&head, keys::REJECTED).await;
    rig.put_calibration(&head).await;
    let early = encode::pose_sample(wall(&head, 1, 0.0).stamp_ns - 1, &Pose::identity());
    rig.put(&head, keys::POSE, &early).await;
    rig.put(&head, keys::FRAME, &poseless(&head, 1)).await;
    assert_eq!(next_rejection(&rejections).await.code, "no_pose");
    rig.stop().await.expect("a clean stop");
}
