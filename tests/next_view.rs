//! What an observation promises is what it brings on average, and the most uncertain place is looked at first.

mod reference;

use nalgebra::{Point3, Vector3};
use reference::{
    Random,
    belief::{NormalGamma, Rules},
    pool,
    scene::{Panel, Scene, camera, pose},
};
use surprised::{
    config::{Preset, Settings},
    model::belief::{Belief, CHANNELS},
    pipeline::Pipeline,
    stages::{
        interpolate::prior::{Prior, put},
        next_view::{promise, ring, seen_reduction, unseen_reduction},
        update::UpdateRules,
    },
};

const UNKNOWN_VARIANCE: f64 = 255.0 * 255.0 / 12.0;

/// The predictive variance before the next observation: beta/alpha (1 + sigma_p), by (10) and (11).
fn predictive(rules: &Rules, belief: &NormalGamma, grown: bool) -> f64 {
    let variance = belief.beta / belief.alpha;
    let sigma = if grown {
        (belief.sigma * (rules.xi * variance).min(80.0).exp())
            .max(rules.sigma_min)
            .min(rules.sigma_max)
    } else {
        belief.sigma
    };
    variance * (1.0 + sigma)
}

/// What is left of it, on average over observations with the expected variance: Simpson's rule over eight deviations.
fn mean_after(rules: &Rules, belief: &NormalGamma) -> f64 {
    let sd = predictive(rules, belief, true).sqrt();
    let steps = 2000;
    let (mut sum, mut mass) = (0.0, 0.0);
    for step in 0..=steps {
        let z = -8.0 + 16.0 * f64::from(step) / f64::from(steps);
        let weight = match step {
            0 => 1.0,
            _ if step == steps => 1.0,
            _ if step % 2 == 1 => 4.0,
            _ => 2.0,
        } * (-0.5 * z * z).exp();
        let posterior = rules.posterior(belief, belief.tau + z * sd);
        sum += weight * predictive(rules, &posterior, false);
        mass += weight;
    }
    sum / mass
}

fn random_belief(random: &mut Random) -> NormalGamma {
    let alpha = random.uniform(1.0, 2.5);
    NormalGamma {
        alpha,
        beta: alpha * random.log_uniform(0.5, 2000.0),
        tau: random.uniform(0.0, 255.0),
        sigma: random.log_uniform(0.05, 1.0),
    }
}

#[test]
fn a_seen_pixel_promises_what_the_average_observation_brings() {
    // Without the second look the closed form is exact.
    let settings = Settings {
        second_look: false,
        ..Settings::robust()
    };
    let (rules, plain) = (UpdateRules::new(&settings), Rules::new(&settings));
    let mut random = Random(7);
    for _ in 0..200 {
        let beliefs: [NormalGamma; CHANNELS] = std::array::from_fn(|_| random_belief(&mut random));
        let alpha = beliefs[0].alpha;
        let beliefs = beliefs.map(|belief| NormalGamma {
            beta: belief.beta / belief.alpha * alpha,
            alpha,
            ..belief
        });
        let expected: f64 = beliefs
            .iter()
            .map(|belief| predictive(&plain, belief, true) - mean_after(&plain, belief))
            .sum();
        let found = seen_reduction(
            &rules,
            alpha as f32,
            beliefs.map(|belief| belief.beta as f32),
            beliefs.map(|belief| belief.sigma as f32),
        );
        assert!(
            (f64::from(found) - expected).abs() <= 1e-3 * expected + 1e-3,
            "{found} is promised, {expected} comes of {beliefs:?}"
        );
    }
}

#[test]
fn the_uncertain_promises_more_than_the_settled_and_the_unseen_most() {
    for preset in [Preset::Paper, Preset::Robust] {
        let rules = UpdateRules::new(&Settings::preset(preset));
        let of = |variance: f32| seen_reduction(&rules, 2.5, [2.5 * variance; 3], [0.1; 3]);
        let rising: Vec<f32> = [1.0, 10.0, 100.0, 1000.0].map(of).to_vec();
        assert!(rising.is_sorted() && rising[0] < 0.1, "{rising:?}");
        assert!(rising[3] < unseen_reduction(&rules), "{rising:?}");
    }
}

#[test]
fn an_unseen_pixel_promises_all_but_what_its_first_observation_leaves_open() {
    let rules = UpdateRules::new(&Settings::robust());
    // It starts with a variance of 100 and sigma 0.8.
    let expected = 3.0 * (UNKNOWN_VARIANCE - 100.0 * 1.8);
    assert!((f64::from(unseen_reduction(&rules)) - expected).abs() < 0.1);
}

#[test]
fn a_promise_sums_its_pixels_and_bounds_each_by_an_unseen_one() {
    let rules = UpdateRules::new(&Settings::robust());
    let mut prior = Prior::default();
    let (width, height) = (5, 4);
    prior.resize(width, height);
    let mut random = Random(3);
    let (mut reduction, mut uncertainty, mut seen) = (0.0, 0.0, 0);
    let unseen = f64::from(unseen_reduction(&rules));
    for y in 0..height {
        for x in 0..width {
            let variance = random.log_uniform(1.0, 30_000.0) as f32;
            let belief = Belief {
                alpha: 2.0,
                beta: [2.0 * variance; CHANNELS],
                sigma: [0.3; CHANNELS],
                ..Belief::default()
            };
            let covered = (x + y) % 3 != 0;
            let row = &mut prior.data[y * width * 16..][..width * 16];
            put(row, width, x, &belief, 1.0, f32::from(u8::from(covered)));
            if covered {
                seen += 1;
                let of_pixel = seen_reduction(&rules, 2.0, belief.beta, belief.sigma);
                reduction += f64::from(of_pixel).min(unseen);
                uncertainty += 3.0 * f64::from(variance);
            } else {
                reduction += unseen;
            }
        }
    }
    let found = promise(&prior, &rules);
    let pixels = (width * height) as f64;
    let close = |a: f64, b: f64| (a - b).abs() <= 1e-5 * b.abs();
    assert!(close(found.reduction, reduction / pixels), "{found:?}");
    let of_unseen = (pixels - f64::from(seen)) * unseen / pixels;
    assert!(close(found.reduction_unseen, of_unseen), "{found:?}");
    assert!(
        close(found.uncertainty, uncertainty / f64::from(seen)),
        "{found:?}"
    );
    assert_eq!(found.covered, f64::from(seen) / pixels);
}

#[test]
fn a_ring_turns_to_the_right_and_steps_ahead() {
    let around = pose([1.0, 2.0, 3.0], [0.0, 0.5, 0.0]);
    let poses = ring(&around, 0.4, 4);
    for (index, here) in poses.iter().enumerate() {
        let step = around.inverse_transform_point(&Point3::from(here.translation.vector));
        let expected = [
            Point3::new(0.0, 0.0, 0.4),
            Point3::new(0.4, 0.0, 0.0),
            Point3::new(0.0, 0.0, -0.4),
            Point3::new(-0.4, 0.0, 0.0),
        ][index];
        assert!((step - expected).norm() < 1e-12, "{index}: {step}");
        let ahead = around.inverse_transform_vector(&(here.rotation * Vector3::z()));
        assert!(
            (ahead - expected.coords / 0.4).norm() < 1e-12,
            "it looks where it goes"
        );
    }
    assert_eq!(ring(&around, 0.0, 1), [around]);
}

#[test]
fn a_robot_is_sent_where_it_knows_least() {
    // A wall that is known on the left; on the right it was seen once, and it flickered there.
    let wall = |phase: f64| Scene {
        panels: vec![Panel {
            center: Point3::new(0.0, 0.0, 2.0),
            right: Vector3::x(),
            down: Vector3::y(),
            half_size_m: (3.0, 2.0),
            texture: Box::new(move |a, b| {
                let flicker = if a > 0.8 { 40.0 * phase } else { 0.0 };
                [
                    120.0 + 30.0 * (9.0 * a).sin() * (8.0 * b).cos() + flicker,
                    0.0,
                    0.0,
                ]
            }),
        }],
    };
    let settings = Settings {
        refine_pose: false,
        exposure_gain: false,
        ..Settings::robust()
    };
    let mut pipeline = Pipeline::new(settings, pool(1));
    let lens = camera(64, 48);
    let at = |x: f64| pose([x, 0.0, 0.0], [0.0; 3]);
    for sequence in 0..24u64 {
        let phase = if sequence % 2 == 0 { 1.0 } else { -1.0 };
        for (number, x) in [-0.6, 0.6].into_iter().enumerate() {
            let frame = wall(phase).frame(&lens, &at(x), 2 * sequence + number as u64);
            pipeline.process(&frame).expect("the frame is good");
        }
    }
    let known = pipeline.promise(&lens, &at(-0.6));
    let flickering = pipeline.promise(&lens, &at(0.6));
    let unseen = pipeline.promise(&lens, &pose([0.0, 0.0, 0.0], [0.0, 3.0, 0.0]));
    assert!(known.covered > 0.9 && flickering.covered > 0.9);
    assert!(
        flickering.reduction - flickering.reduction_unseen
            > 5.0 * (known.reduction - known.reduction_unseen),
        "{flickering:?} beside {known:?}"
    );
    assert_eq!(unseen.covered, 0.0);
    assert!(unseen.reduction > flickering.reduction);
}
