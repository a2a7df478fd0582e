//! Frames in, a report for each out; what was not there before is a region.

use surprised::wire::{encode, keys};

use crate::rig::{Rig, camera, changed, next_report, posed, wall};

#[tokio::test(flavor = "multi_thread")]
async fn every_frame_gets_a_report_and_a_change_is_a_region() {
    let rig = Rig::start(&[]).await;
    let head = camera("lab", "anna");
    let reports = rig.subscribe(&head, keys::REPORT).await;
    rig.put_calibration(&head).await;
    for sequence in 1..=20 {
        rig.put(&head, keys::FRAME, &posed(&head, sequence)).await;
        let report = next_report(&reports).await;
        assert_eq!(report.sequence, sequence);
        assert_eq!(
            (
                report.place.as_str(),
                report.robot.as_str(),
                report.camera.as_str()
            ),
            ("lab", "anna", "head")
        );
        assert!(report.learned && report.processing_seconds > 0.0);
        assert!(report.regions.is_empty(), "nothing has changed");
    }
    let change = encode::frame(&changed(wall(&head, 21, 0.0)));
    rig.put(&head, keys::FRAME, &change).await;
    let report = next_report(&reports).await;
    assert_eq!(report.regions.len(), 1, "{report:?}");
    let found = report.regions[0].r#box.expect("a region has a box");
    assert!(found.x_min <= 30 && found.x_max >= 34 && found.y_min <= 22 && found.y_max >= 26);
    rig.stop().await.expect("a clean stop");
}
