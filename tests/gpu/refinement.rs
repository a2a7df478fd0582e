//! Poses that the card refines are those that the processor refines, and both refuse the same.

use std::io::Write;

use surprised::{
    config::{Evidence, Settings},
    engine::{
        Answer, Engine, Question,
        cpu::{Observation, RecallView, Score},
    },
    model::{
        belief::rgb_from_ycbcr,
        camera::Intrinsics,
        frame::RgbImage,
        pose::{Pose, PoseNoise},
        viewpoint::Viewpoint,
    },
    stages::{
        attend::BlockMap,
        interpolate::prior::Prior,
        refine::{PoseRefiner, Refined},
    },
};

use super::{
    counters, gpu, processor,
    reference::{
        Random,
        room::{panel, room},
        scene::{Scene, camera, pose, viewpoint},
    },
};

struct Case {
    camera: Intrinsics,
    truth: Pose,
    views: Vec<Viewpoint>,
    image: RgbImage,
}

/// Seen from beside, with holes, by cameras of other sizes; the image brighter, noisy, and with something dark in it.
fn case(size: (usize, usize), id: u64, random: &mut Random) -> Case {
    let scene = room();
    let camera = camera(size.0, size.1);
    let truth = pose([0.02, -0.05, 0.0], [-0.05, 0.03, 0.01]);
    let besides = [[0.05, 0.0, 0.01], [-0.06, 0.02, -0.02], [0.0, -0.03, 0.05]];
    let views = besides.into_iter().zip(0..).map(|([x, y, z], number)| {
        let beside = pose([x, y, z], [0.3 * y, -0.4 * x, 0.2 * z]);
        // One of them odd.
        let odd = usize::from(number == 1);
        let own = super::camera(size.0 + odd, size.1 + odd);
        let whole = scene.viewpoint(&own, &(truth * beside));
        let mut depth_m = whole.mesh.depth_m;
        for _ in 0..depth_m.len() / 60 {
            let hole = random.below(depth_m.len());
            depth_m[hole] = 0.0;
        }
        Viewpoint {
            id: 10 * id + number,
            ..viewpoint(own, &whole.world_from_camera, depth_m, whole.records)
        }
    });
    let views = views.collect();
    let (width, height) = size;
    let picture = scene.picture(&camera, &truth);
    let data = picture
        .colour
        .iter()
        .enumerate()
        .flat_map(|(pixel, colour)| {
            let (x, y) = (pixel % width, pixel / width);
            let hidden = 3 * x > width && 2 * x < width && 3 * y > height && 3 * y < 2 * height;
            let level = if hidden { 25.0 } else { colour[0] };
            rgb_from_ycbcr([(1.05 * level + 3.0 * random.normal()) as f32, 0.0, 0.0])
        });
    Case {
        camera,
        truth,
        views,
        image: RgbImage {
            width,
            height,
            data: data.collect(),
        },
    }
}

fn refine(
    engine: &mut Engine,
    case: &Case,
    count: usize,
    given: &Pose,
    noise: PoseNoise,
) -> Refined {
    let views: Vec<RecallView> = case.views[..count]
        .iter()
        .zip([1.0, 0.4, 1.0])
        .map(|(viewpoint, weight)| RecallView {
            viewpoint,
            weight,
            fresh: weight < 1.0,
        })
        .collect();
    let question = Question {
        views: &views,
        intrinsics: &case.camera,
        world_from_camera: given,
        noise: Some(noise),
        image: &case.image,
        observation: &Observation::default(),
    };
    let answer = Answer {
        prior: &mut Prior::default(),
        score: &mut Score::default(),
        evidence: &mut BlockMap::default(),
        blocks: &mut BlockMap::default(),
        refiner: &mut PoseRefiner::default(),
    };
    let compared = engine.compare(&question, Evidence::BlockMedian, false, answer, &mut || {});
    compared.expect("the device is there").refined
}

fn noise(millimetres: f64, degrees: f64) -> PoseNoise {
    PoseNoise {
        position_m: 1e-3 * millimetres,
        rotation_rad: degrees.to_radians(),
    }
}

/// Mean distance, pixels of this case's camera, between where two poses see what lies 1.5 m before them.
fn pixels_between(case: &Case, a: &Pose, b: &Pose) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0);
    for v in (0..case.camera.height).step_by(4) {
        for u in (0..case.camera.width).step_by(4) {
            let point = case.camera.unproject(u as f64, v as f64, 1.5);
            let (x, y) = case
                .camera
                .project(&(b.inverse() * (a * point)))
                .expect("it is in front");
            sum += (x - u as f64).hypot(y - v as f64);
            count += 1.0;
        }
    }
    sum / count
}

#[test]
fn the_refined_pose_is_that_of_the_processor_to_a_fiftieth_of_a_pixel() {
    let settings = Settings::robust();
    let Some(mut card) = gpu(&settings) else {
        return;
    };
    let mut cpu = processor().engine(&settings);
    let mut random = Random(9);
    let (mut moved, mut worst, mut compared) = (0, 0.0f64, 0);
    for (id, size) in (1..).zip([(320, 240), (165, 123), (97, 75), (64, 48), (17, 16)]) {
        let case = case(size, id, &mut random);
        for (count, noise) in [
            (3, noise(1.0, 0.1)),
            (3, noise(3.0, 0.3)),
            (3, noise(10.0, 1.0)),
            (2, noise(3.0, 0.3)),
            (1, noise(5.0, 0.5)),
            (0, noise(5.0, 0.5)),
        ] {
            let error = pose(
                std::array::from_fn(|_| noise.position_m * random.normal()),
                std::array::from_fn(|_| noise.rotation_rad * random.normal()),
            );
            let given = case.truth * error;
            let got = refine(&mut card, &case, count, &given, noise);
            let expected = refine(&mut cpu, &case, count, &given, noise);
            let unchanged = Refined::unchanged(given);
            assert_eq!(
                got == unchanged,
                expected == unchanged,
                "{size:?}, {count} views"
            );
            let apart = pixels_between(&case, &got.world_from_camera, &expected.world_from_camera);
            let of_truth = pixels_between(&case, &got.world_from_camera, &case.truth);
            writeln!(
                std::io::stderr(),
                "{size:?}, {count} views, {noise:?}: {apart:.5} px apart, {of_truth:.3} px of the truth"
            )
            .unwrap();
            assert!(apart < 0.02, "{size:?}, {count} views: {apart} px apart");
            assert!((got.correction_m - expected.correction_m).abs() < 2e-4);
            assert!((got.correction_rad - expected.correction_rad).abs() < 2e-4);
            moved += usize::from(got != unchanged);
            worst = worst.max(apart);
            compared += 1;
        }
    }
    writeln!(
        std::io::stderr(),
        "{moved} of {compared} moved, at most {worst:.5} px apart"
    )
    .unwrap();
    assert!(moved >= 15, "only {moved} poses were refined");
    assert_eq!(counters(&card).on_processor, 0);
    assert_eq!(counters(&card).losses, 0);
}

#[test]
fn another_place_is_refused_on_the_card_too() {
    let settings = Settings::robust();
    let Some(mut card) = gpu(&settings) else {
        return;
    };
    let mut case = case((160, 120), 1, &mut Random(4));
    let other = Scene {
        panels: vec![panel(77, [0.0, 0.0, 1.7], 0.4, 0.3, (5.0, 5.0))],
    };
    let picture = other.picture(&case.camera, &case.truth);
    let of_other = picture
        .colour
        .iter()
        .flat_map(|c| rgb_from_ycbcr([c[0] as f32, 0.0, 0.0]));
    for (name, data) in [
        ("another scene", of_other.collect()),
        ("a wall", vec![120; 3 * case.camera.pixels()]),
    ] {
        case.image.data = data;
        let refined = refine(&mut card, &case, 3, &case.truth, noise(3.0, 0.3));
        assert_eq!(refined, Refined::unchanged(case.truth), "{name}");
    }
}
