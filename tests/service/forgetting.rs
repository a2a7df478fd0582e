//! A place forgets what it is told to, over Zenoh and HTTP, and only that.

use serde_json::json;
use surprised::wire::{decode, encode, keys, proto};

use crate::{
    rig::{ROOT, Rig, camera, next_report, wall},
    web::{send, send_json},
};

const FROM_HERE: &str =
    "x=0;y=0;z=0;qx=0;qy=0;qz=0;qw=1;fx=60;fy=60;cx=31.5;cy=23.5;width=64;height=48";

async fn covered(rig: &Rig) -> f32 {
    let prior = keys::memory(ROOT, "lab", "prior");
    let reply = rig.ask(&format!("{prior}?{FROM_HERE}")).await;
    decode::message::<proto::PriorReply>(&reply)
        .expect("a reply")
        .covered
}

/// Five viewpoints of a wall two metres ahead.
async fn learnt() -> Rig {
    let rig = Rig::start(&[]).await;
    let head = camera("lab", "anna");
    let reports = rig.subscribe(&head, keys::REPORT).await;
    rig.put_calibration(&head).await;
    for sequence in 1..=5 {
        let frame = wall(&head, sequence, 0.05 * sequence as f64);
        rig.put(&head, keys::FRAME, &encode::frame(&frame)).await;
        next_report(&reports).await;
    }
    rig
}

async fn forget(rig: &Rig, parameters: &str) -> Result<proto::ForgetReply, String> {
    let key = keys::memory(ROOT, "lab", "forget");
    let reply = rig.try_ask(&format!("{key}?{parameters}"), None).await?;
    Ok(decode::message(&reply).expect("a ForgetReply"))
}

#[tokio::test(flavor = "multi_thread")]
async fn regions_spans_and_places_are_forgotten() {
    let rig = learnt().await;
    let before = covered(&rig).await;
    let views = rig.status("lab").await["viewpoints"]
        .as_u64()
        .expect("a count");
    let gone = forget(&rig, "sphere=0,0,2,0.3").await.expect("an answer");
    assert_eq!((gone.viewpoints_removed, gone.viewpoints_left), (0, views));
    assert!(
        gone.viewpoints_changed == views && gone.pixels > 100,
        "{gone:?}"
    );
    let after = covered(&rig).await;
    assert!(after < before - 0.05, "{after} of {before} is still known");

    // By payload, and over HTTP as JSON: the last two frames' viewpoints.
    let since = wall(&camera("lab", "anna"), 4, 0.0).stamp_ns;
    let request = proto::ForgetRequest {
        span: Some(proto::TimeSpan {
            since: Some(encode::timestamp(since)),
            until: None,
        }),
        ..proto::ForgetRequest::default()
    };
    let path = "POST /api/v1/places/lab/forget";
    let reply = send_json(&rig, path, encode::json(&request)).await;
    assert_eq!(
        (reply.status, &reply.json()["viewpoints_removed"]),
        (200, &json!("2"))
    );
    let reply = send_json(&rig, path, json!({"everything": true})).await;
    assert_eq!(reply.json()["viewpoints_removed"], (views - 2).to_string());
    assert_eq!(covered(&rig).await, 0.0);
    let status = rig.status("lab").await;
    assert_eq!(
        (&status["viewpoints"], &status["memory_bytes"]),
        (&0.into(), &0.into())
    );
    rig.stop().await.expect("a clean stop");
}

#[tokio::test(flavor = "multi_thread")]
async fn nothing_is_forgotten_by_accident() {
    let rig = learnt().await;
    let before = rig.ask(&keys::memory(ROOT, "lab", "views")).await;
    for (parameters, sentence) in [
        ("", "nothing to forget is named"),
        ("everything=yes", "everything is true or false"),
        ("everything=true;sphere=0,0,2,1", "goes with nothing else"),
        ("sphere=0,0,2", "4 numbers"),
        ("sphere=0,0,2,-1", "no radius"),
        ("sphere=0,0,nan,1", "not finite"),
        ("sphere=0,0,2,1;box=0,0,0,1,1,1", "either `sphere` or `box`"),
        ("box=0,0,3,1,1,2", "not below its max"),
        ("since=soon", "no number"),
        ("since=nan", "must be finite"),
        // Without the sphere this would be everything.
        ("sphre=0,0,2,0.1;since=0", "no parameter sphre"),
        ("everything=true;robot=anna", "no parameter robot"),
    ] {
        let refused = forget(&rig, parameters).await.expect_err(parameters);
        assert!(refused.contains(sentence), "{parameters}: {refused}");
    }
    // Nobody forgets several places at once.
    let replies = rig
        .session
        .get(format!("{ROOT}/*/@memory/forget?everything=true"))
        .await
        .expect("a get");
    assert!(replies.recv_async().await.is_err(), "nobody answers");
    let page = send(
        &rig,
        "POST /api/v1/places/attic/forget",
        &[],
        b"{\"everything\":true}",
    )
    .await;
    assert_eq!(page.status, 404);
    let page = send(
        &rig,
        "POST /api/v1/places/lab/forget",
        &[],
        b"{\"everythin\":true}",
    )
    .await;
    assert_eq!(
        (page.status, page.json()["code"].as_str()),
        (400, Some("undecodable"))
    );
    // A browser sends these for the pages of other sites.
    for from_elsewhere in [
        &["Sec-Fetch-Site: cross-site", "Content-Type: text/plain"][..],
        &["Origin: http://evil.example"],
        &["Origin: null"],
    ] {
        let path = "POST /api/v1/places/lab/forget";
        let page = send(&rig, path, from_elsewhere, b"{\"everything\":true}").await;
        assert_eq!(
            (page.status, page.json()["code"].as_str()),
            (403, Some("origin")),
            "{from_elsewhere:?}"
        );
    }
    assert_eq!(rig.ask(&keys::memory(ROOT, "lab", "views")).await, before);
    rig.stop().await.expect("a clean stop");
}
