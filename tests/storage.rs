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
const NOISE_SD: f64 = 1.5;

fn mean_surprise(settings: &Settings, grey: f32, stored: bool) -> f64 {
    let rules = UpdateRules::new(settings);
    let gamma = GammaTerm::new(&rules);
    let mut random = Random(11);
    let level = [grey, 20.0, -35.0];
    let start = Belief {
        alpha: 1.3,
        beta: [130.0; CHANNELS],
        tau: level,
        sigma: [0.8; CHANNELS],
        ..Belief::default()
    };
    let mut beliefs = vec![start; PIXELS];
    let mut sum = 0.0;
    for frame in 0..FRAMES {
        for belief in &mut beliefs {
            let x = level.map(|value| value + (NOISE_SD * random.normal()) as f32);
            let posterior = rules.belief(belief, x);
            if frame >= FRAMES / 4 {
                sum += f64::from(surprise(belief, &posterior, x, &gamma));
            }
            *belief = if stored {
                Record::pack(&posterior).unpack()
            } else {
                posterior
            };
        }
    }
    sum / (PIXELS * FRAMES * 3 / 4) as f64
}

#[test]
fn storing_every_posterior_changes_the_mean_surprise_by_less_than_a_percent() {
    for preset in [Preset::Paper, Preset::Robust] {
        for grey in [12.37, 200.61] {
            let settings = Settings::preset(preset);
            let exact = mean_surprise(&settings, grey, false);
            let stored = mean_surprise(&settings, grey, true);
            let change = (stored / exact - 1.0).abs();
            println!("{preset:?} at {grey}: {exact:.4} nats, stored {stored:.4}, {:.3} %", 100.0 * change);
            assert!(change < 0.01, "{preset:?} at {grey}: {exact} became {stored}");
        }
    }
}
