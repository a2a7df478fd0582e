//! The memory answers questions over Zenoh between frames, in protobuf and JSON, and refuses with a sentence.

use surprised::wire::{decode, encode, keys, proto};

use crate::rig::{CAMERA, ROOT, Rig, calibration, camera, changed, next_report, posed, wall};

const FROM_HERE: &str =
    "x=0;y=0;z=0;qx=0;qy=0;qz=0;qw=1;fx=60;fy=60;cx=31.5;cy=23.5;width=64;height=48";

#[tokio::test(flavor = "multi_thread")]
async fn prior_evaluate_views_and_status_are_answered() {
    let rig = Rig::start(&[]).await;
    let head = camera("lab", "anna");
    let reports = rig.subscribe(&head, keys::REPORT).await;
    rig.put_calibration(&head).await;
    for sequence in 1..=10 {
        rig.put(&head, keys::FRAME, &posed(&head, sequence)).await;
        next_report(&reports).await;
    }

    let prior = keys::memory(ROOT, "lab", "prior");
    let by_parameters = rig
        .ask(&format!(
            "{prior}?{FROM_HERE};planes=expected,coverage,depth,parameters,uncertainty"
        ))
        .await;
    let request = proto::PriorRequest {
        world_from_camera: Some(encode::pose(&wall(&head, 1, 0.0).world_from_camera)),
        intrinsics: Some(encode::intrinsics(&CAMERA)),
        planes: ["expected", "coverage", "depth", "parameters", "uncertainty"]
            .map(str::to_owned)
            .to_vec(),
    };
    let by_payload = rig
        .try_ask(&prior, Some(encode::bytes(&request)))
        .await
        .expect("an answer");
    assert_eq!(by_parameters, by_payload);
    let reply: proto::PriorReply = decode::message(&by_payload).expect("it decodes");
    assert!(reply.covered > 0.9, "{}", reply.covered);
    assert_eq!(reply.parameters.len(), 4 * 10 * CAMERA.pixels());
    let expected = image::load_from_memory(&reply.expected.expect("asked for").data)
        .expect("a png")
        .into_rgb8();
    let seen = wall(&head, 1, 0.0).image.data;
    let middle = 3 * (24 * CAMERA.width + 32);
    for channel in 0..3 {
        let difference = expected.as_raw()[middle + channel].abs_diff(seen[middle + channel]);
        assert!(difference < 8, "the wall is expected where it is");
    }
    let json: serde_json::Value =
        serde_json::from_slice(&rig.ask(&format!("{prior}?{FROM_HERE};format=json")).await)
            .expect("JSON");
    assert_eq!(json["coverage"]["encoding"], "mono8");
    let refused = rig
        .try_ask(&format!("{prior}?x=1"), None)
        .await
        .expect_err("parameters are missing");
    assert!(refused.starts_with("bad_request: "), "{refused}");

    let views = keys::memory(ROOT, "lab", "views");
    let before = rig.ask(&views).await;
    let listed: proto::ViewsReply = decode::message(&before).expect("it decodes");
    assert_eq!(listed.views[0].robot, "anna");
    let request = proto::EvaluateRequest {
        frame: Some(proto::Frame {
            calibration: Some(calibration()),
            ..encode::frame(&changed(wall(&head, 11, 0.0)))
        }),
    };
    let evaluate = keys::memory(ROOT, "lab", "evaluate");
    let answer = rig
        .try_ask(&evaluate, Some(encode::bytes(&request)))
        .await
        .expect("an answer");
    let reply: proto::EvaluateReply = decode::message(&answer).expect("it decodes");
    let report = reply.report.expect("a report");
    assert!(!report.learned && report.max_surprise > 6.0);
    assert_eq!(reply.map.expect("a map").data.len(), 4 * CAMERA.pixels());
    assert_eq!(rig.ask(&views).await, before, "evaluating changes nothing");

    assert_eq!(rig.status("lab").await["frames"], 10);
    let refused = rig
        .try_ask(&keys::memory(ROOT, "attic", "views"), None)
        .await
        .expect_err("nobody was there");
    assert!(refused.starts_with("unknown_place: "), "{refused}");
    rig.stop().await.expect("a clean stop");
}
