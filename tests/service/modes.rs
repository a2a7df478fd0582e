//! Cameras are switched between learning, observing and freezing while frames come, over Zenoh and HTTP.

use serde_json::json;
use surprised::{
    memory::store::Store,
    wire::{decode, encode, keys, proto},
};
use tempfile::TempDir;

use crate::{
    rig::{ROOT, Rig, Samples, camera, changed, next_rejection, next_report, wall},
    web::{send, send_json},
};
use surprised::wire::keys::CameraPath;

/// What everybody can see of a memory: equal only if nothing changed.
async fn memory(rig: &Rig) -> (Vec<u8>, Vec<u8>) {
    let views = rig.ask(&keys::memory(ROOT, "lab", "views")).await;
    let selector = "x=0.01;y=0;z=0;qx=0;qy=0;qz=0;qw=1;fx=60;fy=60;cx=31.5;cy=23.5;width=64;height=48;planes=parameters,depth,coverage";
    let prior = keys::memory(ROOT, "lab", "prior");
    (views, rig.ask(&format!("{prior}?{selector}")).await)
}

struct Shown {
    rig: Rig,
    head: CameraPath,
    reports: Samples,
    sequence: u64,
}

impl Shown {
    async fn start(settings: &[&str]) -> Self {
        Self::to(Rig::start(settings).await).await
    }

    async fn to(rig: Rig) -> Self {
        let head = camera("lab", "anna");
        let reports = rig.subscribe(&head, keys::REPORT).await;
        rig.put_calibration(&head).await;
        Self {
            rig,
            head,
            reports,
            sequence: 0,
        }
    }

    /// Whether the next frame was learnt, and whether it surprised.
    async fn show(&mut self, with_change: bool) -> (bool, bool) {
        self.sequence += 1;
        let mut frame = wall(&self.head, self.sequence, 0.0);
        if with_change {
            frame = changed(frame);
        }
        let message = encode::frame(&frame);
        self.rig.put(&self.head, keys::FRAME, &message).await;
        let report = next_report(&self.reports).await;
        (report.learned, !report.regions.is_empty())
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_frozen_camera_reports_and_the_memory_stays_as_it_is() {
    let mut shown = Shown::start(&[]).await;
    for _ in 0..8 {
        assert_eq!(shown.show(false).await, (true, false));
    }
    let key = shown.head.key(ROOT, keys::MODE);
    let mode: proto::Mode = decode::message(&shown.rig.ask(&key).await).expect("a Mode");
    assert_eq!(mode.mode, "learn");

    let before = memory(&shown.rig).await;
    let freeze = proto::Mode {
        mode: "freeze".to_owned(),
    };
    shown.rig.put(&shown.head, keys::MODE, &freeze).await;
    for _ in 0..30 {
        // A learning camera gets used to it within this time.
        assert_eq!(shown.show(true).await, (false, true));
    }
    assert_eq!(memory(&shown.rig).await, before);
    let status = shown.rig.status("lab").await;
    assert_eq!(status["cameras"][0]["mode"], "freeze");

    let json = shown.rig.ask(&format!("{key}?set=learn;format=json")).await;
    assert_eq!(json, br#"{"mode":"learn"}"#);
    assert_eq!(shown.show(true).await, (true, true));
    assert_ne!(memory(&shown.rig).await, before);
    shown.rig.stop().await.expect("a clean stop");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_camera_can_be_told_before_its_first_frame_and_in_plain_text() {
    let mut shown = Shown::start(&[]).await;
    let key = shown.head.key(ROOT, keys::MODE);
    shown.rig.session.put(&key, "observe").await.expect("put");
    assert_eq!(shown.show(false).await, (false, false));
    assert_eq!(shown.rig.status("lab").await["viewpoints"], 0);

    let rejections = shown.rig.subscribe(&shown.head, keys::REJECTED).await;
    shown.rig.session.put(&key, "sleep").await.expect("put");
    let rejection = next_rejection(&rejections).await;
    assert_eq!(
        (rejection.code.as_str(), rejection.key),
        ("bad_mode", key.clone())
    );
    assert_eq!(shown.show(false).await, (false, false), "it observes still");
    let refused = shown.rig.try_ask(&format!("{key}?set=sleep"), None).await;
    assert!(refused.expect_err("no mode").starts_with("bad_mode: "));
    let unknown = camera("lab", "bert").key(ROOT, keys::MODE);
    let refused = shown.rig.try_ask(&unknown, None).await;
    assert!(refused.expect_err("nobody").starts_with("unknown_camera: "));
    shown.rig.stop().await.expect("a clean stop");
}

#[tokio::test(flavor = "multi_thread")]
async fn settings_say_how_cameras_begin_and_robots_differ() {
    let mut shown = Shown::start(&["mode=freeze", "robots.bert.mode=learn"]).await;
    assert_eq!(shown.show(false).await, (false, false));
    let bert = camera("lab", "bert");
    let reports = shown.rig.subscribe(&bert, keys::REPORT).await;
    shown.rig.put_calibration(&bert).await;
    let message = encode::frame(&wall(&bert, 1, 0.0));
    shown.rig.put(&bert, keys::FRAME, &message).await;
    assert!(next_report(&reports).await.learned);
    shown.rig.stop().await.expect("a clean stop");
}

#[tokio::test(flavor = "multi_thread")]
async fn pages_switch_cameras_and_whole_places() {
    let mut shown = Shown::start(&[]).await;
    assert_eq!(shown.show(false).await, (true, false));
    let rig = &shown.rig;
    let one = "/api/v1/places/lab/robots/anna/head/mode";
    let all = "/api/v1/places/lab/mode";
    assert_eq!(
        send(rig, &format!("GET {one}"), &[], b"").await.json(),
        json!({"mode": "learn"})
    );
    let set = send_json(rig, &format!("PUT {one}"), json!({"mode": "observe"})).await;
    assert_eq!((set.status, set.json()), (200, json!({"mode": "observe"})));
    let other = "/api/v1/places/lab/robots/bert/head/mode";
    assert_eq!(
        send(rig, &format!("GET {other}"), &[], b"").await.status,
        404
    );
    assert_eq!(
        send(rig, &format!("GET {all}"), &[], b"").await.json(),
        json!({"mode": "learn"})
    );
    for (method, body) in [
        (one, json!({"mode": "sleep"})),
        (all, json!({})),
        (one, json!(3)),
    ] {
        let refused = send_json(rig, &format!("PUT {method}"), body).await;
        assert_eq!(refused.status, 400);
        assert!(refused.head.contains("application/problem+json"));
    }
    assert_eq!(shown.show(false).await, (false, false));

    // What was said for one is overruled by what is said for all, those to come included.
    let rig = &shown.rig;
    send_json(rig, &format!("PUT {all}"), json!({"mode": "freeze"})).await;
    assert_eq!(
        send(rig, &format!("GET {one}"), &[], b"").await.json(),
        json!({"mode": "freeze"})
    );
    send_json(rig, &format!("PUT {other}"), json!({"mode": "learn"})).await;
    send_json(rig, &format!("PUT {all}"), json!({"mode": "learn"})).await;
    assert_eq!(rig.status("lab").await["mode"], "learn");
    assert_eq!(shown.show(false).await, (true, false));
    shown.rig.stop().await.expect("a clean stop");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_service_that_does_not_write_the_place_sets_no_mode_until_it_does() {
    let folder = TempDir::new().expect("a folder");
    let store = || Store::in_folder(folder.path().to_owned()).expect("a store");
    let mut first = Shown::to(Rig::remembering(&[], Some(store())).await).await;
    assert_eq!(first.show(false).await, (true, false));
    let stored = |status: &serde_json::Value| status["store"]["written"] == 1;
    first.rig.status_when("lab", stored).await;

    let second = Rig::remembering(&[], Some(store())).await;
    let (one, all) = (
        first.head.key(ROOT, keys::MODE),
        keys::memory(ROOT, "lab", "mode"),
    );
    for key in [&one, &all] {
        let refused = second.try_ask(&format!("{key}?set=freeze"), None).await;
        let refused = refused.expect_err("the first one writes the place");
        assert!(refused.starts_with("place_held: "), "{refused}");
    }
    let rejections = second.subscribe(&first.head, keys::REJECTED).await;
    second.session.put(&one, "freeze").await.expect("put");
    let rejection = next_rejection(&rejections).await;
    assert_eq!(
        (rejection.code.as_str(), &rejection.key),
        ("place_held", &one)
    );
    for path in ["mode", "robots/anna/head/mode"] {
        let path = format!("PUT /api/v1/places/lab/{path}");
        let refused = send_json(&second, &path, json!({"mode": "freeze"})).await;
        assert_eq!(
            (refused.status, &refused.json()["code"]),
            (400, &json!("place_held"))
        );
    }
    // Nothing of it holds here, nor at the one that learns.
    for key in [&one, &all] {
        let mode = second.ask(&format!("{key}?format=json")).await;
        assert_eq!(mode, br#"{"mode":"learn"}"#);
    }
    assert_eq!(first.show(false).await, (true, false));

    first.rig.stop().await.expect("a clean stop");
    let writes = |status: &serde_json::Value| status["store"]["role"] == "writer";
    second.status_when("lab", writes).await;
    second.ask(&format!("{all}?set=freeze")).await;
    assert_eq!(second.status("lab").await["mode"], "freeze");
    second.stop().await.expect("a clean stop");
}
