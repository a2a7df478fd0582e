//! Maps are published only while someone subscribes, and belong to the frame with their stamp and sequence.

use surprised::wire::{keys, proto::StampedImage};

use crate::rig::{Rig, camera, next, next_report, posed};

#[tokio::test(flavor = "multi_thread")]
async fn maps_come_only_while_someone_subscribes() {
    let rig = Rig::start(&[]).await;
    let head = camera("lab", "anna");
    let reports = rig.subscribe(&head, keys::REPORT).await;
    rig.put_calibration(&head).await;
    rig.put(&head, keys::FRAME, &posed(&head, 1)).await;
    next_report(&reports).await;

    let kinds = [
        ("surprise/map", "32FC1", 64, 48),
        ("surprise/blocks", "32FC1", 16, 12),
        ("surprise/expected", "png", 64, 48),
        ("surprise/uncertainty", "32FC1", 64, 48),
        ("surprise/coverage", "mono8", 64, 48),
    ];
    let mut maps = Vec::new();
    for (leaf, ..) in kinds {
        maps.push(rig.subscribe(&head, leaf).await);
    }
    // A subscription is on its way before the query behind it is answered.
    rig.status("lab").await;
    rig.put(&head, keys::FRAME, &posed(&head, 2)).await;
    next_report(&reports).await;
    for (samples, (leaf, encoding, width, height)) in maps.iter().zip(kinds) {
        let map: StampedImage = next(samples).await;
        let image = map.image.expect("a map has an image");
        assert_eq!(map.sequence, 2, "{leaf}");
        assert_eq!(
            (image.encoding.as_str(), image.width, image.height),
            (encoding, width, height),
            "{leaf}"
        );
        if encoding == "32FC1" {
            assert_eq!(image.data.len(), (4 * width * height) as usize, "{leaf}");
        }
        assert!(samples.is_empty(), "{leaf} only for the subscribed frame");
    }
    rig.stop().await.expect("a clean stop");
}
