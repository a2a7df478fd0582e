//! A rig of three cameras with a tracked plate sends neither depth nor pose: both are had from its side images and
//! markers, in the frame or on the `markers` key; what is wrong with them is said.

use nalgebra::Point3;
use surprised::{
    model::{
        camera::{Calibration, Plate, RigCalibration, SideCalibration, SideCalibrations},
        frame::RigFrame,
        pose::{Pose, view_distance_m},
    },
    simulation::{
        script::{Script, Views},
        tracker::Tracker,
    },
    wire::{decode, encode, keys, keys::CameraPath, proto},
};

use crate::rig::{
    CAMERA, ROOT, Rig, SECOND, camera, next_rejection, next_report, posed, poseless, wall,
};

const BASELINE_M: f64 = 0.1;

/// Of a small rig with its plate above the camera.
fn calibration() -> RigCalibration {
    let camera = Calibration {
        intrinsics: CAMERA,
        distortion: None,
    };
    let side = |x_m| SideCalibration {
        camera: camera.clone(),
        middle_from_side: Pose::translation(x_m, 0.0, 0.0),
    };
    RigCalibration {
        sides: Some(SideCalibrations {
            left: side(-BASELINE_M),
            right: side(BASELINE_M),
        }),
        plate: Some(Plate {
            marker_in_plate: [[0.0, 0.0], [0.2, 0.0], [0.2, 0.15], [0.0, 0.15]]
                .map(|[x, y]| Point3::new(x, y, 0.0))
                .to_vec(),
            camera_from_plate: Pose::translation(-0.1, -0.1, 0.02),
        }),
        middle: camera,
    }
}

/// Where a tracker sees the plate of a camera there.
fn tracked(world_from_camera: &Pose) -> Vec<Option<Point3<f64>>> {
    let plate = calibration().plate.expect("it has one");
    let world_from_plate = world_from_camera * plate.camera_from_plate;
    let markers = plate.marker_in_plate.iter();
    markers
        .map(|marker| Some(world_from_plate * marker))
        .collect()
}

/// Of a textured wall, with everything a rig sends in it.
pub fn rig_frame(head: &CameraPath, sequence: u64) -> proto::Frame {
    let middle = wall(head, sequence, 0.0);
    let frame = RigFrame {
        stamp_ns: middle.stamp_ns,
        sequence,
        left: wall(head, sequence, -BASELINE_M).image.grey(),
        right: wall(head, sequence, BASELINE_M).image.grey(),
        marker_in_world: tracked(&middle.world_from_camera),
        image: middle.image,
    };
    proto::Frame {
        calibration: Some(encode::rig_calibration(&calibration())),
        ..encode::rig_frame(&frame)
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn the_papers_rig_is_served_with_its_images_and_markers_alone() {
    let rig = Rig::start(&["refine_pose=false"]).await;
    let head = camera("lab", "anna");
    let reports = rig.subscribe(&head, keys::REPORT).await;
    let rejections = rig.subscribe(&head, keys::REJECTED).await;
    let mut script = Script::tabletop(1);
    script.tracker = Tracker {
        hidden: 0.0,
        lost: 0.0,
        wrong: 0.0,
        ..Tracker::default()
    };
    let calibration = encode::rig_calibration(&script.stations[0].rig.calibration());
    let mut coverage = 0.0;
    // All markers, one hidden, two hidden, all.
    for (index, hidden) in [0, 1, 2, 0].into_iter().enumerate() {
        let capture = script.capture(0, 40 + index as u64, Views::Triple);
        let mut frame = capture.rig_frame().expect("all cameras were rendered");
        frame.marker_in_world[..hidden].fill(None);
        let message = proto::Frame {
            calibration: Some(calibration.clone()),
            ..encode::rig_frame(&frame)
        };
        let views = keys::memory(ROOT, "lab", "views");
        let before = if hidden == 2 {
            rig.ask(&views).await
        } else {
            Vec::new()
        };
        rig.put(&head, keys::FRAME, &message).await;
        if hidden == 2 {
            let rejection = next_rejection(&rejections).await;
            assert_eq!(rejection.code, "too_few_markers", "{}", rejection.detail);
            assert_eq!(rejection.sequence, frame.sequence);
            assert_eq!(rig.ask(&views).await, before, "the memory is as it was");
            continue;
        }
        let report = next_report(&reports).await;
        assert_eq!(report.sequence, frame.sequence);
        assert!(report.learned);
        let pose = decode::pose(&report.world_from_camera.expect("a pose")).expect("a good one");
        let off_m = view_distance_m(&pose, &capture.world_from_camera, 1.0);
        assert!(off_m < 0.01, "{off_m} m or rad off with {hidden} hidden");
        coverage = report.coverage;
    }
    assert!(coverage > 0.8, "what was computed is recalled: {coverage}");
    assert!(rejections.is_empty() && reports.is_empty());
    rig.stop().await.expect("a clean stop");
}

#[tokio::test(flavor = "multi_thread")]
async fn markers_of_their_own_key_place_frames_between_them() {
    let rig = Rig::start(&["pose_wait_s=10", "refine_pose=false"]).await;
    let head = camera("lab", "anna");
    let reports = rig.subscribe(&head, keys::REPORT).await;
    let rejections = rig.subscribe(&head, keys::REJECTED).await;
    let stamp_ns = wall(&head, 1, 0.0).stamp_ns;
    let sample = |after_ns, x_m, hidden: usize| {
        let mut markers = tracked(&Pose::translation(x_m, 0.0, 0.0));
        markers[..hidden].fill(None);
        encode::markers(stamp_ns + after_ns, &markers)
    };
    // The plate is not known yet: it comes with the frame.
    rig.put(&head, keys::MARKERS, &sample(-SECOND / 10, 1.0, 1))
        .await;
    rig.put(&head, keys::MARKERS, &sample(SECOND / 10, 9.0, 2))
        .await;
    let frame = proto::Frame {
        calibration: Some(encode::rig_calibration(&calibration())),
        ..poseless(&head, 1)
    };
    rig.put(&head, keys::FRAME, &frame).await;
    let rejection = next_rejection(&rejections).await;
    assert_eq!(rejection.code, "too_few_markers", "{}", rejection.detail);
    assert!(rejection.key.ends_with("/markers"), "{}", rejection.key);
    assert!(
        reports.is_empty(),
        "the markers after the frame have not come"
    );
    rig.put(&head, keys::MARKERS, &sample(SECOND * 3 / 10, 3.0, 0))
        .await;
    let report = next_report(&reports).await;
    let position = report.world_from_camera.and_then(|pose| pose.position);
    let position = position.expect("a position");
    assert!((position.x - 1.5).abs() < 1e-9, "{position:?}");
    rig.stop().await.expect("a clean stop");
}

#[tokio::test(flavor = "multi_thread")]
async fn the_calibration_of_a_refused_frame_does_not_stay() {
    let rig = Rig::start(&["pose_wait_s=0"]).await;
    let head = camera("lab", "anna");
    let reports = rig.subscribe(&head, keys::REPORT).await;
    let rejections = rig.subscribe(&head, keys::REJECTED).await;
    rig.put_calibration(&head).await;
    let mut smaller = crate::rig::calibration();
    let middle = smaller.middle.as_mut().expect("set");
    (middle.width, middle.cx) = (62, 30.5);
    for (sequence, code) in [(1, "image_size"), (2, "no_pose")] {
        let mut frame = posed(&head, sequence);
        frame.calibration = Some(smaller.clone());
        if code == "no_pose" {
            frame.world_from_camera = None;
        }
        rig.put(&head, keys::FRAME, &frame).await;
        assert_eq!(next_rejection(&rejections).await.code, code);
    }
    rig.put(&head, keys::FRAME, &posed(&head, 3)).await;
    assert_eq!(next_report(&reports).await.sequence, 3);
    assert!(rejections.is_empty());
    rig.stop().await.expect("a clean stop");
}

type Spoil = fn(&mut proto::Frame);

/// What is done to a good frame of a rig, and the code it is refused with.
const SPOILED: [(&str, Spoil); 22] = [
    ("no_depth", |frame| frame.left = None),
    ("no_depth", |frame| frame.right = None),
    ("side_calibration", |frame| sides(frame, None)),
    ("side_calibration", |frame| rig_of(frame).left = None),
    ("side_calibration", |frame| {
        rig_of(frame).middle_from_right = Some(encode::pose(&Pose::identity()));
    }),
    ("side_calibration", |frame| {
        rig_of(frame).middle_from_left = Some(encode::pose(&Pose::translation(60.0, 0.0, 0.0)));
    }),
    ("side_calibration", |frame| {
        rig_of(frame).middle_from_left =
            Some(encode::pose(&Pose::rotation(nalgebra::Vector3::y() * 1.5)));
    }),
    ("bad_pose", |frame| {
        let pose = rig_of(frame).middle_from_left.as_mut().expect("set");
        pose.position.as_mut().expect("set").x = f64::NAN;
    }),
    ("focal_length", |frame| {
        rig_of(frame).right.as_mut().expect("set").fy = -1.0;
    }),
    ("image_too_large", |frame| {
        let right = rig_of(frame).right.as_mut().expect("set");
        (right.width, right.height) = (8000, 8000);
        (right.fx, right.fy) = (8000.0, 8000.0);
    }),
    ("side_size", |frame| {
        rig_of(frame).right.as_mut().expect("set").height = 50;
    }),
    ("byte_count", |frame| {
        frame.left.as_mut().expect("set").data.truncate(9);
    }),
    ("no_plate", |frame| {
        let rig = rig_of(frame);
        rig.marker_in_plate.clear();
        rig.camera_from_plate = None;
    }),
    ("plate", |frame| rig_of(frame).camera_from_plate = None),
    ("plate", |frame| rig_of(frame).marker_in_plate.truncate(2)),
    ("plate", |frame| {
        rig_of(frame).marker_in_plate[1].z = f64::NAN
    }),
    ("marker_count", |frame| markers(frame).truncate(3)),
    ("markers", |frame| markers(frame)[2].position = None),
    ("markers", |frame| {
        markers(frame)[2].position.as_mut().expect("set").y = f64::INFINITY;
    }),
    ("markers", |frame| {
        let marker = markers(frame)[0];
        markers(frame).resize(65, marker);
    }),
    ("markers_inconsistent", |frame| {
        for (index, marker) in markers(frame).iter_mut().enumerate() {
            marker.position.as_mut().expect("set").x += 0.05 * (index * index) as f64;
        }
    }),
    ("no_pose", |frame| frame.markers = None),
];

fn rig_of(frame: &mut proto::Frame) -> &mut proto::Calibration {
    frame.calibration.as_mut().expect("set")
}

fn sides(frame: &mut proto::Frame, camera: Option<proto::Intrinsics>) {
    let rig = rig_of(frame);
    (rig.left, rig.right) = (camera.clone(), camera);
    (rig.middle_from_left, rig.middle_from_right) = (None, None);
}

fn markers(frame: &mut proto::Frame) -> &mut Vec<proto::Marker> {
    &mut frame.markers.as_mut().expect("set").markers
}

#[tokio::test(flavor = "multi_thread")]
async fn what_is_wrong_with_a_rig_is_said_and_the_memory_stays_as_it_was() {
    let rig = Rig::start(&["pose_wait_s=0", "depth_far_m=100"]).await;
    let head = camera("lab", "anna");
    let reports = rig.subscribe(&head, keys::REPORT).await;
    let rejections = rig.subscribe(&head, keys::REJECTED).await;
    rig.put(&head, keys::FRAME, &rig_frame(&head, 1)).await;
    assert_eq!(next_report(&reports).await.sequence, 1);
    let views = rig.ask(&keys::memory(ROOT, "lab", "views")).await;
    for (index, (code, spoil)) in SPOILED.into_iter().enumerate() {
        let mut frame = rig_frame(&head, 2 + index as u64);
        spoil(&mut frame);
        rig.put(&head, keys::FRAME, &frame).await;
        let rejection = next_rejection(&rejections).await;
        assert_eq!(rejection.code, code, "{index}: {}", rejection.detail);
        assert_eq!(rejection.sequence, frame.sequence);
        assert!(rejection.detail.len() > 20);
    }
    assert_eq!(rig.ask(&keys::memory(ROOT, "lab", "views")).await, views);
    // And it goes on with what was known before, without a calibration in the frame.
    let mut frame = rig_frame(&head, 60);
    frame.calibration = None;
    rig.put(&head, keys::FRAME, &frame).await;
    assert_eq!(next_report(&reports).await.sequence, 60);
    assert!(reports.is_empty());
    rig.stop().await.expect("a clean stop");
}
