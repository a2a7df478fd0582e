//! What was there before is not surprising again, and a pixel without a past is scored as if pasts did not exist.

mod reference;

use reference::{
    Random,
    belief::{NormalGamma, Rules},
    isas,
    joint::{Joint, channels},
    pool,
};
use surprised::{
    config::Settings,
    engine::cpu::{CpuEngine, Observation, Score},
    model::belief::{Belief, CHANNELS},
    stages::{
        interpolate::prior::{self, Prior},
        surprise::{GammaTerm, joint_surprise, surprise},
        update::UpdateRules,
    },
};

fn belief(random: &mut Random, p2: f32) -> Belief {
    let colour = |random: &mut Random| {
        [
            random.uniform(0.0, 255.0) as f32,
            random.uniform(-80.0, 80.0) as f32,
            random.uniform(-80.0, 80.0) as f32,
        ]
    };
    let alpha = random.uniform(1.0, 2.5) as f32;
    Belief {
        alpha,
        beta: std::array::from_fn(|_| alpha * random.log_uniform(1.0, 400.0) as f32),
        tau: colour(random),
        sigma: std::array::from_fn(|_| random.log_uniform(0.05, 0.9) as f32),
        tau2: colour(random),
        p2,
    }
}

#[test]
fn the_engines_joint_surprise_is_exact() {
    let settings = Settings::robust();
    let rules = UpdateRules::new(&settings);
    let gamma = GammaTerm::new(&rules);
    let mut random = Random(1);
    for _ in 0..20_000 {
        let p2 = random.uniform(0.06, 0.95) as f32;
        let prior = belief(&mut random, p2);
        let blend = random.uniform(0.0, 1.0) as f32;
        let x = std::array::from_fn(|c| prior.tau[c] + blend * (prior.tau2[c] - prior.tau[c]));
        let surprise1 = surprise(&prior, &rules.belief(&prior, x), x, &gamma);
        let (got, rho2) = joint_surprise(&prior, x, surprise1, &rules, &gamma);

        let main = channels(&prior);
        let earlier: [NormalGamma; CHANNELS] = std::array::from_fn(|c| NormalGamma {
            alpha: prior.alpha.into(),
            beta: f64::from(prior.alpha) * 100.0,
            tau: prior.tau2[c].into(),
            sigma: 0.3,
        });
        let p = f64::from(prior.p2).clamp(0.45, 0.55);
        let weighted = [(1.0 - p, main), (p, earlier)];
        let joint = Joint::observe(weighted, x.map(f64::from), &Rules::new(&settings));
        let expected = joint.surprise();
        assert!(
            (f64::from(got) - expected).abs() <= 1e-4 * expected.max(0.01),
            "{got} nats are not {expected}: {prior:?} sees {x:?}"
        );
        assert!((f64::from(rho2) - joint.posterior[1].0).abs() < 1e-4);
    }
}

#[test]
fn coming_back_costs_at_most_the_odds_and_its_own_change() {
    let settings = Settings::robust();
    let rules = UpdateRules::new(&settings);
    let gamma = GammaTerm::new(&rules);
    let mut random = Random(2);
    for _ in 0..2000 {
        let mut prior = belief(&mut random, 0.5);
        // Two appearances that cannot be confused.
        prior.tau2[0] = if prior.tau[0] > 128.0 { 10.0 } else { 245.0 };
        prior.beta = [prior.alpha * 25.0; CHANNELS];
        prior.sigma = [0.1; CHANNELS];
        let x = prior.tau2;
        let alone = surprise(&prior, &rules.belief(&prior, x), x, &gamma);
        let (joint, rho2) = joint_surprise(&prior, x, alone, &rules, &gamma);
        let earlier = surprised::stages::surprise::earlier_belief(&prior);
        let own = surprise(&earlier, &rules.belief(&earlier, x), x, &gamma);
        assert!(alone > 6.0, "{alone}");
        assert!(joint <= own + (1.0f32 / 0.45).ln() + 1e-3, "{joint} {own}");
        assert!(rho2 > 0.99);
    }
}

#[test]
fn without_an_earlier_appearance_the_score_is_the_old_one_bit_for_bit() {
    let (width, height) = (97, 5);
    let mut random = Random(3);
    let mut prior = Prior::default();
    prior.resize(width, height);
    let mut observation = Observation {
        width,
        height,
        ..Observation::default()
    };
    let stride = width * prior::PLANES;
    for pixel in 0..width * height {
        let belief = belief(&mut random, 0.0);
        let row = &mut prior.data[pixel / width * stride..][..stride];
        prior::put(row, width, pixel % width, &belief, 1.0, 7.0);
        for (plane, tau) in observation.planes.iter_mut().zip(belief.tau) {
            plane.push(tau + random.uniform(-40.0, 40.0) as f32);
        }
    }
    let surprises = [true, false].map(|earlier_appearance| {
        let settings = Settings {
            earlier_appearance,
            ..Settings::robust()
        };
        let mut score = Score::default();
        CpuEngine::new(&settings, pool(1), isas()[0]).score(&prior, &observation, &mut score);
        score
            .surprise
            .iter()
            .map(|s| s.to_bits())
            .collect::<Vec<_>>()
    });
    assert_eq!(surprises[0], surprises[1]);
    assert!(surprises[0].iter().any(|&bits| f32::from_bits(bits) > 6.0));
}
