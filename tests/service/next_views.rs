//! A planner asks where to look next: candidates or a ring, best first, over Zenoh and HTTP.

use serde_json::json;
use surprised::{
    model::pose::Pose,
    wire::{decode, encode, keys, proto},
};

use crate::{
    rig::{CAMERA, ROOT, Rig, camera, next_report, posed},
    web::send_json,
};

#[tokio::test(flavor = "multi_thread")]
async fn the_unknown_ranks_before_the_known() {
    let rig = Rig::start(&[]).await;
    let head = camera("lab", "anna");
    let reports = rig.subscribe(&head, keys::REPORT).await;
    rig.put_calibration(&head).await;
    for sequence in 1..=4 {
        rig.put(&head, keys::FRAME, &posed(&head, sequence)).await;
        next_report(&reports).await;
    }
    let key = keys::memory(ROOT, "lab", "next_view");

    // The wall is known from the origin; a metre to the right half of what is seen is not.
    let candidates: Vec<Pose> = [0.0, 9.0, 1.0]
        .map(|x| Pose::translation(x, 0.0, 0.0))
        .into();
    let request = proto::NextViewRequest {
        candidates: candidates.iter().map(encode::pose).collect(),
        ring: None,
        intrinsics: Some(encode::intrinsics(&CAMERA)),
    };
    let answer = rig.try_ask(&key, Some(encode::bytes(&request))).await;
    let reply: proto::NextViewReply =
        decode::message(&answer.expect("an answer")).expect("a NextViewReply");
    let order: Vec<u32> = reply.views.iter().map(|view| view.index).collect();
    assert_eq!(order, [1, 2, 0]);
    let [unseen, half, known] = &reply.views[..] else {
        panic!("three candidates are ranked");
    };
    assert_eq!(
        (unseen.covered, unseen.reduction),
        (0.0, unseen.reduction_unseen)
    );
    assert!(half.covered > 0.1 && half.covered < 0.7, "{half:?}");
    assert!(known.covered > 0.9 && known.uncertainty > 0.0, "{known:?}");
    assert_eq!(half.world_from_camera, Some(encode::pose(&candidates[2])));
    let path = "POST /api/v1/places/lab/next_view";
    let page = send_json(&rig, path, encode::json(&request)).await;
    assert_eq!(page.json(), encode::json(&reply));

    // On the spot: it knows what is ahead of it, and nothing behind.
    let selector = format!("{key}?robot=anna;camera=head;count=4");
    let ring: proto::NextViewReply = decode::message(&rig.ask(&selector).await).expect("a reply");
    assert_eq!(ring.views.len(), 4);
    assert_eq!(ring.views[3].index, 0, "straight ahead promises least");
    let passes = rig.status("lab").await["ask_passes"].clone();
    assert_eq!(passes, 3 + 3 + 4, "one pass a candidate");
    rig.stop().await.expect("a clean stop");
}

#[tokio::test(flavor = "multi_thread")]
async fn senseless_questions_are_refused_with_a_sentence() {
    let rig = Rig::start(&["image_pixels_max=100000"]).await;
    let head = camera("lab", "anna");
    let reports = rig.subscribe(&head, keys::REPORT).await;
    rig.put_calibration(&head).await;
    rig.put(&head, keys::FRAME, &posed(&head, 1)).await;
    next_report(&reports).await;
    let pose = json!({"position": {}, "orientation": {"w": 1}});
    let lens = encode::json(&encode::intrinsics(&CAMERA));
    for (body, code) in [
        (json!({}), "bad_request"),
        (json!({"candidates": [pose]}), "bad_request"),
        (json!({"candidates": [{}], "intrinsics": lens}), "bad_pose"),
        (
            json!({"candidates": [pose], "ring": {}, "intrinsics": lens}),
            "bad_request",
        ),
        (
            json!({"candidates": vec![&pose; 65], "intrinsics": lens}),
            "too_many_candidates",
        ),
        (
            json!({"candidates": vec![&pose; 60], "intrinsics": lens}),
            "image_too_large",
        ),
        (
            json!({"ring": {"radius": -1}, "intrinsics": lens}),
            "bad_request",
        ),
        (json!({"ring": {"radius": 1}}), "bad_request"),
        (json!({"ring": {"robot": "anna"}}), "bad_request"),
    ] {
        let page = send_json(&rig, "POST /api/v1/places/lab/next_view", body.clone()).await;
        assert_eq!(
            (page.status, page.json()["code"].as_str()),
            (400, Some(code)),
            "{body}"
        );
    }
    let nobody = json!({"ring": {"robot": "anna", "camera": "foot"}});
    let page = send_json(&rig, "POST /api/v1/places/lab/next_view", nobody).await;
    assert_eq!(
        (page.status, page.json()["code"].as_str()),
        (404, Some("unknown_camera"))
    );
    rig.stop().await.expect("a clean stop");
}
