//! Two services of one network share a store: robots hear from the one that writes the place, and nothing beside it.

use surprised::{
    memory::store::Store,
    wire::{encode, keys},
};
use tempfile::TempDir;

use crate::{
    rig::{ROOT, Rig, camera, next_report, patient, wall},
    web::send,
};

/// Frames that may be refused aloud before the second service has heard of the first.
const STRANGERS: u64 = 5;
const FRAMES: u64 = 25;

#[tokio::test(flavor = "multi_thread")]
async fn a_service_that_hears_the_writer_report_refuses_quietly_and_takes_over() {
    let folder = TempDir::new().expect("a folder");
    let store = || Some(Store::in_folder(folder.path().to_owned()).expect("a store"));
    let head = camera("lab", "anna");
    let first = Rig::remembering(&[], store()).await;
    first.put_calibration(&head).await;
    let writes = |status: &serde_json::Value| status["store"]["role"] == "writer";
    first.status_when("lab", writes).await;

    let second = Rig::beside(&first, store()).await;
    let reports = second.subscribe(&head, keys::REPORT).await;
    let rejections = second.subscribe(&head, keys::REJECTED).await;
    second.put_calibration(&head).await;
    for sequence in 1..=FRAMES {
        let message = encode::frame(&wall(&head, sequence, 0.0));
        second.put(&head, keys::FRAME, &message).await;
        assert!(next_report(&reports).await.learned);
        // Each is counted where it was refused.
        patient(async {
            loop {
                let status = send(&second, "GET /api/v1/places/lab", &[], b"")
                    .await
                    .json();
                if status["refused_by"]["place_held"] == sequence {
                    return;
                }
                tokio::time::sleep(std::time::Duration::from_millis(5)).await;
            }
        })
        .await;
    }
    // Both answer, behind all that they have published.
    let answers = second
        .session
        .get(keys::memory(ROOT, "lab", "views"))
        .consolidation(zenoh::query::ConsolidationMode::None)
        .await
        .expect("a get");
    while answers.recv_async().await.is_ok() {}
    let mut aloud = 0;
    while let Ok(Some(_)) = rejections.try_recv() {
        aloud += 1;
    }
    assert!(
        aloud <= STRANGERS,
        "{aloud} of {FRAMES} frames were refused aloud"
    );

    first.stop().await.expect("a clean stop");
    patient(async {
        loop {
            let status = send(&second, "GET /api/v1/places/lab", &[], b"")
                .await
                .json();
            if writes(&status) {
                return;
            }
            tokio::time::sleep(std::time::Duration::from_millis(5)).await;
        }
    })
    .await;
    let message = encode::frame(&wall(&head, FRAMES + 1, 0.0));
    second.put(&head, keys::FRAME, &message).await;
    assert!(next_report(&reports).await.learned);
    second.stop().await.expect("a clean stop");
}
