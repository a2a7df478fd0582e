//! One pixel: three channels (23), perhaps an earlier appearance (steps 4 to 6 of the robust preset).

use surprised::{
    config::{Settings, UnseenStart},
    model::belief::{Belief, CHANNELS, SPREAD_MAX, SPREAD_MIN},
    stages::{
        interpolate::prior::{self, Prior},
        update::UpdateRules,
    },
};

use super::{
    Random,
    belief::{NormalGamma, Rules, surprise},
};

pub type Channels = [NormalGamma; CHANNELS];

/// The main appearance of a belief.
pub fn channels(belief: &Belief) -> Channels {
    std::array::from_fn(|c| NormalGamma {
        alpha: belief.alpha.into(),
        beta: belief.beta[c].into(),
        tau: belief.tau[c].into(),
        sigma: belief.sigma[c].into(),
    })
}

/// What is believed before and after: the weights of two appearances and their channels.
pub struct Joint<const N: usize> {
    pub prior: [(f64, [NormalGamma; N]); 2],
    pub posterior: [(f64, [NormalGamma; N]); 2],
}

impl<const N: usize> Joint<N> {
    /// Bayes' rule for the weights, `rules` for the parameters.
    pub fn observe(prior: [(f64, [NormalGamma; N]); 2], x: [f64; N], rules: &Rules) -> Self {
        let ln_joint = prior.map(|(p, channels)| {
            let likelihood = channels.iter().zip(x).map(|(c, x)| c.ln_predictive(x));
            p.ln() + likelihood.sum::<f64>()
        });
        let largest = ln_joint[0].max(ln_joint[1]);
        let evidence: f64 = ln_joint.iter().map(|ln| (ln - largest).exp()).sum();
        let posterior = std::array::from_fn(|h| {
            let channels = std::array::from_fn(|c| rules.posterior(&prior[h].1[c], x[c]));
            ((ln_joint[h] - largest).exp() / evidence, channels)
        });
        Self { prior, posterior }
    }

    /// Chain rule: KL(rho || p) + sum rho S.
    pub fn surprise(&self) -> f64 {
        let mut sum = 0.0;
        for ((p, prior), (rho, posterior)) in self.prior.iter().zip(&self.posterior) {
            if *rho > 0.0 {
                let inner: f64 = posterior
                    .iter()
                    .zip(prior)
                    .map(|(after, before)| surprise(after, before))
                    .sum();
                sum += rho * ((rho / p).ln() + inner);
            }
        }
        sum
    }
}

/// A pixel's surprise, and what is remembered of it.
pub struct Scored {
    pub surprise: f64,
    pub alpha: f64,
    pub beta: [f64; CHANNELS],
    pub tau: [f64; CHANNELS],
    pub sigma: [f64; CHANNELS],
    pub tau2: [f64; CHANNELS],
    pub p2: f64,
    /// Of the earlier appearance; 0 where there is none.
    pub rho2: f64,
}

/// Steps 4 to 6 (each only where the settings say so) for a pixel with squared gradients `edge` of the expectation.
pub fn score(
    stored: &Belief,
    coverage: f64,
    edge: [f64; CHANNELS],
    x: [f64; CHANNELS],
    settings: &Settings,
) -> Scored {
    let rules = Rules::new(settings);
    let prior = channels(stored);
    let posterior: Channels = std::array::from_fn(|c| rules.posterior(&prior[c], x[c]));
    let mut scored = Scored {
        surprise: 0.0,
        alpha: posterior[0].alpha,
        beta: posterior.map(|c| c.beta),
        tau: posterior.map(|c| c.tau),
        sigma: posterior.map(|c| c.sigma),
        tau2: [0.0; CHANNELS],
        p2: 0.0,
        rho2: 0.0,
    };
    if coverage == 0.0 {
        if settings.unseen_start == UnseenStart::Observation {
            scored.alpha = 1.3;
            scored.beta = [1.3 * f64::from(settings.unseen_variance); CHANNELS];
            scored.tau = x;
            scored.sigma = [0.8; CHANNELS];
        }
        return scored;
    }
    // Step 4.
    let q = f64::from(settings.edge_error_px);
    let widened: Channels = std::array::from_fn(|c| NormalGamma {
        beta: prior[c].beta + prior[c].alpha * q * q * edge[c],
        ..prior[c]
    });
    scored.surprise = (0..CHANNELS)
        .map(|c| surprise(&rules.posterior(&widened[c], x[c]), &widened[c]))
        .sum();
    if !settings.earlier_appearance {
        return scored;
    }
    // Step 5.
    if stored.p2 > 0.05 {
        let earlier: Channels = std::array::from_fn(|c| NormalGamma {
            beta: prior[c].alpha * 100.0,
            tau: stored.tau2[c].into(),
            sigma: 0.3,
            ..prior[c]
        });
        let p = f64::from(stored.p2).clamp(0.45, 0.55);
        let joint = Joint::observe([(1.0 - p, widened), (p, earlier)], x, &rules);
        scored.surprise = joint.surprise();
        scored.rho2 = joint.posterior[1].0;
        scored.tau2 = stored.tau2.map(f64::from);
        scored.p2 = 0.5 * f64::from(stored.p2) + 0.5 * scored.rho2;
    }
    // Step 6.
    let exchanged = scored.rho2 > 0.5;
    let changed = scored.surprise > f64::from(settings.surprise_threshold);
    if exchanged || changed {
        for c in 0..CHANNELS {
            let variance = (prior[c].beta / prior[c].alpha).clamp(60.0, 400.0);
            scored.beta[c] = scored.alpha * variance;
            scored.sigma[c] = 0.8;
            scored.tau[c] = if exchanged {
                0.5 * (x[c] + f64::from(stored.tau2[c]))
            } else {
                x[c]
            };
            scored.tau2[c] = prior[c].tau;
        }
        scored.p2 = if exchanged {
            0.5 * (1.0 - f64::from(stored.p2))
        } else {
            0.5
        };
    }
    if scored.p2 < 0.05 {
        scored.p2 = 0.0;
    }
    scored
}

pub fn any_belief(random: &mut Random, rules: &UpdateRules) -> Belief {
    let (low, high) = rules.alpha_range();
    let spread = (f64::from(SPREAD_MIN), f64::from(SPREAD_MAX));
    let extreme = |random: &mut Random, low: f64, high: f64| match random.below(8) {
        0 => low as f32,
        1 => high as f32,
        _ => random.log_uniform(low, high) as f32,
    };
    Belief {
        alpha: extreme(random, low.into(), high.into()),
        beta: std::array::from_fn(|_| extreme(random, spread.0, spread.1)),
        tau: any_colour(random),
        sigma: std::array::from_fn(|_| extreme(random, 0.05, 5.0)),
        tau2: any_colour(random),
        p2: 0.0,
    }
}

pub fn any_colour(random: &mut Random) -> [f32; CHANNELS] {
    [
        random.uniform(0.0, 255.0) as f32,
        random.uniform(-127.5, 127.5) as f32,
        random.uniform(-127.5, 127.5) as f32,
    ]
}

/// What is expected, close to it, or anything.
pub fn any_observation(random: &mut Random, prior: &Belief) -> [f32; CHANNELS] {
    let reach = match random.below(4) {
        0 => 0.0,
        1 => 0.1,
        2 => 5.0,
        _ => return any_colour(random),
    };
    prior
        .tau
        .map(|tau| tau + random.uniform(-reach, reach) as f32)
}

/// Step 4: mean of the squared one-sided differences in x plus that in y, over neighbours that were seen.
pub fn edge(prior: &Prior, x: usize, y: usize, channel: usize) -> f64 {
    let at = |x: usize, y: usize, plane: usize| f64::from(prior.row(y).plane(plane)[x]);
    let mut sum = 0.0;
    for neighbours in [
        [(x.wrapping_sub(1), y), (x + 1, y)],
        [(x, y.wrapping_sub(1)), (x, y + 1)],
    ] {
        let squares: Vec<f64> = neighbours
            .into_iter()
            .filter(|&(nx, ny)| nx < prior.width && ny < prior.height)
            .filter(|&(nx, ny)| {
                at(nx, ny, prior::COVERAGE) > 0.0 && at(x, y, prior::COVERAGE) > 0.0
            })
            .map(|(nx, ny)| {
                (at(x, y, prior::TAU + channel) - at(nx, ny, prior::TAU + channel)).powi(2)
            })
            .collect();
        sum += squares.iter().sum::<f64>() / squares.len().max(1) as f64;
    }
    sum
}

/// Half a step of the stored values on top of the error of single precision.
pub fn assert_stored(got: &Belief, expected: &Scored, context: &str) {
    let spread = |got: f32, expected: f64| {
        let expected = expected.clamp(SPREAD_MIN.into(), SPREAD_MAX.into());
        let error = (f64::from(got) - expected).abs();
        let step = 1.0 / 2048.0 + 1e-5;
        assert!(
            error <= step * expected,
            "{got} is not {expected}: {context}"
        );
    };
    let level = |got: f32, expected: f64| {
        let error = (f64::from(got) - expected).abs();
        assert!(
            error <= 0.5 / 128.0 + 1e-3,
            "{got} is not {expected}: {context}"
        );
    };
    spread(got.alpha, expected.alpha);
    for c in 0..CHANNELS {
        spread(got.beta[c], expected.beta[c]);
        spread(got.sigma[c], expected.sigma[c]);
        level(got.tau[c], expected.tau[c]);
        if expected.p2 > 0.0 {
            level(got.tau2[c], expected.tau2[c]);
        }
    }
    let error = (f64::from(got.p2) - expected.p2).abs();
    assert!(
        error < 1e-3,
        "p2 {} is not {}: {context}",
        got.p2,
        expected.p2
    );
}

/// Returns the error as a share of the expected surprise, of 0.01 nats at least.
pub fn assert_surprise(got: f32, expected: f64, context: &str) -> f64 {
    let error = (f64::from(got) - expected).abs() / expected.max(0.01);
    assert!(error <= 1e-4, "{got} nats are not {expected}: {context}");
    error
}
