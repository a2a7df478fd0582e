//! A frozen camera leaves nothing behind, an observing one writes nothing, and both see what a learning one would see.

mod reference;

use std::hash::{DefaultHasher, Hasher};

use nalgebra::{Point3, Vector3};
use reference::{
    pool,
    scene::{Panel, Scene, camera, pose},
};
use surprised::{
    config::{Preset, Settings},
    model::{camera::Intrinsics, frame::Frame, mode::Mode, pose::Pose, report::Report},
    pipeline::Pipeline,
};

const CAMERA: (usize, usize) = (96, 72);
const STEPS: usize = 10;

/// A textured wall; `with_object` something dark hangs on it.
fn place(with_object: bool) -> Scene {
    let mut panels = vec![Panel {
        center: Point3::new(0.0, 0.0, 2.0),
        right: Vector3::x(),
        down: Vector3::y(),
        half_size_m: (9.0, 9.0),
        texture: Box::new(|a, b| {
            let waves = (14.0 * a + 3.0 * b).sin() + (5.0 * a - 11.0 * b).sin();
            [140.0 + 25.0 * waves, 5.0, -5.0]
        }),
    }];
    if with_object {
        panels.push(Panel {
            center: Point3::new(0.05, 0.0, 1.9),
            right: Vector3::x(),
            down: Vector3::y(),
            half_size_m: (0.25, 0.25),
            texture: Box::new(|_, _| [20.0, 0.0, 0.0]),
        });
    }
    Scene { panels }
}

fn intrinsics() -> Intrinsics {
    camera(CAMERA.0, CAMERA.1)
}

fn along(step: usize) -> Pose {
    pose(
        [0.03 * step as f64 - 0.15, 0.0, 0.0],
        [0.0, 0.01 * step as f64, 0.0],
    )
}

fn frame(with_object: bool, step: usize, sequence: u64) -> Frame {
    place(with_object).frame(&intrinsics(), &along(step), sequence)
}

/// A place that was learnt on the whole way.
fn learnt(preset: Preset) -> Pipeline {
    let mut pipeline = Pipeline::new(Settings::preset(preset), pool(1));
    for step in 0..STEPS {
        let frame = frame(false, step, step as u64);
        pipeline.process(&frame).expect("the frame is good");
    }
    pipeline
}

/// Every byte of every viewpoint, in order.
fn hash(pipeline: &Pipeline) -> u64 {
    fn floats(hasher: &mut DefaultHasher, values: &[f32]) {
        hasher.write_usize(values.len());
        for value in values {
            hasher.write_u32(value.to_bits());
        }
    }
    let mut hasher = DefaultHasher::new();
    for view in pipeline.memory().viewpoints() {
        hasher.write(
            format!("{:?}", (view.id, view.stamp_ns, view.updates, &view.source)).as_bytes(),
        );
        for pose in [&view.world_from_camera, &view.world_from_home] {
            for value in pose.to_homogeneous().iter() {
                hasher.write_u64(value.to_bits());
            }
        }
        for record in &view.records {
            for value in record.spread {
                hasher.write_u16(value);
            }
            for value in record.level {
                hasher.write_i16(value);
            }
        }
        for mesh in [&view.mesh, &view.coarse.mesh] {
            hasher.write(format!("{:?}", mesh.intrinsics).as_bytes());
            floats(&mut hasher, &mesh.depth_m);
            hasher.write(&mesh.cut);
            floats(&mut hasher, &mesh.block_nearest_m);
            floats(&mut hasher, &mesh.block_farthest_m);
        }
        floats(&mut hasher, &view.coarse.luminance);
        floats(&mut hasher, &view.coarse.variance);
    }
    hasher.finish()
}

/// The beliefs recalled at a pose between the viewpoints, to the bit.
fn parameters(pipeline: &mut Pipeline) -> Vec<u32> {
    let at = pipeline.prior(&intrinsics(), &pose([0.017, 0.01, 0.0], [0.0, 0.02, 0.0]));
    at.prior.data.iter().map(|value| value.to_bits()).collect()
}

fn process(pipeline: &mut Pipeline, mode: Mode, frame: &Frame) -> Report {
    pipeline.process_in(mode, frame).expect("the frame is good")
}

/// Regions are numbered by the place, whoever sees them.
/// What the memory decides; ids and events tell frames apart that it does not.
fn without_ids(mut report: Report) -> Report {
    for region in &mut report.regions {
        (region.id, region.event_id) = (0, 0);
    }
    report.events.clear();
    report
}

#[test]
fn frozen_and_observed_frames_change_no_bit_of_the_memory() {
    for preset in [Preset::Paper, Preset::Robust] {
        for mode in [Mode::Freeze, Mode::Observe] {
            let mut pipeline = learnt(preset);
            let before = (hash(&pipeline), parameters(&mut pipeline));
            for sequence in 0..3 * STEPS {
                let frame = frame(true, sequence % STEPS, 1000 + sequence as u64);
                let report = process(&mut pipeline, mode, &frame);
                assert!(!report.learned && report.viewpoint_id.is_none());
            }
            assert_eq!(before, (hash(&pipeline), parameters(&mut pipeline)));
            // The hash sees what learning changes.
            process(&mut pipeline, Mode::Learn, &frame(true, 3, 2000));
            assert_ne!(before.0, hash(&pipeline));
        }
    }
}

#[test]
fn after_a_freeze_everything_goes_on_as_if_nobody_had_looked() {
    let mut plain = learnt(Preset::Robust);
    let mut frozen = learnt(Preset::Robust);
    for sequence in 0..40 {
        // To the far end and back: views written lately leave the nearest seven on the way.
        process(
            &mut frozen,
            Mode::Freeze,
            &frame(true, sequence % STEPS, 1000 + sequence as u64),
        );
    }
    for step in (0..STEPS).rev() {
        let frame = frame(true, step, 2000 + step as u64);
        let expected = without_ids(process(&mut plain, Mode::Learn, &frame));
        assert_eq!(
            without_ids(process(&mut frozen, Mode::Learn, &frame)),
            expected
        );
        assert_eq!(hash(&frozen), hash(&plain));
    }
}

#[test]
fn a_frozen_camera_judges_a_frame_the_same_however_often_it_comes() {
    let mut pipeline = learnt(Preset::Robust);
    let seen = frame(true, STEPS - 1, 1000);
    let first = without_ids(process(&mut pipeline, Mode::Freeze, &seen));
    assert!(!first.regions.is_empty(), "the object is seen");
    for step in 0..STEPS {
        process(
            &mut pipeline,
            Mode::Freeze,
            &frame(false, step, 1001 + step as u64),
        );
        assert_eq!(
            without_ids(process(&mut pipeline, Mode::Freeze, &seen)),
            first
        );
    }
}

#[test]
fn an_observing_camera_goes_on_from_what_it_has_just_written() {
    // The views of the way's end are fresh, and count little, until the camera has been elsewhere.
    let seen = frame(true, STEPS - 1, 1000);
    let mut pipeline = learnt(Preset::Robust);
    let fresh = without_ids(process(&mut pipeline, Mode::Observe, &seen));
    let away = place(false).frame(&intrinsics(), &pose([3.0, 0.0, 0.0], [0.0; 3]), 1001);
    // Viewpoints must lie elsewhere for these to leave the nearest seven.
    for step in 0..STEPS {
        let beside = pose([3.0 + 0.03 * step as f64, 0.0, 0.0], [0.0; 3]);
        let mut other = place(false).frame(&intrinsics(), &beside, step as u64);
        other.source.robot = "another".into();
        process(&mut pipeline, Mode::Learn, &other);
    }
    assert_eq!(
        without_ids(process(&mut pipeline, Mode::Freeze, &seen)),
        fresh
    );
    process(&mut pipeline, Mode::Freeze, &away);
    assert_eq!(
        without_ids(process(&mut pipeline, Mode::Freeze, &seen)),
        fresh,
        "a freeze does not end the visit"
    );
    process(&mut pipeline, Mode::Observe, &away);
    assert_ne!(
        without_ids(process(&mut pipeline, Mode::Freeze, &seen)),
        fresh,
        "an observing camera has left, and what it wrote counts fully"
    );
}

#[test]
fn every_mode_sees_what_a_learning_camera_would_see() {
    let seen = frame(true, 4, 1000);
    let learning = process(&mut learnt(Preset::Robust), Mode::Learn, &seen);
    for mode in [Mode::Observe, Mode::Freeze] {
        let mut report = process(&mut learnt(Preset::Robust), mode, &seen);
        assert!(!report.regions.is_empty(), "{mode:?} reports the object");
        report.learned = true;
        report.viewpoint_id = learning.viewpoint_id;
        assert_eq!(report, learning);
    }
}
