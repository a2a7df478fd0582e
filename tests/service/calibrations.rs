//! An unknown calibration is got from the robot's queryable, once.

use surprised::wire::{encode, keys};

use crate::rig::{ROOT, Rig, calibration, camera, next_report, posed};

#[tokio::test(flavor = "multi_thread")]
async fn an_unknown_calibration_is_got_from_the_robot() {
    let rig = Rig::start(&[]).await;
    let head = camera("lab", "anna");
    let reports = rig.subscribe(&head, keys::REPORT).await;
    let key = head.key(ROOT, keys::CALIBRATION);
    let queries = rig
        .session
        .declare_queryable(key.clone())
        .await
        .expect("a queryable");
    rig.put(&head, keys::FRAME, &posed(&head, 1)).await;
    let query = crate::rig::patient(queries.recv_async())
        .await
        .expect("a query");
    query
        .reply(&key, encode::bytes(&calibration()))
        .encoding(keys::encoding::<surprised::wire::proto::Calibration>())
        .await
        .expect("a reply");
    drop(query);
    assert_eq!(next_report(&reports).await.sequence, 1);
    rig.put(&head, keys::FRAME, &posed(&head, 2)).await;
    assert_eq!(next_report(&reports).await.sequence, 2);
    assert!(queries.is_empty(), "what is known is not asked again");
    drop(queries);
    rig.stop().await.expect("a clean stop");
}
