//! With `pull_hz` the service gets the frames of live cameras; one got twice is used once.

use std::sync::{
    Arc,
    atomic::{AtomicU64, Ordering},
};

use surprised::wire::{encode, keys, proto};
use zenoh::Wait;

use crate::rig::{ROOT, Rig, calibration, camera, next_report, posed};

#[tokio::test(flavor = "multi_thread")]
async fn live_cameras_are_asked_for_their_frames() {
    let rig = Rig::start(&["pull_hz=200"]).await;
    let head = camera("lab", "anna");
    let reports = rig.subscribe(&head, keys::REPORT).await;
    let key = head.key(ROOT, keys::FRAME);
    let asked = Arc::new(AtomicU64::new(0));
    let (counter, path) = (asked.clone(), head.clone());
    let queryable = rig
        .session
        .declare_queryable(key.clone())
        .callback(move |query| {
            // Each frame is the answer to two gets.
            let sequence = 1 + counter.fetch_add(1, Ordering::Relaxed) / 2;
            let frame = proto::Frame {
                calibration: Some(calibration()),
                ..posed(&path, sequence)
            };
            query
                .reply(&key, encode::bytes(&frame))
                .encoding(keys::encoding::<proto::Frame>())
                .wait()
                .expect("a reply");
        })
        .await
        .expect("a queryable");
    assert_eq!(asked.load(Ordering::Relaxed), 0, "nobody is live yet");
    let token = rig
        .session
        .liveliness()
        .declare_token(head.live(ROOT))
        .await
        .expect("a token");
    let mut last = 0;
    for _ in 0..5 {
        let report = next_report(&reports).await;
        assert!(report.sequence > last, "in order and never twice");
        last = report.sequence;
    }
    let status = rig
        .status_when("lab", |status| {
            status["cameras"][0]["frames_repeated"].as_u64() > Some(0)
        })
        .await;
    assert_eq!(status["cameras"][0]["live"], true);
    assert_eq!(status["refused"], 0, "{status}");
    token.undeclare().await.expect("undeclared");
    rig.status_when("lab", |status| status["cameras"][0]["live"] == false)
        .await;
    drop(queryable);
    rig.stop().await.expect("a clean stop");
}
