//! The engine's posterior and surprise are those of the paper, for all that can be believed and observed.

mod reference;

use reference::{
    Random, isas,
    joint::{self, any_belief, any_observation, assert_stored, assert_surprise, edge},
    pool,
};
use surprised::{
    config::{Preset, Settings},
    engine::cpu::{CpuEngine, Observation, Score},
    model::belief::Belief,
    stages::{
        interpolate::prior::{self, Prior},
        surprise::{GammaTerm, surprise},
        update::UpdateRules,
    },
};

const PRESETS: [Preset; 2] = [Preset::Paper, Preset::Robust];

fn assert_posterior(got: &Belief, expected: &joint::Scored, size: [f32; 3], context: &str) {
    let near = |got: f32, expected: f64, size: f64| {
        let error = (f64::from(got) - expected).abs();
        assert!(error <= 1e-5 * size, "{got} is not {expected}: {context}");
    };
    near(got.alpha, expected.alpha, expected.alpha);
    for (c, size) in size.into_iter().enumerate() {
        near(got.beta[c], expected.beta[c], expected.beta[c]);
        near(got.sigma[c], expected.sigma[c], expected.sigma[c]);
        // Of what it is made of: between red and green grey is a small number.
        near(got.tau[c], expected.tau[c], size.into());
    }
}

#[test]
fn a_pixel_has_the_papers_posterior_and_surprise() {
    let mut worst = 0.0f64;
    for preset in PRESETS {
        for forgetting in [0.5, 0.6, 0.7, 0.8, 0.9] {
            let settings = Settings {
                forgetting,
                edge_error_px: 0.0,
                ..Settings::preset(preset)
            };
            let rules = UpdateRules::new(&settings);
            let gamma = GammaTerm::new(&rules);
            let mut random = Random(1);
            for _ in 0..40_000 {
                let prior = any_belief(&mut random, &rules);
                let x = any_observation(&mut random, &prior);
                let posterior = rules.belief(&prior, x);
                let one = Settings {
                    earlier_appearance: false,
                    ..settings.clone()
                };
                let expected = joint::score(&prior, 1.0, [0.0; 3], x.map(f64::from), &one);
                let context = format!("{preset:?} {prior:?} sees {x:?}");
                let size = std::array::from_fn(|c| prior.tau[c].abs().max(x[c].abs()));
                assert_posterior(&posterior, &expected, size, &context);
                let got = surprise(&prior, &posterior, x, &gamma);
                worst = worst.max(assert_surprise(got, expected.surprise, &context));
                assert!(got >= 0.0);
            }
        }
    }
    println!("surprise within {worst:.1e} of itself");
}

struct Fabricated {
    prior: Prior,
    observation: Observation,
}

const SIZE: (usize, usize) = (211, 67);

fn fabricated(random: &mut Random, rules: &UpdateRules, smooth: bool) -> Fabricated {
    let (width, height) = SIZE;
    let mut prior = Prior::default();
    prior.resize(width, height);
    let mut observation = Observation {
        width,
        height,
        ..Observation::default()
    };
    let stride = width * prior::PLANES;
    for y in 0..height {
        for x in 0..width {
            let mut belief = any_belief(random, rules);
            if smooth {
                let (x, y) = (x as f32, y as f32);
                belief.tau = [90.0 + 0.5 * x + 0.3 * y, 0.2 * x - 20.0, 10.0 - 0.4 * y];
            }
            if random.below(3) == 0 {
                belief.p2 = random.uniform(0.0, 0.95) as f32;
            }
            let observed = if random.below(3) == 0 {
                belief.tau2
            } else {
                any_observation(random, &belief)
            };
            let coverage = random.below(8) as f32;
            let row = &mut prior.data[y * stride..][..stride];
            prior::put(row, width, x, &belief, 1.0, coverage);
            for (plane, value) in observation.planes.iter_mut().zip(observed) {
                plane.push(value);
            }
        }
    }
    Fabricated { prior, observation }
}

#[test]
fn the_engine_scores_an_image_as_the_paper_and_the_robust_steps_say() {
    let mut exchanged = 0;
    let mut worst = 0.0f64;
    for preset in PRESETS {
        for smooth in [false, true] {
            let settings = Settings::preset(preset);
            let rules = UpdateRules::new(&settings);
            let mut random = Random(7);
            let Fabricated {
                prior,
                mut observation,
            } = fabricated(&mut random, &rules, smooth);
            // A longer exposure; the robust preset takes it back.
            for plane in &mut observation.planes {
                plane.iter_mut().for_each(|value| *value *= 1.07);
            }
            let mut score = Score::default();
            let engine = CpuEngine::new(&settings, pool(2), isas()[0]);
            engine.score(&prior, &observation, &mut score);
            assert_eq!(settings.exposure_gain, score.gain != 1.0);
            let inverse_gain = 1.0 / score.gain;
            for y in 0..SIZE.1 {
                for x in 0..SIZE.0 {
                    let pixel = y * SIZE.0 + x;
                    let belief = prior.belief(x, y);
                    let observed: [f32; 3] =
                        std::array::from_fn(|c| observation.planes[c][pixel] * inverse_gain);
                    let coverage = f64::from(prior.row(y).plane(prior::COVERAGE)[x]);
                    let expected = joint::score(
                        &belief,
                        coverage,
                        std::array::from_fn(|c| edge(&prior, x, y, c)),
                        observed.map(f64::from),
                        &settings,
                    );
                    let context = format!("{preset:?} ({x}, {y}) {belief:?} sees {observed:?}");
                    let error = assert_surprise(score.surprise[pixel], expected.surprise, &context);
                    worst = worst.max(error);
                    // On a threshold either decision is right.
                    let threshold = f64::from(settings.surprise_threshold);
                    let decided = (expected.surprise - threshold).abs() > 0.01
                        && (expected.rho2 - 0.5).abs() > 1e-3
                        && (expected.p2 - 0.05).abs() > 1e-3;
                    if decided {
                        let got = score.posterior[pixel].unpack();
                        assert_stored(&got, &expected, &context);
                    }
                    exchanged += usize::from(expected.rho2 > 0.5);
                }
            }
        }
    }
    println!("surprise of an image within {worst:.1e} of itself");
    assert!(exchanged > 1000, "only {exchanged} appearances came back");
}

#[test]
fn every_instruction_set_and_number_of_threads_gives_the_same_bits() {
    for preset in PRESETS {
        let settings = Settings::preset(preset);
        let rules = UpdateRules::new(&settings);
        let Fabricated { prior, observation } = fabricated(&mut Random(3), &rules, true);
        let mut scores = Vec::new();
        for isa in isas() {
            for threads in [1, 3] {
                let mut score = Score::default();
                let engine = CpuEngine::new(&settings, pool(threads), isa);
                engine.score(&prior, &observation, &mut score);
                let bits: Vec<u32> = score.surprise.iter().map(|s| s.to_bits()).collect();
                scores.push((bits, score.posterior, score.gain.to_bits()));
            }
        }
        assert!(
            scores.windows(2).all(|pair| pair[0] == pair[1]),
            "{preset:?}"
        );
    }
}

#[test]
fn a_belief_that_did_not_change_is_no_surprise() {
    for forgetting in [0.5f32, 0.6, 0.7, 0.8, 0.9] {
        let settings = Settings {
            forgetting,
            ..Settings::paper()
        };
        let rules = UpdateRules::new(&settings);
        let gamma = GammaTerm::new(&rules);
        // Where alpha stays what it is.
        let alpha = 0.5 / (1.0 - forgetting);
        let mut random = Random(5);
        for _ in 0..10_000 {
            let belief = Belief {
                alpha,
                ..any_belief(&mut random, &rules)
            };
            let got = surprise(&belief, &belief, belief.tau, &gamma);
            assert!(got < 2e-6, "{got} nats: {belief:?}");
        }
    }
}
