//! Beliefs may be stored in 32 bytes: the rounding does not change what is surprising.

mod reference;

use reference::Random;
use surprised::{
    config::{Preset, Settings},
    model::belief::{Belief, CHANNELS, Record},
    stages::{
        surprise::{GammaTerm, surprise},
        update::UpdateRules,
    },
};

const PIXELS: usize = 4000;
const FRAMES: usize = 400;
/// Frames until the start is forgotten.
const SETTLED: usize = 100;
/// Share of the mean surprise; levels of an eighth, as f16 has them at 200, change it by 8 %.
const DIFFERENCE_MAX: f64 = 0.01;
const NOISE_SD: f64 = 1.5;

/// Mean surprise of exact beliefs and of stored ones that see the same, and the mean size of their difference, nats.
fn surprises(settings: &Settings, grey: f32) -> (f64, f64, f64) {
    let rules = UpdateRules::new(settings);
    let gamma = GammaTerm::new(&rules);
    let mut random = Random(11);
    let level = [grey, 20.3, -35.7];
    let start = Belief {
        alpha: 1.3,
        beta: [130.0; CHANNELS],
        tau: level,
        sigma: [0.8; CHANNELS],
        ..Belief::default()
    };
    let mut beliefs = vec![(start, Record::pack(&start)); PIXELS];
    let (mut exact_sum, mut stored_sum, mut difference) = (0.0, 0.0, 0.0);
    for frame in 0..FRAMES {
        for (exact, record) in &mut beliefs {
            let x = level.map(|value| value + (NOISE_SD * random.normal()) as f32);
            let stored = record.unpack();
            let posterior = rules.belief(&stored, x);
            let exact_posterior = rules.belief(exact, x);
            if frame >= SETTLED {
                let stored_nats = f64::from(surprise(&stored, &posterior, x, &gamma));
                let exact_nats = f64::from(surprise(exact, &exact_posterior, x, &gamma));
                exact_sum += exact_nats;
                stored_sum += stored_nats;
                difference += (stored_nats - exact_nats).abs();
            }
            *record = Record::pack(&posterior);
            *exact = exact_posterior;
        }
    }
    let count = (PIXELS * (FRAMES - SETTLED)) as f64;
    (exact_sum / count, stored_sum / count, difference / count)
}

#[test]
fn storing_every_posterior_hardly_changes_the_surprise() {
    for (preset, grey) in [(Preset::Paper, 12.37), (Preset::Robust, 200.61)] {
        let (exact, stored, difference) = surprises(&Settings::preset(preset), grey);
        let change = (stored / exact - 1.0).abs();
        println!(
            "{preset:?} at {grey}: {exact:.4} nats, {:.3} % in the mean, {:.3} % a pixel",
            100.0 * change,
            100.0 * difference / exact
        );
        assert!(change < 0.01, "{preset:?}: {exact} became {stored}");
        // Coarser levels hide in the mean but not here.
        assert!(
            difference < DIFFERENCE_MAX * exact,
            "{difference} of {exact}"
        );
    }
}
