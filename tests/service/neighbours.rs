//! What one robot does never touches another's frames.

use surprised::wire::{encode, keys, proto::SurpriseReport};

use crate::rig::{Rig, camera, changed, next_report, posed, wall};

const FRAMES: u64 = 12;

/// Of a walk along the wall with a change at its end; `beside` is called before each frame.
async fn walk(rig: &Rig, mut beside: impl AsyncFnMut(u64)) -> Vec<SurpriseReport> {
    let head = camera("lab", "anna");
    let reports = rig.subscribe(&head, keys::REPORT).await;
    rig.put_calibration(&head).await;
    let mut told = Vec::new();
    for sequence in 1..=FRAMES {
        beside(sequence).await;
        let frame = wall(&head, sequence, 0.01 * sequence as f64);
        let frame = if sequence > FRAMES - 3 {
            changed(frame)
        } else {
            frame
        };
        rig.put(&head, keys::FRAME, &encode::frame(&frame)).await;
        let report = next_report(&reports).await;
        assert_eq!(report.sequence, sequence);
        told.push(SurpriseReport {
            processing_seconds: 0.0,
            ..report
        });
    }
    told
}

#[tokio::test(flavor = "multi_thread")]
async fn robots_at_other_places_change_not_a_bit() {
    let rig = Rig::start(&[]).await;
    let alone = walk(&rig, async |_| {}).await;
    rig.stop().await.expect("a clean stop");

    let rig = Rig::start(&[]).await;
    let other = camera("hall", "bert");
    let token = rig
        .session
        .liveliness()
        .declare_token(other.live(crate::rig::ROOT))
        .await
        .expect("a token");
    let mut token = Some(token);
    let together = walk(&rig, async |sequence| {
        if sequence == 1 {
            rig.put_calibration(&other).await;
        }
        if sequence < FRAMES / 2 {
            rig.put(&other, keys::FRAME, &posed(&other, sequence)).await;
            let mut nonsense = posed(&other, sequence);
            nonsense.depth = None;
            rig.put(&other, keys::FRAME, &nonsense).await;
        } else if let Some(token) = token.take() {
            token.undeclare().await.expect("undeclared");
        }
    })
    .await;
    rig.stop().await.expect("a clean stop");
    assert!(alone.iter().any(|report| !report.regions.is_empty()));
    assert_eq!(alone, together);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_robot_that_joins_and_leaves_the_place_costs_no_frame_and_no_id() {
    let rig = Rig::start(&[]).await;
    let other = camera("lab", "bert");
    let told = walk(&rig, async |sequence| {
        match sequence {
            3 => rig.put_calibration(&other).await,
            4..=7 => {
                // It sees another wall from another place.
                let mut frame = wall(&other, sequence, 0.0);
                frame.world_from_camera.translation.x = 100.0;
                rig.put(&other, keys::FRAME, &encode::frame(&frame)).await;
            }
            _ => {}
        }
    })
    .await;
    assert_eq!(told.len() as u64, FRAMES);
    let seen: Vec<u64> = told
        .iter()
        .flat_map(|report| report.regions.iter().map(|region| region.id))
        .collect();
    assert!(seen.len() >= 2, "the change is there in the last frames");
    assert!(
        seen.iter().all(|id| *id == seen[0]),
        "it keeps its id: {seen:?}"
    );
    rig.stop().await.expect("a clean stop");
}
