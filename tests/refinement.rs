//! A wrong pose is put right against what the memory expects; a hopeless one is left as it is.

mod reference;

use reference::{
    Random, isas, pool,
    room::{panel, room},
    scene::{Picture, Scene, camera, pose},
};
use surprised::{
    model::{
        camera::Intrinsics,
        pose::{Pose, PoseNoise},
        viewpoint::Viewpoint,
    },
    stages::refine::{PoseRefiner, Refined},
};

const SIZE: (usize, usize) = (320, 240);

struct Case {
    camera: Intrinsics,
    truth: Pose,
    views: Vec<Viewpoint>,
    picture: Picture,
}

fn case() -> Case {
    let camera = camera(SIZE.0, SIZE.1);
    let scene = room();
    let truth = pose([0.02, -0.05, 0.0], [-0.05, 0.03, 0.01]);
    let views = [[0.05, 0.0, 0.01], [-0.06, 0.02, -0.02], [0.0, -0.03, 0.05]]
        .map(|[x, y, z]| {
            let beside = pose([x, y, z], [0.3 * y, -0.4 * x, 0.2 * z]);
            scene.viewpoint(&camera, &(truth * beside))
        })
        .into();
    Case {
        picture: scene.picture(&camera, &truth),
        camera,
        truth,
        views,
    }
}

/// Luminance of a sensor that is 5 % brighter and has noise, perhaps with a dark object on 8 % of the image.
fn observed(picture: &Picture, object: bool, random: &mut Random) -> Vec<f32> {
    let (width, _) = SIZE;
    picture
        .colour
        .iter()
        .enumerate()
        .map(|(pixel, colour)| {
            let (x, y) = (pixel % width, pixel / width);
            let hidden = object && (120..198).contains(&x) && (90..170).contains(&y);
            let y = if hidden { 25.0 } else { colour[0] };
            (1.05 * y + 3.0 * random.normal()).round().clamp(0.0, 255.0) as f32
        })
        .collect()
}

fn refine(case: &Case, observed: &[f32], given: &Pose, noise: PoseNoise) -> Refined {
    refine_by(&mut PoseRefiner::default(), case, observed, given, noise)
}

fn refine_by(
    refiner: &mut PoseRefiner,
    case: &Case,
    observed: &[f32],
    given: &Pose,
    noise: PoseNoise,
) -> Refined {
    let views: Vec<_> = case
        .views
        .iter()
        .map(|view| (&view.coarse, &view.world_from_camera, 1.0))
        .collect();
    refiner.refine(&views, observed, &case.camera, given, noise)
}

/// Mean distance, pixels, between where a pose thinks that the scene is and where it is.
fn pixel_error(case: &Case, world_from_camera: &Pose) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0);
    for v in (4..SIZE.1).step_by(8) {
        for u in (4..SIZE.0).step_by(8) {
            let z = case.picture.depth_m[v * SIZE.0 + u];
            let point = case.camera.unproject(u as f64, v as f64, z.into());
            let seen = world_from_camera.inverse() * (case.truth * point);
            let (x, y) = case.camera.project(&seen).expect("it is in front");
            sum += (x - u as f64).hypot(y - v as f64);
            count += 1.0;
        }
    }
    sum / count
}

fn noise(millimetres: f64, degrees: f64) -> PoseNoise {
    PoseNoise {
        position_m: 1e-3 * millimetres,
        rotation_rad: degrees.to_radians(),
    }
}

/// Mean pixel errors of twelve draws before and after, and the largest after.
fn errors(case: &Case, noise: PoseNoise, object: bool) -> (f64, f64, f64) {
    let mut random = Random(5);
    let (mut before, mut after, mut worst) = (0.0, 0.0, 0.0f64);
    for _ in 0..12 {
        let image = observed(&case.picture, object, &mut random);
        let error = pose(
            std::array::from_fn(|_| noise.position_m * random.normal()),
            std::array::from_fn(|_| noise.rotation_rad * random.normal()),
        );
        let given = case.truth * error;
        let refined = refine(case, &image, &given, noise);
        let moved = given.inverse() * refined.world_from_camera;
        assert!((moved.translation.vector.norm() - refined.correction_m).abs() < 1e-9);
        assert!((moved.rotation.angle() - refined.correction_rad).abs() < 1e-7);
        before += pixel_error(case, &given) / 12.0;
        let error = pixel_error(case, &refined.world_from_camera);
        after += error / 12.0;
        worst = worst.max(error);
    }
    (before, after, worst)
}

#[test]
fn a_pose_ends_within_a_third_of_a_pixel_whatever_new_stands_there() {
    let case = case();
    for (millimetres, degrees) in [(1.0, 0.1), (3.0, 0.3), (10.0, 1.0)] {
        for object in [false, true] {
            let (before, after, worst) = errors(&case, noise(millimetres, degrees), object);
            println!(
                "{millimetres} mm {degrees} deg, object {object}: {before:.2} -> {after:.3} px (worst {worst:.3})"
            );
            assert!(after < 0.3, "{before} -> {after} px");
            assert!(after < 0.5 * before);
        }
    }
}

#[test]
fn another_place_is_refused_and_leaves_the_pose_as_it_was() {
    let case = case();
    let other = Scene {
        panels: vec![panel(77, [0.0, 0.0, 1.7], 0.4, 0.3, (5.0, 5.0))],
    };
    let picture = other.picture(&case.camera, &case.truth);
    let mut random = Random(3);
    let image = observed(&picture, false, &mut random);
    let noise_image: Vec<f32> = image
        .iter()
        .map(|_| random.uniform(0.0, 255.0) as f32)
        .collect();
    let flat = vec![120.0; image.len()];
    for (name, image) in [
        ("another scene", image),
        ("noise", noise_image),
        ("a wall", flat),
    ] {
        let refined = refine(&case, &image, &case.truth, noise(3.0, 0.3));
        let error = pixel_error(&case, &refined.world_from_camera);
        println!("{name}: {error:.2} px, {refined:?}");
        assert_eq!(refined, Refined::unchanged(case.truth), "{name}");
    }
}

#[test]
fn without_views_or_pixels_to_compare_the_pose_is_as_given() {
    let case = case();
    let image = observed(&case.picture, false, &mut Random(1));
    let given = case.truth * pose([0.003, 0.0, 0.0], [0.0; 3]);
    let nothing = Case {
        views: Vec::new(),
        ..case
    };
    assert_eq!(
        refine(&nothing, &image, &given, noise(3.0, 0.3)),
        Refined::unchanged(given)
    );
}

#[test]
fn the_number_of_threads_and_the_instruction_set_change_no_bit() {
    let case = case();
    let image = observed(&case.picture, true, &mut Random(9));
    let given = case.truth * pose([0.008, -0.006, 0.004], [0.01, 0.005, -0.012]);
    let mut refined = Vec::new();
    for isa in isas() {
        for threads in [1, 2, 5] {
            let mut refiner = PoseRefiner::new(pool(threads), isa);
            refined.push(refine_by(
                &mut refiner,
                &case,
                &image,
                &given,
                noise(10.0, 1.0),
            ));
        }
    }
    assert!(refined[0].correction_m > 0.0, "it was refined");
    assert!(refined.windows(2).all(|pair| pair[0] == pair[1]));
}
