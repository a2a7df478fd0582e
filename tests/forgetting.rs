//! What is forgotten is unseen wherever it is recalled, and the rest stays bit for bit.

mod reference;

use std::sync::Arc;

use nalgebra::{Point3, Vector3};
use reference::{
    pool,
    scene::{Panel, Scene, camera, pose},
};
use surprised::{
    config::Settings,
    memory::{
        Version,
        forget::{Forget, Forgetting, Forgotten, Region},
        store::form::{self, Label},
    },
    model::{
        belief::{Belief, Record},
        camera::Intrinsics,
        frame::DepthSource,
        pose::Pose,
        viewpoint::{Mesh, Viewpoint},
    },
    pipeline::Pipeline,
    stages::interpolate::prior,
};

const STEPS: u64 = 8;

fn intrinsics() -> Intrinsics {
    camera(64, 48)
}

fn wall() -> Scene {
    Scene {
        panels: vec![Panel {
            center: Point3::new(0.0, 0.0, 2.0),
            right: Vector3::x(),
            down: Vector3::y(),
            half_size_m: (9.0, 9.0),
            texture: Box::new(|a, b| [120.0 + 40.0 * (7.0 * a).sin() * (5.0 * b).cos(), 0.0, 0.0]),
        }],
    }
}

fn along(step: u64) -> Pose {
    pose([0.03 * step as f64, 0.0, 0.0], [0.0; 3])
}

/// A second of the epoch a frame.
fn second(step: u64) -> i64 {
    step as i64 * 1_000_000_000
}

fn learn(pipeline: &mut Pipeline, step: u64, position: u64) {
    let mut frame = wall().frame(&intrinsics(), &along(position), step);
    frame.stamp_ns = second(step);
    pipeline.process(&frame).expect("the frame is good");
}

fn learnt() -> Pipeline {
    learnt_with(false)
}

/// Only where poses are refined there is something that they are refined against.
fn learnt_with(refine_pose: bool) -> Pipeline {
    let settings = Settings {
        refine_pose,
        ..Settings::robust()
    };
    let mut pipeline = Pipeline::new(settings, pool(2));
    for step in 0..STEPS {
        learn(&mut pipeline, step, step);
    }
    pipeline
}

fn forget(pipeline: &mut Pipeline, what: Forget) -> Forgotten {
    let mut forgetting = Forgetting::new(what);
    while !pipeline.forget(&mut forgetting, 3) {}
    forgetting.forgotten().clone()
}

fn in_region(region: Region) -> Forget {
    Forget {
        region: Some(region),
        span_ns: None,
    }
}

const HOLE: Region = Region::Sphere {
    center: Point3::new(0.1, 0.05, 2.0),
    radius_m: 0.2,
};

/// The plain way: one pixel at a time, through the camera model.
fn point_in_world(view: &Viewpoint, pixel: usize) -> Point3<f64> {
    let camera = view.mesh.intrinsics;
    let (u, v) = (pixel % camera.width, pixel / camera.width);
    let z_m = f64::from(view.mesh.depth_m[pixel]);
    view.world_from_camera * camera.unproject(u as f64, v as f64, z_m)
}

#[test]
fn a_forgotten_sphere_is_unseen_and_everything_else_stays_bit_for_bit() {
    let mut pipeline = learnt();
    let before: Vec<Arc<Viewpoint>> = pipeline.memory().viewpoints().to_vec();
    let forgotten = forget(&mut pipeline, in_region(HOLE));
    let unknown = Record::pack(&Belief::unknown());
    let mut pixels = 0;
    for (old, new) in before.iter().zip(pipeline.memory().viewpoints()) {
        assert_eq!(
            (old.id, old.updates, old.stamp_ns),
            (new.id, new.updates, new.stamp_ns)
        );
        let mut depth_m = old.mesh.depth_m.clone();
        for pixel in 0..depth_m.len() {
            let gone = HOLE.contains(&point_in_world(old, pixel));
            pixels += u64::from(gone);
            let expected = if gone { unknown } else { old.records[pixel] };
            assert_eq!(new.records[pixel], expected);
            if gone {
                depth_m[pixel] = 0.0;
            }
        }
        // As if the sensor had never measured there.
        assert_eq!(new.mesh, Mesh::new(intrinsics(), depth_m, 0.05));
    }
    assert!(pixels > 500, "{pixels} pixels lie in the sphere");
    assert_eq!(forgotten.pixels, pixels);
    assert_eq!(forgotten.changed.len(), before.len());
    assert!(forgotten.removed.is_empty());

    let from = along(3);
    let at = pipeline.prior(&intrinsics(), &from);
    let coverage: Vec<f32> = at.prior.plane(prior::COVERAGE).collect();
    let picture = wall().picture(&intrinsics(), &from);
    for (pixel, views) in coverage.iter().enumerate() {
        let camera = intrinsics();
        let (u, v) = (pixel % camera.width, pixel / camera.width);
        let z_m = f64::from(picture.depth_m[pixel]);
        let point = from * camera.unproject(u as f64, v as f64, z_m);
        if HOLE.contains(&point) {
            assert_eq!(*views, 0.0, "pixel {u} {v} was forgotten");
        }
        let away = (point - Point3::new(0.1, 0.05, 2.0)).norm() > 0.3;
        let inside = (4..camera.width - 4).contains(&u) && (4..camera.height - 4).contains(&v);
        assert!(
            *views > 0.0 || !(away && inside),
            "pixel {u} {v} is still known"
        );
    }
}

#[test]
fn nothing_of_the_forgotten_is_left_in_what_poses_are_refined_against() {
    let mut pipeline = learnt_with(true);
    let before: Vec<Arc<Viewpoint>> = pipeline.memory().viewpoints().to_vec();
    forget(&mut pipeline, in_region(HOLE));
    for (old, new) in before.iter().zip(pipeline.memory().viewpoints()) {
        let width = old.coarse.mesh.intrinsics.width;
        assert_eq!(old.coarse.luminance.len(), 32 * 24);
        for pixel in 0..old.coarse.luminance.len() {
            let upper = 2 * (pixel / width) * 64 + 2 * (pixel % width);
            let gone = [upper, upper + 1, upper + 64, upper + 65]
                .iter()
                .any(|&fine| HOLE.contains(&point_in_world(old, fine)));
            if gone {
                assert_eq!(new.coarse.mesh.depth_m[pixel], 0.0);
                assert_eq!(new.coarse.luminance[pixel], 127.5);
            } else {
                assert_eq!(
                    new.coarse.mesh.depth_m[pixel],
                    old.coarse.mesh.depth_m[pixel]
                );
                assert_eq!(new.coarse.luminance[pixel], old.coarse.luminance[pixel]);
                assert_eq!(new.coarse.variance[pixel], old.coarse.variance[pixel]);
            }
        }
    }
}

#[test]
fn what_was_forgotten_is_stored_and_read_back_bit_for_bit_and_its_size_is_known() {
    let mut pipeline = learnt_with(true);
    // Twice, and once over what had no depth: a viewpoint's coarse picture follows from what is stored of it.
    let mut frame = wall().frame(&intrinsics(), &along(2), 60);
    if let DepthSource::Given(depth_m) = &mut frame.depth {
        for (pixel, z_m) in depth_m.iter_mut().enumerate() {
            if pixel % 7 == 0 || (20..24).contains(&(pixel / 64)) {
                *z_m = 0.0;
            }
        }
    }
    frame.stamp_ns = second(60);
    pipeline.process(&frame).expect("the frame is good");
    for center in [Point3::new(0.1, 0.05, 2.0), Point3::new(0.3, -0.1, 2.0)] {
        let radius_m = 0.15;
        forget(
            &mut pipeline,
            in_region(Region::Sphere { center, radius_m }),
        );
        let label = Label {
            place: "lab".to_owned(),
            version: Version::default(),
            settings_hash: 0,
        };
        let viewpoints = pipeline.memory().viewpoints();
        for viewpoint in viewpoints {
            let object = form::Encoder::default().encode(&label, viewpoint);
            let (_, read) = form::decode(&object, usize::MAX).expect("it was just made");
            assert!(read == **viewpoint, "viewpoint {}", viewpoint.id);
        }
        let bytes: usize = viewpoints.iter().map(|viewpoint| viewpoint.bytes()).sum();
        assert_eq!(pipeline.memory().bytes(), bytes);
    }
}

#[test]
fn what_viewpoints_take_after_a_part_of_them_was_forgotten_is_what_the_memory_says() {
    let settings = Settings {
        refine_pose: false,
        ..Settings::robust()
    };
    let mut pipeline = Pipeline::new(settings, pool(2));
    // A screen of three flat parts, between which no run of blocks goes on: most of what there is room for.
    let mut frame = wall().frame(&intrinsics(), &along(0), 0);
    if let DepthSource::Given(depth_m) = &mut frame.depth {
        for (pixel, z_m) in depth_m.iter_mut().enumerate() {
            let column = (pixel % 64) as f32;
            let inverse =
                0.5 + 2e-3 * (column.min(32.0) - 16.0).max(0.0) - 1e-3 * (column - 32.0).max(0.0);
            *z_m = 1.0 / inverse;
        }
    }
    frame.stamp_ns = second(1);
    pipeline.process(&frame).expect("the frame is good");
    let taken = |pipeline: &Pipeline| pipeline.memory().viewpoints()[0].bytes();
    let before = taken(&pipeline);
    assert_eq!(pipeline.memory().bytes(), before);
    // Held elsewhere, as while it is stored, it is copied before it is changed, and the copy has other room.
    let held = pipeline.memory().viewpoints().to_vec();
    forget(&mut pipeline, in_region(HOLE));
    assert_ne!(
        taken(&pipeline),
        before,
        "it takes more or less than before"
    );
    assert_eq!(pipeline.memory().bytes(), taken(&pipeline));
    drop(held);
}

#[test]
fn a_box_around_everything_leaves_no_viewpoint() {
    let mut pipeline = learnt();
    let views = pipeline.memory().viewpoints().len();
    let everywhere = Region::Box {
        min: Point3::new(-50.0, -50.0, 1.9),
        max: Point3::new(50.0, 50.0, 2.1),
    };
    let forgotten = forget(&mut pipeline, in_region(everywhere));
    assert_eq!(
        (
            forgotten.removed.len(),
            pipeline.memory().viewpoints().len()
        ),
        (views, 0)
    );
    assert_eq!(pipeline.memory().bytes(), 0);
    // The place begins anew, and nobody takes a new viewpoint for an old one.
    learn(&mut pipeline, 100, 0);
    assert!(pipeline.memory().viewpoints()[0].id > views as u64);
}

#[test]
fn a_box_beside_the_wall_forgets_nothing() {
    let mut pipeline = learnt();
    let before = pipeline.memory().viewpoints().to_vec();
    let beside = Region::Box {
        min: Point3::new(-50.0, -50.0, 2.1),
        max: Point3::new(50.0, 50.0, 9.0),
    };
    assert_eq!(
        forget(&mut pipeline, in_region(beside)),
        Forgotten::default()
    );
    assert_eq!(pipeline.memory().viewpoints(), before);
}

#[test]
fn a_span_removes_the_viewpoints_that_were_written_last_within_it() {
    let mut pipeline = learnt();
    // The first is written once more, later.
    learn(&mut pipeline, 20, 0);
    let bytes = pipeline.memory().bytes();
    let each = pipeline.memory().viewpoints()[0].bytes();
    let span_ns = Some(second(0)..second(3));
    let forgotten = forget(
        &mut pipeline,
        Forget {
            region: None,
            span_ns,
        },
    );
    assert_eq!(forgotten.removed, [2, 3]);
    assert_eq!(forgotten.pixels, 2 * intrinsics().pixels() as u64);
    let left: Vec<u64> = pipeline
        .memory()
        .viewpoints()
        .iter()
        .map(|view| view.id)
        .collect();
    assert_eq!(left, [1, 4, 5, 6, 7, 8]);
    assert_eq!(pipeline.memory().bytes(), bytes - 2 * each);
}

#[test]
fn a_region_and_a_span_are_forgotten_where_both_hold() {
    let mut pipeline = learnt();
    let before = pipeline.memory().viewpoints().to_vec();
    let what = Forget {
        region: Some(HOLE),
        span_ns: Some(second(2)..second(4)),
    };
    assert_eq!(forget(&mut pipeline, what).changed, [3, 4]);
    for (old, new) in before.iter().zip(pipeline.memory().viewpoints()) {
        assert_eq!(old == new, !matches!(old.id, 3 | 4));
    }
}

#[test]
fn what_frames_write_meanwhile_is_gone_through_as_well() {
    let mut pipeline = learnt();
    let mut forgetting = Forgetting::new(in_region(HOLE));
    assert!(!pipeline.forget(&mut forgetting, 4));
    // Over a viewpoint that was cleared already; its neighbours still know the place, and so does the frame.
    learn(&mut pipeline, 50, 1);
    let rewritten = |pipeline: &Pipeline| {
        let view = &pipeline.memory().viewpoints()[1];
        let inside = (0..view.records.len()).filter(|&pixel| {
            view.mesh.depth_m[pixel] > 0.0 && HOLE.contains(&point_in_world(view, pixel))
        });
        inside.count()
    };
    assert!(rewritten(&pipeline) > 0, "the frame has written it");
    while !pipeline.forget(&mut forgetting, 4) {}
    assert_eq!(rewritten(&pipeline), 0);
}
