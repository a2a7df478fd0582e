//! Memory grows where there is room and need, replaces what is nearest, and drags no viewpoint along.

mod reference;

use reference::{
    Random,
    scene::{camera, pose, settled, viewpoint},
};
use surprised::{
    config::{Replacement, Settings},
    memory::{Memory, Slot, Version, visit::Visit},
    model::{
        belief::Record,
        pose::{Pose, view_distance_m},
        viewpoint::Viewpoint,
    },
    stages::select::select_nearest,
};

fn at(x_m: f64) -> Pose {
    pose([x_m, 0.0, 0.0], [0.0; 3])
}

fn viewpoint_at(x_m: f64) -> Viewpoint {
    let camera = camera(8, 6);
    let record = Record::pack(&settled([100.0, 0.0, 0.0]));
    viewpoint(
        camera,
        &at(x_m),
        vec![1.0; camera.pixels()],
        vec![record; camera.pixels()],
    )
}

fn learn(memory: &mut Memory, x_m: f64, settings: &Settings) -> (Slot, u64) {
    let poses = memory
        .viewpoints()
        .iter()
        .map(|viewpoint| &viewpoint.world_from_camera);
    let selected = select_nearest(poses, &at(x_m), 1.0, 7, f64::INFINITY);
    let viewpoint = viewpoint_at(x_m);
    let slot = memory.slot(&selected, &at(x_m), viewpoint.bytes(), settings);
    let id = memory.write(slot, viewpoint);
    let bytes: usize = memory.viewpoints().iter().map(|held| held.bytes()).sum();
    assert_eq!(memory.bytes(), bytes);
    (slot, id)
}

#[test]
fn append_then_nearest_fills_up_and_then_replaces_the_nearest() {
    let settings = Settings {
        replacement: Replacement::AppendThenNearest,
        viewpoints: 5,
        ..Settings::robust()
    };
    let mut memory = Memory::default();
    for index in 0..5u64 {
        // However close.
        let (slot, id) = learn(&mut memory, 0.001 * index as f64, &settings);
        assert_eq!((slot, id), (Slot::Append, index + 1));
    }
    let (slot, id) = learn(&mut memory, 0.0021, &settings);
    assert_eq!((slot, id), (Slot::Overwrite(2), 3));
    assert_eq!(memory.viewpoints().len(), 5);
    assert_eq!(memory.viewpoints()[2].world_from_camera, at(0.0021));
    assert_eq!(memory.viewpoints()[2].updates, 2);
    assert_eq!(memory.replaced_for_room(), 0);
}

#[test]
fn grow_home_grows_along_a_slow_path_instead_of_dragging_one_slot_along() {
    let settings = Settings::robust();
    let mut memory = Memory::default();
    // 5 mm a frame over one metre: each frame is close to the view just written.
    for step in 0..=200 {
        learn(&mut memory, 0.005 * f64::from(step), &settings);
    }
    let homes: Vec<f64> = memory
        .viewpoints()
        .iter()
        .map(|viewpoint| viewpoint.world_from_home.translation.x)
        .collect();
    assert!((30..=41).contains(&homes.len()), "{} views", homes.len());
    for pair in homes.windows(2) {
        assert!(
            pair[1] - pair[0] > 0.025 && pair[1] - pair[0] < 0.0351,
            "{pair:?}"
        );
    }
    for viewpoint in memory.viewpoints() {
        let strayed =
            viewpoint.world_from_camera.translation.x - viewpoint.world_from_home.translation.x;
        assert!(strayed.abs() <= 0.025 + 1e-9, "{strayed}");
    }
    // On the way back nothing is added.
    let before = memory.viewpoints().len();
    for step in (0..=200).rev() {
        let (slot, _) = learn(&mut memory, 0.005 * f64::from(step), &settings);
        assert!(matches!(slot, Slot::Overwrite(_)));
    }
    assert_eq!(memory.viewpoints().len(), before);
}

#[test]
fn an_update_keeps_id_and_home_and_is_counted() {
    let settings = Settings::robust();
    let mut memory = Memory::default();
    let (_, id) = learn(&mut memory, 0.0, &settings);
    for x_m in [0.02, -0.02, 0.01] {
        assert_eq!(learn(&mut memory, x_m, &settings), (Slot::Overwrite(0), id));
    }
    let viewpoint = &memory.viewpoints()[0];
    assert_eq!(viewpoint.world_from_home, at(0.0));
    assert_eq!(viewpoint.world_from_camera, at(0.01));
    assert_eq!(viewpoint.updates, 4);
    assert_eq!(learn(&mut memory, 0.026, &settings), (Slot::Append, id + 1));
}

#[test]
fn what_is_needed_at_a_pose_is_the_nearest_that_is_only_stored_nearest_first() {
    let mut random = Random(3);
    let mut any_pose = || {
        let position = [0; 3].map(|_| random.uniform(-2.0, 2.0));
        pose(position, [0; 3].map(|_| random.uniform(-1.0, 1.0)))
    };
    let mut memory = Memory::default();
    let mut poses = Vec::new();
    for index in 0..300u64 {
        let world_from_camera = any_pose();
        let mut viewpoint = viewpoint_at(0.0);
        viewpoint.world_from_camera = world_from_camera;
        viewpoint.id = index + 1;
        let mut absent = true;
        if index < 100 {
            // In RAM.
            memory.write(Slot::Append, viewpoint);
            absent = false;
        } else {
            memory.know(viewpoint.head(), Version::default());
        }
        poses.push((index + 1, world_from_camera, absent));
    }
    for count in [0, 1, 14, 300, 500] {
        let asked = any_pose();
        let mut all: Vec<_> = poses
            .iter()
            .map(|(id, pose, absent)| (view_distance_m(pose, &asked, 1.0), *id, *absent))
            .collect();
        all.sort_by(|a, b| a.0.total_cmp(&b.0));
        all.truncate(count);
        let expected: Vec<u64> = all
            .iter()
            .filter(|view| view.2)
            .map(|view| view.1)
            .collect();
        assert_eq!(memory.need(&asked, count, 1.0), expected);
    }
}

#[test]
fn a_full_budget_replaces_the_nearest_and_counts_it() {
    let bytes = viewpoint_at(0.0).bytes();
    for replacement in [Replacement::GrowHome, Replacement::AppendThenNearest] {
        let settings = Settings {
            replacement,
            memory_bytes: 3 * bytes + bytes / 2,
            ..Settings::robust()
        };
        let mut memory = Memory::default();
        for x_m in [0.0, 1.0, 2.0] {
            assert_eq!(learn(&mut memory, x_m, &settings).0, Slot::Append);
        }
        assert_eq!(learn(&mut memory, 1.4, &settings), (Slot::Reuse(1), 4));
        assert_eq!(memory.viewpoints().len(), 3);
        assert!(memory.bytes() <= settings.memory_bytes);
        assert_eq!(memory.replaced_for_room(), 1);
        let reused = &memory.viewpoints()[1];
        assert_eq!((reused.world_from_home, reused.updates), (at(1.4), 1));
        assert_eq!(learn(&mut memory, 5.0, &settings), (Slot::Reuse(2), 5));
        assert_eq!(memory.replaced_for_room(), 2);
    }
}

#[test]
fn a_view_written_in_this_visit_weighs_little_until_it_was_rewritten_more_often_than_in_passing() {
    let near = |weight: (f32, bool), expected: f32, fresh: bool| {
        assert!(
            (weight.0 - expected).abs() < 1e-5 && weight.1 == fresh,
            "{weight:?}"
        );
    };
    let mut visit = Visit::default();
    near(visit.weight(1), 1.0, false);
    visit.wrote(1);
    near(visit.weight(1), 0.2, true);
    near(visit.weight(2), 1.0, false);
    for _ in 0..3 {
        visit.wrote(1);
        near(visit.weight(1), 0.2, true);
    }
    for more in 1..=30u8 {
        visit.wrote(1);
        near(visit.weight(1), 0.2 + 0.2 * f32::from(more), true);
    }
    // To and fro between two views is no reason to forget how often each was written.
    visit.wrote(2);
    near(visit.weight(2), 0.2, true);
    visit.wrote(1);
    near(visit.weight(1), 6.4, true);
    // It stays fresh while it is among the nearest, and no longer.
    visit.select(&[1, 5]);
    near(visit.weight(1), 6.4, true);
    near(visit.weight(2), 1.0, false);
    visit.select(&[5]);
    near(visit.weight(1), 1.0, false);
    visit.select(&[1]);
    near(visit.weight(1), 1.0, false);
}
