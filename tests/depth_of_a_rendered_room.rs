//! Depth in metres against exact truth: rigs that are rectified, toed in and displaced, other exposure on one side, an
//! expectation that is wrong, images that say nothing; and the same depth from every instruction set.

mod rendered;

use nalgebra::{Translation3, UnitQuaternion, Vector3};
use rendered::{Room, Sensor, Shape, Texture, View};
use surprised::{
    isa::Isa,
    model::{camera::Intrinsics, pose::Pose},
    stages::depth::{
        DepthEstimator, DepthMap, DepthRig, DepthSettings, InverseDepthRange, SEEN_BY_LEFT,
        SEEN_BY_RIGHT, SideCamera,
    },
};

const BASELINE_M: f64 = 0.09;
const CAMERA: Intrinsics = Intrinsics {
    width: 321,
    height: 243,
    fx: 270.0,
    fy: 270.0,
    cx: 160.2,
    cy: 120.7,
};

fn range() -> InverseDepthRange {
    // Half a pixel of the rectified rig a label; from infinitely far to 1.5 m.
    InverseDepthRange::new(0.0, 1.0 / 1.5, 33).unwrap()
}

struct Scene {
    rig: DepthRig,
    middle: View,
    left: View,
    right: View,
}

fn pose(translation: [f64; 3], turn: [f64; 3]) -> Pose {
    Pose::from_parts(
        Translation3::from(translation),
        UnitQuaternion::from_scaled_axis(Vector3::from(turn)),
    )
}

fn rectified() -> [Pose; 2] {
    [
        pose([-BASELINE_M, 0.0, 0.0], [0.0; 3]),
        pose([BASELINE_M, 0.0, 0.0], [0.0; 3]),
    ]
}

impl Scene {
    fn new(
        room: &Room,
        middle_from_side: [Pose; 2],
        lens: Intrinsics,
        exposures: [(f64, f64); 2],
    ) -> Self {
        let sensor = |gain, offset, seed| Sensor {
            gain,
            offset,
            noise: 1.5,
            seed,
        };
        let side = |i: usize| {
            let (gain, offset) = exposures[i];
            room.render(
                &lens,
                &middle_from_side[i],
                sensor(gain, offset, i as u32 + 1),
            )
        };
        let camera = |i: usize| {
            Some(SideCamera {
                intrinsics: lens,
                side_from_middle: middle_from_side[i].inverse(),
            })
        };
        Self {
            rig: DepthRig {
                middle: CAMERA,
                left: camera(0),
                right: camera(1),
            },
            middle: room.render(&CAMERA, &Pose::identity(), sensor(1.0, 0.0, 0)),
            left: side(0),
            right: side(1),
        }
    }

    fn estimate(&self, expected_depth_m: Option<&[f32]>) -> DepthMap {
        self.estimate_with(
            &mut DepthEstimator::new(DepthSettings::default()),
            expected_depth_m,
        )
    }

    fn estimate_with(
        &self,
        estimator: &mut DepthEstimator,
        expected_depth_m: Option<&[f32]>,
    ) -> DepthMap {
        let Self {
            rig,
            middle,
            left,
            right,
        } = self;
        let middle_rgb: Vec<[u8; 3]> = middle.luminance.iter().map(|y| [*y; 3]).collect();
        estimator
            .estimate(
                rig,
                &middle_rgb,
                &left.luminance,
                &right.luminance,
                &range(),
                expected_depth_m,
            )
            .clone()
    }

    /// Percent of all pixels whose dense inverse depth is off by more than two labels, and the mean error in labels of
    /// the others.
    fn wrong(&self, map: &DepthMap) -> (f64, f64) {
        let errors: Vec<f32> = map
            .inverse_depth
            .iter()
            .zip(&self.middle.depth_m)
            .map(|(inverse_depth, depth_m)| (inverse_depth - 1.0 / depth_m).abs() / map.label_step)
            .collect();
        let good: Vec<f32> = errors
            .iter()
            .copied()
            .filter(|error| *error <= 2.0)
            .collect();
        let wrong = 100.0 * (errors.len() - good.len()) as f64 / errors.len() as f64;
        (
            wrong,
            f64::from(good.iter().sum::<f32>()) / good.len() as f64,
        )
    }
}

#[track_caller]
fn assert_good(scene: &Scene, map: &DepthMap) {
    let (wrong, error) = scene.wrong(map);
    println!("{wrong:.2} % wrong, else {error:.2} labels off");
    assert!(
        wrong < 1.5 && error < 0.5,
        "{wrong:.2} % wrong, else {error:.2} labels off"
    );
}

#[test]
fn a_rectified_rig_knows_the_depth_below_a_label() {
    let scene = Scene::new(&Room::furnished(), rectified(), CAMERA, [(1.0, 0.0); 2]);
    let map = scene.estimate(None);
    assert_good(&scene, &map);
    let valid = map.depth_m.iter().filter(|depth_m| **depth_m > 0.0).count();
    assert!(
        valid * 100 > map.depth_m.len() * 98,
        "{valid} of {}",
        map.depth_m.len()
    );
    for (depth_m, inverse_depth) in map.depth_m.iter().zip(&map.inverse_depth) {
        assert!(*depth_m == 0.0 || (depth_m * inverse_depth - 1.0).abs() < 1e-5);
    }
}

#[test]
fn a_third_camera_sees_what_a_second_does_not() {
    let mut scene = Scene::new(&Room::furnished(), rectified(), CAMERA, [(1.0, 0.0); 2]);
    let (three, _) = scene.wrong(&scene.estimate(None));
    scene.rig.left = None;
    let pair = scene.estimate(None);
    let (two, _) = scene.wrong(&pair);
    assert!(
        three < 0.7 * two,
        "three cameras {three:.2} %, two {two:.2} %"
    );
    assert!(
        pair.seen_by
            .iter()
            .all(|seen_by| seen_by & SEEN_BY_LEFT == 0)
    );
}

#[test]
fn a_rig_may_be_toed_in_and_displaced_and_have_other_lenses_at_its_sides() {
    let lens = Intrinsics {
        width: 340,
        height: 250,
        fx: 262.0,
        fy: 264.0,
        cx: 171.0,
        cy: 122.0,
    };
    let middle_from_side = [
        pose([-0.09, 0.006, -0.01], [0.01, 0.04, -0.01]),
        pose([0.085, -0.004, 0.012], [-0.008, -0.03, 0.015]),
    ];
    let scene = Scene::new(&Room::furnished(), middle_from_side, lens, [(1.0, 0.0); 2]);
    assert_good(&scene, &scene.estimate(None));
}

#[test]
fn a_rig_may_stand_upright() {
    let middle_from_side = [
        pose([0.0, -BASELINE_M, 0.0], [0.0; 3]),
        pose([0.0, BASELINE_M, 0.0], [0.0; 3]),
    ];
    let scene = Scene::new(
        &Room::furnished(),
        middle_from_side,
        CAMERA,
        [(1.0, 0.0); 2],
    );
    assert_good(&scene, &scene.estimate(None));
}

#[test]
fn another_exposure_on_either_side_changes_little() {
    let scene = Scene::new(
        &Room::furnished(),
        rectified(),
        CAMERA,
        [(1.25, -12.0), (0.8, 10.0)],
    );
    assert_good(&scene, &scene.estimate(None));
}

#[test]
fn a_new_thing_is_seen_where_a_wall_was_expected() {
    let empty = Scene::new(&Room::furnished(), rectified(), CAMERA, [(1.0, 0.0); 2]);
    let mut room = Room::furnished();
    let texture = Texture {
        seed: 71,
        mean: 110.0,
        contrast: 40.0,
        grain_m: 0.1,
    };
    room.things
        .push((Shape::Box([-1.0, -0.6, 2.4], [-0.3, 0.0, 2.8]), texture));
    let scene = Scene::new(&room, rectified(), CAMERA, [(1.0, 0.0); 2]);
    let map = scene.estimate(Some(&empty.middle.depth_m));
    let new: Vec<usize> = (0..CAMERA.pixels())
        .filter(|i| scene.middle.depth_m[*i] < 0.9 * empty.middle.depth_m[*i])
        .collect();
    assert!(
        new.len() > 3000,
        "the test shows a new thing: {} pixels",
        new.len()
    );
    let seen = new
        .iter()
        .filter(|i| {
            (map.inverse_depth[**i] - 1.0 / scene.middle.depth_m[**i]).abs() < 2.0 * map.label_step
        })
        .count();
    assert!(
        seen * 100 > new.len() * 97,
        "{seen} of {} pixels",
        new.len()
    );
    assert_good(&scene, &map);
}

#[test]
fn an_expectation_decides_where_the_images_do_not() {
    let mut room = Room::furnished();
    for (_, texture) in &mut room.things {
        texture.contrast = 0.0;
        texture.mean = 128.0;
    }
    let scene = Scene::new(&room, rectified(), CAMERA, [(1.0, 0.0); 2]);
    let (without, _) = scene.wrong(&scene.estimate(None));
    let (with, _) = scene.wrong(&scene.estimate(Some(&scene.middle.depth_m)));
    assert!(
        without > 20.0,
        "a room without texture says little: {without:.1} % wrong"
    );
    assert!(with < 5.0, "{with:.1} % wrong");
}

#[test]
fn an_expectation_changes_nothing_where_the_images_tell() {
    let scene = Scene::new(&Room::furnished(), rectified(), CAMERA, [(1.0, 0.0); 2]);
    let without = scene.estimate(None);
    // As a mistake that was remembered: everything a little nearer.
    let nearer: Vec<f32> = scene.middle.depth_m.iter().map(|z| 0.8 * z).collect();
    let with = scene.estimate(Some(&nearer));
    let mut told = 0;
    for pixel in 0..CAMERA.pixels() {
        if without.confidence[pixel] > 0.0 {
            told += 1;
            assert_eq!(with.depth_m[pixel], without.depth_m[pixel]);
        }
    }
    assert!(told * 100 > CAMERA.pixels() * 98, "{told} pixels");
}

#[test]
fn what_a_side_cannot_see_is_marked() {
    let scene = Scene::new(&Room::furnished(), rectified(), CAMERA, [(1.0, 0.0); 2]);
    let map = scene.estimate(None);
    let Intrinsics {
        width, height, fx, ..
    } = CAMERA;
    for (bit, sign) in [(SEEN_BY_LEFT, 1.0), (SEEN_BY_RIGHT, -1.0)] {
        let (mut right, mut hidden, mut said_hidden) = (0, 0, 0);
        for y in 0..height {
            let shift =
                |x: usize| sign * fx * BASELINE_M / f64::from(scene.middle.depth_m[y * width + x]);
            let place = |x: usize| x as f64 + shift(x);
            for x in 0..width {
                let covered = (0..width).any(|other| {
                    shift(other).abs() > shift(x).abs() + 1.5
                        && (place(other) - place(x)).abs() < 0.5
                });
                let truly = covered || place(x) < 0.0 || place(x) > width as f64 - 1.0;
                let said = map.seen_by[y * width + x] & bit == 0;
                hidden += usize::from(truly);
                said_hidden += usize::from(said);
                right += usize::from(truly && said);
            }
        }
        println!("{hidden} hidden, {said_hidden} said to be, {right} of them are");
        assert!(hidden > 1000 && right * 10 > hidden * 7 && right * 10 > said_hidden * 7);
    }
}

#[test]
fn nothing_is_said_where_no_side_looks() {
    let turned = pose([BASELINE_M, 0.0, 0.0], [0.0, 0.5, 0.0]);
    let mut scene = Scene::new(&Room::furnished(), [turned; 2], CAMERA, [(1.0, 0.0); 2]);
    scene.rig.left = None;
    let map = scene.estimate(None);
    let (mut said, mut pixels) = (0, 0);
    for y in 0..CAMERA.height {
        // Turned by 0.5 rad to the right, half of the left half is out of its sight.
        for x in 0..60 {
            said += usize::from(map.depth_m[y * CAMERA.width + x] > 0.0);
            pixels += 1;
        }
    }
    assert!(
        said * 100 <= pixels,
        "{said} of {pixels} pixels have a depth"
    );
}

#[test]
fn every_instruction_set_and_number_of_threads_sees_the_same() {
    let scene = Scene::new(
        &Room::furnished(),
        rectified(),
        CAMERA,
        [(1.1, 0.0), (1.0, 0.0)],
    );
    let expected_m = scene.middle.depth_m.clone();
    let all: Vec<DepthMap> = Isa::available()
        .flat_map(|isa| [(isa, 1), (isa, 2), (isa, 5)])
        .map(|(isa, threads)| {
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .unwrap();
            let mut estimator = DepthEstimator::with_isa(DepthSettings::default(), isa);
            pool.install(|| scene.estimate_with(&mut estimator, Some(&expected_m)))
        })
        .collect();
    assert!(all.windows(2).all(|pair| pair[0] == pair[1]));
}

#[test]
fn an_estimator_forgets_the_frame_before() {
    let scene = Scene::new(&Room::furnished(), rectified(), CAMERA, [(1.0, 0.0); 2]);
    let upright = [
        pose([0.0, -BASELINE_M, 0.0], [0.0; 3]),
        pose([0.0, BASELINE_M, 0.0], [0.0; 3]),
    ];
    let other = Scene::new(&Room::furnished(), upright, CAMERA, [(0.7, 0.0); 2]);
    let mut estimator = DepthEstimator::new(DepthSettings::default());
    let first = scene.estimate_with(&mut estimator, None);
    other.estimate_with(&mut estimator, None);
    assert!(scene.estimate_with(&mut estimator, None) == first);
}
