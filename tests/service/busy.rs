//! Too many questions at once: what is beyond the queue is refused as busy and counted, frames are served meanwhile, and
//! afterwards everything is answered again.

use std::time::Duration;

use tokio::io::AsyncWriteExt;

use surprised::wire::{encode, keys, proto};

use crate::rig::{PATIENCE, ROOT, Rig, camera, next_report, patient, posed};

/// More than a place's queue holds, fewer than the service answers at once.
const QUESTIONS: usize = 40;

#[tokio::test(flavor = "multi_thread")]
async fn questions_beyond_the_queue_are_refused_as_busy_while_frames_go_on() {
    let rig = Rig::start(&[]).await;
    let head = camera("lab", "anna");
    let reports = rig.subscribe(&head, keys::REPORT).await;
    rig.put_calibration(&head).await;
    rig.put(&head, keys::FRAME, &posed(&head, 1)).await;
    next_report(&reports).await;

    // Each takes as many passes as a question may.
    let request = proto::NextViewRequest {
        candidates: (0..64)
            .map(|_| encode::pose(&surprised::model::pose::Pose::identity()))
            .collect(),
        ring: None,
        intrinsics: Some(proto::Intrinsics {
            width: 320,
            height: 240,
            fx: 300.0,
            fy: 300.0,
            cx: 159.5,
            cy: 119.5,
            ..proto::Intrinsics::default()
        }),
    };
    let key = keys::memory(ROOT, "lab", "next_view");
    let mut replies = Vec::new();
    for _ in 0..QUESTIONS {
        let get = rig.session.get(&key).payload(encode::bytes(&request));
        replies.push(get.timeout(PATIENCE).await.expect("a get"));
    }
    let status = rig
        .status_when("lab", |status| status["asks_busy"].as_u64() > Some(0))
        .await;
    assert!(status["ask_passes"].as_u64() < Some(64 * QUESTIONS as u64));
    for sequence in 2..=6 {
        rig.put(&head, keys::FRAME, &posed(&head, sequence)).await;
        assert_eq!(next_report(&reports).await.sequence, sequence);
    }

    let (mut answered, mut busy) = (0, 0);
    for replies in replies {
        let reply = patient(replies.recv_async()).await.expect("one reply each");
        match reply.into_result() {
            Ok(_) => answered += 1,
            Err(error) => {
                let text = String::from_utf8_lossy(&error.payload().to_bytes()).into_owned();
                if text.starts_with("busy: ") {
                    busy += 1;
                } else {
                    // On a machine that is far too slow.
                    assert!(text.starts_with("late: "), "{text}");
                }
            }
        }
    }
    assert!(
        busy >= QUESTIONS - 17 - answered,
        "{busy} busy, {answered} answered"
    );
    let status = rig.status("lab").await;
    assert_eq!(status["asks_busy"], busy);
    assert_eq!(status["frames"], 6);

    // Who goes before the answer, here while others have their turn, is not worked for, and that is counted.
    let mut others = Vec::new();
    for _ in 0..4 {
        let get = rig.session.get(&key).payload(encode::bytes(&request));
        others.push(get.timeout(PATIENCE).await.expect("a get"));
    }
    let request = r#"{"world_from_camera": {"position": {}, "orientation": {"w": 1}}, "planes": ["expected"],
        "intrinsics": {"width": 320, "height": 240, "fx": 300, "fy": 300, "cx": 159.5, "cy": 119.5}}"#;
    patient(async {
        while rig.status("lab").await["asks_abandoned"] == 0 {
            let mut stream = tokio::net::TcpStream::connect(rig.http)
                .await
                .expect("it listens");
            let head = format!(
                "POST /api/v1/places/lab/prior HTTP/1.1\r\nHost: {}\r\nContent-Type: application/json\r\nContent-Length: {}\r\n\r\n{request}",
                rig.http,
                request.len()
            );
            stream.write_all(head.as_bytes()).await.expect("it reads");
        }
    })
    .await;
    for replies in others {
        patient(replies.recv_async())
            .await
            .expect("one reply each")
            .into_result()
            .ok();
    }

    // As soon as there is room again.
    let views = keys::memory(ROOT, "lab", "views");
    patient(async {
        while rig.try_ask(&views, None).await.is_err() {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    })
    .await;
    rig.stop().await.expect("a clean stop");
}
