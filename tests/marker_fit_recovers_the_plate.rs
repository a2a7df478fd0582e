//! The pose from tracked LEDs is exact without noise, as uncertain as theory says with it, and refused where the LEDs
//! do not determine it.

use nalgebra::{Matrix3, Point3, UnitQuaternion, Vector3};
use surprised::{
    model::pose::Pose,
    simulation::random::Stream,
    stages::localise::{LocaliseError, TOLERANCE_M, fit_plate},
};

const SIZE: (f64, f64) = (0.22, 0.16);

fn plate() -> Vec<Point3<f64>> {
    let (width, depth) = SIZE;
    vec![
        Point3::new(0.0, 0.0, 0.0),
        Point3::new(width, 0.0, 0.0),
        Point3::new(width, -depth, 0.0),
        Point3::new(0.0, -depth, 0.0),
    ]
}

fn normal3(stream: &mut Stream, sd: f64) -> Vector3<f64> {
    Vector3::new(stream.normal(), stream.normal(), stream.normal()) * sd
}

fn random_pose(stream: &mut Stream) -> Pose {
    Pose::from_parts(
        normal3(stream, 2.0).into(),
        UnitQuaternion::from_scaled_axis(normal3(stream, 1.2)),
    )
}

fn seen(plate: &[Point3<f64>], pose: &Pose) -> Vec<Option<Point3<f64>>> {
    plate.iter().map(|marker| Some(pose * marker)).collect()
}

/// Metres and radians between two poses.
fn apart(a: &Pose, b: &Pose) -> (f64, f64) {
    (
        (a.translation.vector - b.translation.vector).norm(),
        a.rotation.angle_to(&b.rotation),
    )
}

#[test]
fn exact_markers_give_the_exact_pose() {
    let mut stream = Stream::new(1, &[]);
    for _ in 0..1000 {
        let pose = random_pose(&mut stream);
        let fit = fit_plate(&plate(), &seen(&plate(), &pose), TOLERANCE_M).unwrap();
        let (metres, radians) = apart(&fit.world_from_plate, &pose);
        assert!(
            metres < 1e-12 && radians < 1e-7,
            "{metres} m, {radians} rad"
        );
        assert!(fit.residual_m < 1e-12);
        assert_eq!(fit.recovered, None);
    }
}

#[test]
fn one_missing_marker_is_recovered_and_two_refuse_the_frame() {
    let mut stream = Stream::new(2, &[]);
    for missing in 0..4 {
        let pose = random_pose(&mut stream);
        let mut markers = seen(&plate(), &pose);
        markers[missing] = None;
        let fit = fit_plate(&plate(), &markers, TOLERANCE_M).unwrap();
        let (metres, radians) = apart(&fit.world_from_plate, &pose);
        assert!(metres < 1e-12 && radians < 1e-7);
        assert_eq!(fit.recovered, Some(missing));
        markers[(missing + 1) % 4] = None;
        assert_eq!(
            fit_plate(&plate(), &markers, TOLERANCE_M),
            Err(LocaliseError::TooFew { visible: 2 })
        );
    }
}

/// First order: with noise of standard deviation s on every coordinate, the rotation error has covariance
/// s^2 (sum |r|^2 I - r r^T)^-1 over the markers r about their centroid, and a point at lever arm p from the centroid
/// s^2 / n I + [p] C [p]^T.
#[test]
fn noise_spreads_rotation_and_translation_as_theory_says() {
    const TRIALS: usize = 10_000;
    const NOISE_M: f64 = 0.3e-3;
    let plate = plate();
    let center = plate.iter().map(|m| m.coords).sum::<Vector3<f64>>() / plate.len() as f64;
    let inertia: Matrix3<f64> = plate
        .iter()
        .map(|marker| {
            let r = marker.coords - center;
            Matrix3::identity() * r.norm_squared() - r * r.transpose()
        })
        .sum();
    let rotation_theory = inertia.try_inverse().unwrap() * (NOISE_M * NOISE_M);
    let lever = (-center).cross_matrix();
    let translation_theory = Matrix3::identity() * (NOISE_M * NOISE_M / plate.len() as f64)
        + lever * rotation_theory * lever.transpose();

    let mut stream = Stream::new(3, &[]);
    let (mut rotation, mut translation) = (Matrix3::zeros(), Matrix3::zeros());
    let (mut rotation_mean, mut translation_mean) = (Vector3::zeros(), Vector3::zeros());
    for _ in 0..TRIALS {
        let pose = random_pose(&mut stream);
        let markers: Vec<_> = plate
            .iter()
            .map(|marker| Some(pose * marker + normal3(&mut stream, NOISE_M)))
            .collect();
        let fit = fit_plate(&plate, &markers, TOLERANCE_M).unwrap();
        assert_eq!(fit.recovered, None, "noise alone is no outlier");
        // In the plate's own axes, where the theory is written.
        let error = pose.inverse() * fit.world_from_plate;
        let turn = error.rotation.scaled_axis();
        let shift = error.translation.vector;
        rotation += turn * turn.transpose() / TRIALS as f64;
        translation += shift * shift.transpose() / TRIALS as f64;
        rotation_mean += turn / TRIALS as f64;
        translation_mean += shift / TRIALS as f64;
    }
    // The standard error of a variance from n samples is sqrt(2/n) = 1.4 %; five of them.
    for (measured, theory, mean) in [
        (rotation, rotation_theory, rotation_mean),
        (translation, translation_theory, translation_mean),
    ] {
        for i in 0..3 {
            for j in 0..3 {
                let scale = (theory[(i, i)] * theory[(j, j)]).sqrt();
                let off = (measured[(i, j)] - theory[(i, j)]).abs() / scale;
                assert!(off < 0.07, "({i}, {j}): {measured} instead of {theory}");
            }
            assert!(mean[i].abs() < 5.0 * (theory[(i, i)] / TRIALS as f64).sqrt());
        }
        println!("measured {measured:.3e} theory {theory:.3e}");
    }
}

#[test]
fn one_marker_five_centimetres_off_is_found() {
    const TRIALS: usize = 2000;
    let plate = plate();
    let mut stream = Stream::new(4, &[]);
    let mut found = 0;
    for trial in 0..TRIALS {
        let pose = random_pose(&mut stream);
        let wrong = trial % 4;
        let away = normal3(&mut stream, 1.0).normalize() * 0.05;
        let markers: Vec<_> = plate
            .iter()
            .enumerate()
            .map(|(index, marker)| {
                let off = if index == wrong {
                    away
                } else {
                    Vector3::zeros()
                };
                Some(pose * marker + normal3(&mut stream, 0.3e-3) + off)
            })
            .collect();
        let Ok(fit) = fit_plate(&plate, &markers, TOLERANCE_M) else {
            continue;
        };
        if fit.recovered == Some(wrong) {
            found += 1;
            let (metres, radians) = apart(&fit.world_from_plate, &pose);
            assert!(metres < 3e-3 && radians < 0.02, "{metres} m, {radians} rad");
        }
    }
    println!("found {found} of {TRIALS}");
    assert!(found >= TRIALS * 99 / 100, "found {found} of {TRIALS}");
}

#[test]
fn markers_on_a_line_are_refused() {
    let line: Vec<_> = (0..4)
        .map(|i| Point3::new(0.07 * f64::from(i), 0.001, 0.0))
        .collect();
    let pose = random_pose(&mut Stream::new(5, &[]));
    assert_eq!(
        fit_plate(&line, &seen(&line, &pose), TOLERANCE_M),
        Err(LocaliseError::Collinear)
    );
}

#[test]
fn a_mirror_image_is_refused() {
    let pose = random_pose(&mut Stream::new(6, &[]));
    // One LED stands on a post, so that the plate differs from its mirror image.
    let mut raised = plate();
    raised[2].z = 0.03;
    let mirrored: Vec<_> = raised
        .iter()
        .map(|marker| Some(pose * Point3::new(-marker.x, marker.y, marker.z)))
        .collect();
    assert_eq!(
        fit_plate(&raised, &mirrored, TOLERANCE_M),
        Err(LocaliseError::Mirrored)
    );
    // Of a flat plate: two neighbours exchanged.
    let mut exchanged = seen(&plate(), &pose);
    exchanged.swap(0, 1);
    assert!(matches!(
        fit_plate(&plate(), &exchanged, TOLERANCE_M),
        Err(LocaliseError::Inconsistent { .. })
    ));
}

#[test]
fn nonsense_is_an_error_and_no_panic() {
    let pose = random_pose(&mut Stream::new(7, &[]));
    let mut markers = seen(&plate(), &pose);
    markers[1] = Some(Point3::new(f64::NAN, 0.0, 0.0));
    assert_eq!(
        fit_plate(&plate(), &markers, TOLERANCE_M),
        Err(LocaliseError::NotFinite)
    );
    assert_eq!(
        fit_plate(&plate(), &markers[..3], TOLERANCE_M),
        Err(LocaliseError::Count {
            expected: 4,
            got: 3
        })
    );
    assert_eq!(
        fit_plate(&[], &[], TOLERANCE_M),
        Err(LocaliseError::TooFew { visible: 0 })
    );
    let same = vec![Some(Point3::origin()); 4];
    assert_eq!(
        fit_plate(&plate(), &same, TOLERANCE_M),
        Err(LocaliseError::Collinear)
    );
}
