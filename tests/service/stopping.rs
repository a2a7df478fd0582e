//! A stop finishes the frames that have come, within its deadline.

use surprised::wire::keys;

use crate::rig::{Rig, camera, next_report, posed};

#[tokio::test(flavor = "multi_thread")]
async fn the_last_frame_is_finished_and_reported() {
    let rig = Rig::start(&[]).await;
    let head = camera("lab", "anna");
    let reports = rig.subscribe(&head, keys::REPORT).await;
    rig.put_calibration(&head).await;
    rig.put(&head, keys::FRAME, &posed(&head, 1)).await;
    next_report(&reports).await;
    rig.put(&head, keys::FRAME, &posed(&head, 2)).await;
    // The frame has reached the service; its report may not be there yet.
    rig.status("lab").await;
    let stopped = tokio::spawn(rig.stop());
    assert_eq!(next_report(&reports).await.sequence, 2);
    stopped
        .await
        .expect("no panic")
        .expect("within the deadline");
}
