//! What is recalled is what stands there: scenes of panels whose colour and coverage are known exactly at every pose.

mod reference;

use nalgebra::{Point3, Vector3};
use reference::{
    Random, isas, pool,
    scene::{Hit, Panel, Scene, camera, pose, settled, viewpoint},
};
use surprised::{
    config::{Preset, Settings},
    engine::cpu::{CpuEngine, RecallView},
    model::{
        belief::Record,
        camera::Intrinsics,
        pose::Pose,
        viewpoint::{Mesh, Viewpoint},
    },
    stages::interpolate::prior::{self, Prior},
};

/// Linear on the panel, so that triangles reproduce it exactly.
fn linear(base: f64, slope: f64) -> reference::scene::Texture {
    Box::new(move |a, b| {
        [
            base + slope * (a + 0.5 * b),
            0.2 * slope * b - 10.0,
            15.0 - 0.3 * slope * a,
        ]
    })
}

fn wall(yaw_rad: f64) -> Panel {
    let turn = pose([0.0; 3], [0.1, yaw_rad, 0.0]).rotation;
    Panel {
        center: Point3::new(0.0, 0.0, 2.0),
        right: turn * Vector3::x(),
        down: turn * Vector3::y(),
        half_size_m: (4.0, 4.0),
        texture: linear(120.0, 12.0),
    }
}

fn occluder() -> Panel {
    Panel {
        center: Point3::new(0.05, -0.02, 1.1),
        right: Vector3::x(),
        down: Vector3::y(),
        half_size_m: (0.17, 0.13),
        texture: linear(40.0, 20.0),
    }
}

fn recall(
    settings: &Settings,
    views: &[&Viewpoint],
    target: &Intrinsics,
    world_from_target: &Pose,
) -> Prior {
    let views: Vec<RecallView> = views
        .iter()
        .map(|viewpoint| RecallView {
            viewpoint,
            weight: 1.0,
            fresh: false,
        })
        .collect();
    let mut prior = Prior::default();
    CpuEngine::new(settings, pool(2), isas()[0]).recall(
        &views,
        target,
        world_from_target,
        &mut prior,
    );
    prior
}

/// Whether a view has a triangle at a point of a panel: `None` near its border, where that hangs on a pixel.
fn has(view: &Viewpoint, panels: &[Option<usize>], hit: &Hit) -> Option<bool> {
    let camera = view.mesh.intrinsics;
    let in_view = view.world_from_camera.inverse() * hit.point_in_world;
    let Some((u, v)) = camera.project(&in_view) else {
        return Some(false);
    };
    let (x, y) = (u.floor() as i64, v.floor() as i64);
    let mut same = 0;
    for y in y - 1..=y + 2 {
        for x in x - 1..=x + 2 {
            let inside = x >= 0 && y >= 0 && x < camera.width as i64 && y < camera.height as i64;
            let seen = inside.then(|| panels[y as usize * camera.width + x as usize]);
            same += usize::from(seen.flatten() == Some(hit.panel));
        }
    }
    match same {
        16 => Some(true),
        0 => Some(false),
        _ => None,
    }
}

/// Compares the recall in every pixel where truth does not hang on single pixels; returns how many were covered by
/// none, by some and by all views.
fn assert_recall_is_true(
    scene: &Scene,
    cameras: &[(Intrinsics, Pose)],
    target: &Intrinsics,
    world_from_target: &Pose,
    slack: f64,
) -> [usize; 3] {
    let views: Vec<Viewpoint> = cameras
        .iter()
        .map(|(camera, pose)| scene.viewpoint(camera, pose))
        .collect();
    let panels: Vec<_> = cameras
        .iter()
        .map(|(camera, pose)| scene.picture(camera, pose).panel)
        .collect();
    let settings = Settings::paper();
    let prior = recall(
        &settings,
        &views.iter().collect::<Vec<_>>(),
        target,
        world_from_target,
    );
    let mut counts = [0; 3];
    let mut compared = 0;
    'pixels: for pixel in 0..target.pixels() {
        let (x, y) = (pixel % target.width, pixel / target.width);
        let hits = scene.hits(target, world_from_target, x as f64, y as f64);
        let mut seen: Vec<Hit> = Vec::new();
        for (view, panels) in views.iter().zip(&panels) {
            for hit in &hits {
                match has(view, panels, hit) {
                    Some(true) => {
                        seen.push(*hit);
                        break;
                    }
                    Some(false) => {}
                    None => continue 'pixels,
                }
            }
        }
        compared += 1;
        let row = prior.row(y);
        let coverage = row.plane(prior::COVERAGE)[x];
        assert_eq!(coverage, seen.len() as f32, "views that see ({x}, {y})");
        counts[match seen.len() {
            0 => 0,
            all if all == views.len() => 2,
            _ => 1,
        }] += 1;
        let depth_m = f64::from(row.plane(prior::DEPTH)[x]);
        if seen.is_empty() {
            assert_eq!(depth_m, 0.0);
            continue;
        }
        let count = seen.len() as f64;
        for channel in 0..3 {
            let expected = seen.iter().map(|hit| hit.colour[channel]).sum::<f64>() / count;
            let got = f64::from(row.plane(prior::TAU + channel)[x]);
            assert!(
                (got - expected).abs() < slack,
                "tau {channel} of ({x}, {y}) is {got} instead of {expected}"
            );
        }
        let expected = seen.iter().map(|hit| hit.depth_m).sum::<f64>() / count;
        assert!(
            (depth_m / expected - 1.0).abs() < 1e-4,
            "{depth_m} m, not {expected}"
        );
    }
    assert!(
        compared * 10 > target.pixels() * 7,
        "only {compared} of {} pixels can be compared",
        target.pixels()
    );
    counts
}

/// Views of several sizes and focal lengths around the target.
fn cameras() -> Vec<(Intrinsics, Pose)> {
    let odd = Intrinsics {
        fx: 150.0,
        fy: 140.0,
        cx: 80.3,
        cy: 61.8,
        ..camera(171, 131)
    };
    vec![
        (
            camera(160, 120),
            pose([-0.25, 0.05, 0.0], [0.02, 0.1, 0.03]),
        ),
        (odd, pose([0.2, -0.1, 0.1], [-0.03, -0.08, -0.05])),
        (camera(200, 150), pose([0.0, 0.2, -0.2], [0.1, 0.0, 0.0])),
    ]
}

#[test]
fn a_wall_and_what_stands_before_it_are_recalled_from_a_new_pose() {
    for yaw in [0.0, 0.5] {
        let scene = Scene {
            panels: vec![wall(yaw), occluder()],
        };
        let target = Intrinsics {
            fx: 140.0,
            ..camera(161, 119)
        };
        let world_from_target = pose([0.03, 0.02, 0.05], [0.01, -0.02, 0.04]);
        // Position is kept to 1/256 pixel, the colour to 1/256 grey level.
        let counts = assert_recall_is_true(&scene, &cameras(), &target, &world_from_target, 0.02);
        assert!(counts[2] > 5000, "{counts:?}");
    }
}

#[test]
fn flat_parts_drawn_whole_are_where_their_triangles_are() {
    let scene = Scene {
        panels: vec![wall(0.3), occluder()],
    };
    let mut random = Random(11);
    let (mut tau, mut covered, mut same, mut pixels) = (0.0, 0.0, 0.0, 0.0);
    for _ in 0..6 {
        let mut flat = scene.viewpoint(&camera(200, 150), &pose([0.0; 3], [0.0; 3]));
        // Depth that is not quite flat: as far off as patches may be.
        for z in &mut flat.mesh.depth_m {
            *z = 1.0 / (1.0 / *z + random.uniform(-1.5e-4, 1.5e-4) as f32);
        }
        let depth_m = std::mem::take(&mut flat.mesh.depth_m);
        flat.mesh = Mesh::new(flat.mesh.intrinsics, depth_m, 0.05);
        let quads: usize = flat.mesh.patches.iter().map(|p| p.columns * p.rows).sum();
        assert!(quads * 2 > flat.mesh.cut.len(), "{quads} quads in patches");
        let mut triangles = flat.clone();
        triangles.mesh.patches.clear();
        let target = camera(199, 149);
        let here = pose(
            std::array::from_fn(|_| random.uniform(-0.2, 0.2)),
            std::array::from_fn(|_| random.uniform(-0.1, 0.1)),
        );
        let settings = Settings::paper();
        let got = recall(&settings, &[&flat], &target, &here);
        let expected = recall(&settings, &[&triangles], &target, &here);
        for (pixel, (got_count, count)) in got
            .plane(prior::COVERAGE)
            .zip(expected.plane(prior::COVERAGE))
            .enumerate()
        {
            pixels += 1.0;
            same += f64::from(u8::from(got_count == count));
            if got_count.min(count) > 0.0 {
                let (x, y) = (pixel % target.width, pixel / target.width);
                let (a, b) = (got.belief(x, y).tau[0], expected.belief(x, y).tau[0]);
                tau += f64::from((a - b).abs());
                covered += 1.0;
            }
        }
    }
    assert!(
        tau / covered <= 0.02,
        "mean difference of tau {}",
        tau / covered
    );
    assert!(same / pixels >= 0.995, "as many views: {}", same / pixels);
}

#[test]
fn what_only_some_or_none_of_the_views_saw_is_counted_so() {
    let scene = Scene {
        panels: vec![wall(0.3), occluder()],
    };
    let target = camera(131, 97);
    let turned = pose([0.3, 0.0, 0.1], [0.05, 0.35, 0.1]);
    let counts = assert_recall_is_true(&scene, &cameras(), &target, &turned, 0.02);
    assert!(counts.iter().all(|count| *count > 200), "{counts:?}");
}

#[test]
fn one_view_leaves_the_gap_behind_an_edge_unseen_and_mixes_nothing_across_it() {
    let scene = Scene {
        panels: vec![wall(0.0), occluder()],
    };
    let views = [(camera(160, 120), pose([0.0; 3], [0.0; 3]))];
    let beside = pose([0.3, 0.0, 0.0], [0.0; 3]);
    let target = camera(160, 120);
    let counts = assert_recall_is_true(&scene, &views, &target, &beside, 0.02);
    assert!(counts[0] > 500, "the gap is {} pixels", counts[0]);

    // Also at the very edge no colour lies between the two.
    let view = scene.viewpoint(&views[0].0, &views[0].1);
    let prior = recall(&Settings::paper(), &[&view], &target, &beside);
    for y in 40..80 {
        for x in 0..160 {
            let row = prior.row(y);
            if row.plane(prior::COVERAGE)[x] > 0.0 {
                let tau = row.plane(prior::TAU)[x];
                // The occluder is 30..50, the wall 80..160.
                assert!(!(56.0..75.0).contains(&tau), "{tau} at ({x}, {y})");
            }
        }
    }
}

#[test]
fn a_view_from_its_own_pose_returns_itself_bit_for_bit() {
    let mut random = Random(1);
    for (width, height) in [(17, 19), (64, 48), (33, 5), (2, 2), (160, 120)] {
        for _ in 0..4 {
            let camera = Intrinsics {
                fx: random.uniform(0.7, 1.5) * width as f64,
                fy: random.uniform(0.7, 1.5) * width as f64,
                cx: random.uniform(0.4, 0.6) * width as f64,
                cy: random.uniform(0.4, 0.6) * height as f64,
                ..camera(width, height)
            };
            let world_from_camera = pose(
                std::array::from_fn(|_| random.uniform(-3.0, 3.0)),
                std::array::from_fn(|_| random.uniform(-2.0, 2.0)),
            );
            // A smooth surface with holes of 2x2 pixels.
            let phase = random.uniform(0.0, 6.0);
            let mut depth_m: Vec<f32> = (0..width * height)
                .map(|pixel| {
                    let (x, y) = ((pixel % width) as f64, (pixel / width) as f64);
                    (1.5 + 0.3 * (0.08 * x + phase).sin() * (0.06 * y).cos()) as f32
                })
                .collect();
            if width > 30 && height > 10 {
                for y in [3, 4] {
                    for x in [10, 11] {
                        depth_m[y * width + x] = 0.0;
                    }
                }
            }
            let records: Vec<Record> = depth_m
                .iter()
                .map(|_| {
                    let mut belief = settled([
                        random.uniform(0.0, 255.0) as f32,
                        random.uniform(-100.0, 100.0) as f32,
                        random.uniform(-100.0, 100.0) as f32,
                    ]);
                    belief.alpha = random.uniform(1.0, 2.5) as f32;
                    belief.beta[1] = random.log_uniform(1.0, 6e4) as f32;
                    belief.sigma[2] = random.log_uniform(0.05, 1.0) as f32;
                    if random.below(2) == 0 {
                        belief.tau2 = [random.uniform(0.0, 255.0) as f32, 3.0, 4.0];
                        belief.p2 = random.uniform(0.05, 0.95) as f32;
                    }
                    Record::pack(&belief)
                })
                .collect();
            let view = viewpoint(camera, &world_from_camera, depth_m.clone(), records.clone());
            for preset in [Preset::Paper, Preset::Robust] {
                let settings = Settings::preset(preset);
                let prior = recall(&settings, &[&view], &camera, &world_from_camera);
                for (pixel, &z) in depth_m.iter().enumerate() {
                    let (x, y) = (pixel % width, pixel / width);
                    let coverage = prior.row(y).plane(prior::COVERAGE)[x];
                    let place = format!("{width}x{height} ({x}, {y})");
                    assert_eq!(coverage, f32::from(u8::from(z > 0.0)), "{place}");
                    if z > 0.0 {
                        let got = prior.belief(x, y);
                        let mut expected = records[pixel].unpack();
                        if preset == Preset::Paper || expected.p2 == 0.0 {
                            expected.p2 = 0.0;
                            expected.tau2 = got.tau2;
                        }
                        // What was there before is never certain.
                        expected.p2 = expected.p2.min(0.95);
                        // tau2 is divided by the weight that it was multiplied with.
                        for c in 0..3 {
                            assert!((got.tau2[c] - expected.tau2[c]).abs() < 1e-3, "{place}");
                        }
                        expected.tau2 = got.tau2;
                        assert_eq!(got, expected, "{place}");
                        let depth_m = prior.row(y).plane(prior::DEPTH)[x];
                        assert!((depth_m / z - 1.0).abs() < 2e-5);
                    }
                }
            }
        }
    }
}

#[test]
fn a_surface_seen_from_behind_and_a_scene_behind_the_camera_are_unseen() {
    let scene = Scene {
        panels: vec![wall(0.0)],
    };
    let camera = camera(64, 48);
    let view = scene.viewpoint(&camera, &pose([0.0; 3], [0.0; 3]));
    let covered = |world_from_target: Pose| {
        let prior = recall(&Settings::paper(), &[&view], &camera, &world_from_target);
        prior.plane(prior::COVERAGE).filter(|c| *c > 0.0).count()
    };
    // From the other side of the wall, looking back.
    let half_turn = std::f64::consts::PI;
    assert_eq!(covered(pose([0.0, 0.0, 4.0], [0.0, half_turn, 0.0])), 0);
    // Past the wall, and turned away from it.
    assert_eq!(covered(pose([0.0, 0.0, 2.5], [0.0; 3])), 0);
    assert_eq!(covered(pose([0.0; 3], [0.0, half_turn, 0.0])), 0);
    // From where it was seen it is there, and from beside the wall, half of it behind the camera, part of it is.
    assert_eq!(covered(pose([0.0; 3], [0.0; 3])), 64 * 48);
    let beside = covered(pose([0.3, 0.0, 1.9], [0.0, -1.2, 0.0]));
    assert!(beside > 100 && beside < 64 * 48, "{beside}");
}

#[test]
fn nothing_is_known_without_views() {
    let camera = camera(33, 21);
    for preset in [Preset::Paper, Preset::Robust] {
        let prior = recall(
            &Settings::preset(preset),
            &[],
            &camera,
            &pose([0.0; 3], [0.0; 3]),
        );
        for y in 0..21 {
            for x in 0..33 {
                let belief = prior.belief(x, y);
                assert_eq!((belief.alpha, belief.beta), (1.0, [1.0; 3]));
                assert_eq!((belief.tau, belief.sigma), ([0.0; 3], [5.0; 3]));
                assert_eq!(belief.p2, 0.0);
                assert_eq!(prior.row(y).plane(prior::COVERAGE)[x], 0.0);
            }
        }
    }
}
