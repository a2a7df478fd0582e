//! A frame that cannot be used is refused with a code and a sentence, is counted, and changes nothing.

use image::{ExtendedColorType, codecs::jpeg::JpegEncoder};
use surprised::{
    model::pose::Pose,
    wire::{encode, keys, proto},
};

use crate::rig::{Rig, camera, next_rejection, next_report, posed};

type Spoil = fn(&mut proto::Frame);

/// What is done to a good frame, and the code it is refused with.
const SPOILED: [(&str, Spoil); 23] = [
    ("no_stamp", |frame| frame.stamp = None),
    ("bad_stamp", |frame| {
        frame.stamp.as_mut().expect("set").nanos = -1;
    }),
    ("no_image", |frame| frame.image = None),
    ("no_depth", |frame| frame.depth = None),
    ("no_pose", |frame| frame.world_from_camera = None),
    ("bad_pose", |frame| {
        pose(frame).position.as_mut().expect("set").x = f64::NAN
    }),
    ("bad_pose", |frame| {
        pose(frame).orientation.as_mut().expect("set").w = 1.1
    }),
    ("bad_pose", |frame| pose(frame).orientation = None),
    ("bad_pose", |frame| {
        pose(frame).position.as_mut().expect("set").y = 1e30
    }),
    ("pose_noise", |frame| frame.pose_position_sd = -1.0),
    ("image_encoding", |frame| {
        image(frame).encoding = "yuyv".to_owned()
    }),
    ("byte_count", |frame| image(frame).data.truncate(7)),
    ("step", |frame| image(frame).step = 3),
    ("side", |frame| image(frame).width = 3),
    ("side", |frame| image(frame).height = u32::MAX),
    ("image_too_large", |frame| {
        image(frame).width = 8000;
        image(frame).height = 8000;
    }),
    ("image_data", |frame| {
        image(frame).encoding = "jpeg".to_owned()
    }),
    ("image_data", |frame| {
        let image = image(frame);
        let (width, height) = (image.width, image.height);
        image.data = jpeg(&image.data, width, height);
        // Enough of it for a decoder that does not mind.
        image.data.truncate(image.data.len() * 9 / 10);
        image.encoding = "jpeg".to_owned();
    }),
    ("depth_encoding", |frame| {
        depth(frame).encoding = "rgb8".to_owned()
    }),
    ("depth_size", |frame| {
        depth(frame).width /= 2;
        depth(frame).height /= 2;
        depth(frame).data.truncate(32 * 24 * 4);
    }),
    ("focal_length", |frame| middle(frame).fx = 0.0),
    ("principal_point", |frame| middle(frame).cx = -3.0),
    ("distortion", |frame| {
        middle(frame).distortion_model = "fisheye".to_owned();
    }),
];

fn pose(frame: &mut proto::Frame) -> &mut proto::Pose {
    frame.world_from_camera.as_mut().expect("set")
}

fn image(frame: &mut proto::Frame) -> &mut proto::Image {
    frame.image.as_mut().expect("set")
}

fn jpeg(rgb: &[u8], width: u32, height: u32) -> Vec<u8> {
    let mut file = Vec::new();
    JpegEncoder::new(&mut file)
        .encode(rgb, width, height, ExtendedColorType::Rgb8)
        .expect("it has its size");
    file
}

fn depth(frame: &mut proto::Frame) -> &mut proto::Image {
    frame.depth.as_mut().expect("set")
}

fn middle(frame: &mut proto::Frame) -> &mut proto::Intrinsics {
    frame
        .calibration
        .get_or_insert_with(crate::rig::calibration)
        .middle
        .as_mut()
        .expect("set")
}

#[tokio::test(flavor = "multi_thread")]
async fn what_is_wrong_is_said_and_the_memory_stays_as_it_was() {
    let rig = Rig::start(&["pose_wait_s=0"]).await;
    let head = camera("lab", "anna");
    let reports = rig.subscribe(&head, keys::REPORT).await;
    let rejections = rig.subscribe(&head, keys::REJECTED).await;
    rig.put_calibration(&head).await;
    rig.put(&head, keys::FRAME, &posed(&head, 1)).await;
    next_report(&reports).await;
    let views = rig.ask("test/surprised/lab/@memory/views").await;

    for (index, (code, spoil)) in SPOILED.into_iter().enumerate() {
        let mut frame = posed(&head, 2 + index as u64);
        spoil(&mut frame);
        rig.put(&head, keys::FRAME, &frame).await;
        let rejection = next_rejection(&rejections).await;
        assert_eq!(rejection.code, code, "{}", rejection.detail);
        assert_eq!(rejection.sequence, frame.sequence);
        assert_eq!(rejection.key, "test/surprised/lab/anna/head/frame");
        assert!(rejection.detail.len() > 20);
    }
    rig.session
        .put(
            head.key("test/surprised", keys::FRAME),
            encode::bytes(&posed(&head, 50)),
        )
        .encoding("image/png")
        .await
        .expect("put");
    assert_eq!(next_rejection(&rejections).await.code, "wrong_encoding");
    rig.session
        .put(head.key("test/surprised", keys::POSE), vec![0xff; 9])
        .encoding(keys::encoding::<proto::PoseSample>())
        .await
        .expect("put");
    let rejection = next_rejection(&rejections).await;
    assert_eq!(rejection.code, "undecodable");
    assert!(rejection.key.ends_with("/pose"));

    assert_eq!(rig.ask("test/surprised/lab/@memory/views").await, views);
    let status = rig.status("lab").await;
    assert_eq!(status["refused"], SPOILED.len() + 2, "{status}");
    assert_eq!(status["cameras"][0]["refused"]["bad_pose"], 4);
    // And the robot goes on as if nothing had been.
    rig.put(&head, keys::FRAME, &posed(&head, 60)).await;
    assert_eq!(next_report(&reports).await.sequence, 60);
    assert!(reports.is_empty());
    rig.stop().await.expect("a clean stop");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_frame_without_any_calibration_is_refused() {
    let rig = Rig::start(&[]).await;
    let head = camera("lab", "anna");
    let rejections = rig.subscribe(&head, keys::REJECTED).await;
    let mut frame = posed(&head, 1);
    frame.world_from_camera = Some(encode::pose(&Pose::identity()));
    rig.put(&head, keys::FRAME, &frame).await;
    assert_eq!(next_rejection(&rejections).await.code, "no_calibration");
    rig.stop().await.expect("a clean stop");
}
