//! Prior, evaluate and views over HTTP are what they are over Zenoh; too much is refused.

use serde_json::json;
use surprised::wire::{decode, encode, keys, proto};

use crate::{
    rig::{CAMERA, ROOT, Rig, calibration, camera, changed, next_report, wall},
    web::{send, send_json},
};

async fn learnt() -> Rig {
    let rig = Rig::start(&[]).await;
    let head = camera("lab", "anna");
    let reports = rig.subscribe(&head, keys::REPORT).await;
    rig.put_calibration(&head).await;
    for sequence in 1..=6 {
        let frame = wall(&head, sequence, 0.05 * sequence as f64);
        rig.put(&head, keys::FRAME, &encode::frame(&frame)).await;
        next_report(&reports).await;
    }
    rig
}

fn request(planes: &[&str]) -> proto::PriorRequest {
    let frame = wall(&camera("lab", "anna"), 1, 0.1);
    proto::PriorRequest {
        world_from_camera: Some(encode::pose(&frame.world_from_camera)),
        intrinsics: Some(encode::intrinsics(&CAMERA)),
        planes: planes.iter().map(|&plane| plane.to_owned()).collect(),
    }
}

const PRIOR: &str = "POST /api/v1/places/lab/prior";

#[tokio::test(flavor = "multi_thread")]
async fn a_posted_prior_is_the_asked_one_as_json_protobuf_or_picture() {
    let rig = learnt().await;
    let all = request(&["expected", "uncertainty", "coverage", "depth", "parameters"]);
    let key = keys::memory(ROOT, "lab", "prior");
    let asked = rig
        .try_ask(&key, Some(encode::bytes(&all)))
        .await
        .expect("an answer");
    let reply: proto::PriorReply = decode::message(&asked).expect("a PriorReply");

    let page = send_json(&rig, PRIOR, encode::json(&all)).await;
    assert!(
        page.head.contains("content-type: application/json"),
        "{}",
        page.head
    );
    assert_eq!(page.json(), encode::json(&reply));
    let head = [
        "Content-Type: application/protobuf",
        "Accept: application/protobuf",
    ];
    assert_eq!(
        send(&rig, PRIOR, &head, &encode::bytes(&all)).await.body,
        asked
    );

    let expected = reply.expected.expect("asked for").data;
    let png = ["Accept: text/html, image/png;q=0.9"];
    for planes in [&[][..], &["expected"]] {
        let body = encode::json(&request(planes)).to_string();
        let page = send(&rig, PRIOR, &png, body.as_bytes()).await;
        assert!(
            page.head.contains("content-type: image/png"),
            "{}",
            page.head
        );
        assert_eq!(page.body, expected);
    }
    for plane in ["uncertainty", "coverage", "depth"] {
        let body = encode::json(&request(&[plane])).to_string();
        let page = send(&rig, PRIOR, &png, body.as_bytes()).await;
        let picture = image::load_from_memory(&page.body).expect("a png");
        assert_eq!((picture.width(), picture.height()), (64, 48));
    }
    rig.stop().await.expect("a clean stop");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_posted_frame_is_evaluated_and_not_learnt() {
    let rig = learnt().await;
    let head = camera("lab", "anna");
    let frame = encode::frame(&changed(wall(&head, 7, 0.1)));
    let alone = proto::EvaluateRequest {
        frame: Some(proto::Frame {
            calibration: Some(calibration()),
            ..frame.clone()
        }),
    };
    let borrowing = proto::EvaluateRequest { frame: Some(frame) };
    let path = "POST /api/v1/places/lab/evaluate";
    let before = rig.ask(&keys::memory(ROOT, "lab", "views")).await;
    let page = send_json(&rig, path, encode::json(&alone)).await;
    assert_eq!(page.status, 200, "{}", String::from_utf8_lossy(&page.body));
    let report = &page.json()["report"];
    assert!(
        report["regions"][0]["peak_surprise"].as_f64() > Some(6.0),
        "{report}"
    );
    assert_eq!(report["place"], "lab");
    assert_eq!(report["learned"], false, "nothing was learnt");

    let page = send_json(&rig, path, encode::json(&borrowing)).await;
    assert_eq!(page.json()["code"], "no_calibration");
    let path = format!("{path}?robot=anna&camera=head");
    let page = send_json(&rig, &path, encode::json(&borrowing)).await;
    assert_eq!(page.json()["report"]["robot"], "anna");
    assert_eq!(rig.ask(&keys::memory(ROOT, "lab", "views")).await, before);
    rig.stop().await.expect("a clean stop");
}

#[tokio::test(flavor = "multi_thread")]
async fn viewpoints_are_listed_page_by_page() {
    let rig = learnt().await;
    let views = "GET /api/v1/places/lab/views";
    let all = send(&rig, views, &[], b"").await.json();
    let total: usize = all["total"]
        .as_str()
        .expect("a count")
        .parse()
        .expect("a number");
    assert!(total >= 4 && all["views"].as_array().map(Vec::len) == Some(total));
    let first = send(&rig, &format!("{views}?limit=2"), &[], b"")
        .await
        .json();
    assert_eq!(
        first["views"].as_array(),
        all["views"].as_array().map(|v| v[..2].to_vec()).as_ref()
    );
    assert_eq!(first["total"], all["total"]);
    let key = keys::memory(ROOT, "lab", "views");
    let rest = rig.ask(&format!("{key}?after=2;format=json")).await;
    let rest: serde_json::Value = serde_json::from_slice(&rest).expect("JSON");
    assert_eq!(
        rest["views"].as_array(),
        all["views"].as_array().map(|v| v[2..].to_vec()).as_ref()
    );
    assert_eq!(
        send(&rig, &format!("{views}?limit=few"), &[], b"")
            .await
            .status,
        400
    );
    rig.stop().await.expect("a clean stop");
}

#[tokio::test(flavor = "multi_thread")]
async fn what_is_too_large_or_senseless_is_refused_with_a_sentence() {
    let rig = learnt().await;
    let sized = |width: u32, planes: &[&str]| {
        let mut request = request(planes);
        let lens = request.intrinsics.get_or_insert_default();
        (lens.width, lens.height) = (width, 2000);
        (lens.fx, lens.fy) = (900.0, 900.0);
        encode::json(&request)
    };
    for (body, status, code) in [
        (json!({"planes": ["expected"]}), 400, "bad_request"),
        (encode::json(&request(&["taste"])), 400, "bad_request"),
        (sized(5000, &["expected"]), 400, "image_too_large"),
        // Small enough for one plane, not for all ten of the beliefs.
        (sized(1000, &["parameters"]), 400, "image_too_large"),
        (json!([]), 400, "undecodable"),
        (json!({"x": "y".repeat(1 << 20)}), 413, "message_too_large"),
    ] {
        let page = send_json(&rig, PRIOR, body).await;
        assert_eq!(
            (page.status, page.json()["code"].as_str()),
            (status, Some(code))
        );
        assert!(
            page.head.contains("application/problem+json"),
            "{}",
            page.head
        );
    }
    let head = ["Accept: image/png"];
    let body = encode::json(&request(&["parameters"])).to_string();
    assert_eq!(send(&rig, PRIOR, &head, body.as_bytes()).await.status, 400);
    let page = send(&rig, "GET /api/v1/places/lab/prior", &[], b"").await;
    assert_eq!(page.status, 405);
    rig.stop().await.expect("a clean stop");
}
