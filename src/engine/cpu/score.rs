//! The update and surprise passes over one row: sixteen pixels a step in lanes, then what is particular about each
//! pixel (unseen, an earlier appearance, a new one) and its record.

use crate::{
    config::UnseenStart,
    engine::isa::for_each_isa,
    model::belief::{Belief, CHANNELS, Record},
    stages::{
        interpolate::prior::{self, Prior, PriorRow},
        lanes::{LANES, Lanes},
        surprise::{GammaTerm, P2_MIN, channel_terms, edge_gradient_row, joint_surprise, total},
        update::UpdateRules,
    },
};

/// Variance that a new or exchanged appearance keeps, grey levels squared.
const CHANGED_VARIANCE: (f32, f32) = (60.0, 400.0);
/// Its sigma: open to the next observation.
const CHANGED_SIGMA: f32 = 0.8;

pub struct ScoreRules {
    pub update: UpdateRules,
    pub gamma: GammaTerm,
    /// Squared pixel error at edges; 0 = edges are not widened.
    pub edge_variance_px: f32,
    pub earlier_appearance: bool,
    /// Nats from which a pixel has a new appearance.
    pub surprise_threshold: f32,
}

/// Working memory of one thread.
#[derive(Default)]
pub struct ScoreScratch {
    edge_gradient: [Vec<f32>; CHANNELS],
}

for_each_isa! {
    /// Row `y` of the image: surprise in nats and the posterior's records.
    pub fn score_row(
        prior: &Prior,
        y: usize,
        observed: [&[f32]; CHANNELS],
        inverse_gain: f32,
        rules: &ScoreRules,
        scratch: &mut ScoreScratch,
        surprise: &mut [f32],
        posterior: &mut [Record],
    ) = score_row_kernel;
}

#[inline(always)]
#[allow(clippy::too_many_arguments)]
fn score_row_kernel(
    prior: &Prior,
    y: usize,
    observed: [&[f32]; CHANNELS],
    inverse_gain: f32,
    rules: &ScoreRules,
    scratch: &mut ScoreScratch,
    surprise: &mut [f32],
    posterior: &mut [Record],
) {
    let width = prior.width;
    let row = prior.row(y);
    let widened = rules.edge_variance_px > 0.0;
    if widened {
        let above = y.checked_sub(1).map(|y| prior.row(y));
        let below = (y + 1 < prior.height).then(|| prior.row(y + 1));
        let around = |plane: usize| {
            (
                above.map(|row| row.plane(plane)),
                row.plane(plane),
                below.map(|row| row.plane(plane)),
            )
        };
        for (channel, gradient) in scratch.edge_gradient.iter_mut().enumerate() {
            gradient.resize(width, 0.0);
            edge_gradient_row(
                around(prior::TAU + channel),
                around(prior::COVERAGE),
                gradient,
            );
        }
    }
    for start in (0..width).step_by(LANES) {
        let count = LANES.min(width - start);
        let mut step = Step::load(row, observed, inverse_gain, start, count);
        if widened {
            for (channel, gradient) in scratch.edge_gradient.iter().enumerate() {
                step.edge[channel] = load(gradient, start, count);
            }
        }
        let surprise = &mut surprise[start..start + count];
        let posterior = &mut posterior[start..start + count];
        let scored = step.score(rules);
        for lane in 0..count {
            (surprise[lane], posterior[lane]) = step.settle(&scored, lane, row, start, rules);
        }
    }
}

#[inline(always)]
fn load(plane: &[f32], start: usize, count: usize) -> Lanes {
    match plane[start..].first_chunk::<LANES>() {
        Some(lanes) => *lanes,
        None => {
            // The last step of a row: any value that makes no exception serves as padding.
            let mut lanes = [1.0; LANES];
            lanes[..count].copy_from_slice(&plane[start..start + count]);
            lanes
        }
    }
}

/// Sixteen pixels on their way through the update.
struct Step {
    alpha: Lanes,
    beta: [Lanes; CHANNELS],
    tau: [Lanes; CHANNELS],
    sigma: [Lanes; CHANNELS],
    observed: [Lanes; CHANNELS],
    /// Squared gradient of tau; 0 unless edges are widened.
    edge: [Lanes; CHANNELS],
}

/// Their surprise with one appearance, and their posterior.
struct Scored {
    surprise: Lanes,
    /// The prior's beta as scored: with the variance of edges.
    widened_beta: [Lanes; CHANNELS],
    beta: [Lanes; CHANNELS],
    tau: [Lanes; CHANNELS],
    sigma: [Lanes; CHANNELS],
}

impl Step {
    #[inline(always)]
    fn load(
        row: PriorRow,
        observed: [&[f32]; CHANNELS],
        inverse_gain: f32,
        start: usize,
        count: usize,
    ) -> Self {
        let channels = |plane: usize| -> [Lanes; CHANNELS] {
            std::array::from_fn(|channel| load(row.plane(plane + channel), start, count))
        };
        Self {
            alpha: load(row.plane(prior::ALPHA), start, count),
            beta: channels(prior::BETA),
            tau: channels(prior::TAU),
            sigma: channels(prior::SIGMA),
            observed: observed.map(|plane| load(plane, start, count).map(|x| x * inverse_gain)),
            edge: [[0.0; LANES]; CHANNELS],
        }
    }

    #[inline(always)]
    fn score(&self, rules: &ScoreRules) -> Scored {
        let mut scored = Scored {
            surprise: [0.0; LANES],
            widened_beta: self.beta,
            beta: [[0.0; LANES]; CHANNELS],
            tau: [[0.0; LANES]; CHANNELS],
            sigma: [[0.0; LANES]; CHANNELS],
        };
        let mut plain = [0.0; LANES];
        let mut beta_ratios = [1.0; LANES];
        let mut sigma_ratios = [1.0; LANES];
        for c in 0..CHANNELS {
            for lane in 0..LANES {
                let alpha0 = self.alpha[lane];
                let (tau0, sigma0) = (self.tau[c][lane], self.sigma[c][lane]);
                let observed = self.observed[c][lane];
                let prior = (self.beta[c][lane], tau0, sigma0);
                let (beta, tau, sigma) = rules.update.channel(alpha0, prior, observed);
                scored.beta[c][lane] = beta;
                scored.tau[c][lane] = tau;
                scored.sigma[c][lane] = sigma;
            }
            for lane in 0..LANES {
                let alpha0 = self.alpha[lane];
                let widened =
                    self.beta[c][lane] + alpha0 * rules.edge_variance_px * self.edge[c][lane];
                scored.widened_beta[c][lane] = widened;
                let (tau0, sigma0) = (self.tau[c][lane], self.sigma[c][lane]);
                let observed = self.observed[c][lane];
                let (beta, _, sigma) =
                    rules
                        .update
                        .channel(alpha0, (widened, tau0, sigma0), observed);
                let (p, b, s) = channel_terms(
                    rules.update.alpha(alpha0),
                    (widened, sigma0),
                    (beta, sigma),
                    observed - tau0,
                );
                plain[lane] += p;
                beta_ratios[lane] *= b;
                sigma_ratios[lane] *= s;
            }
        }
        for lane in 0..LANES {
            scored.surprise[lane] = total(
                self.alpha[lane],
                plain[lane],
                beta_ratios[lane],
                sigma_ratios[lane],
                &rules.gamma,
            );
        }
        scored
    }

    /// One pixel's surprise and record.
    #[inline(always)]
    fn settle(
        &self,
        scored: &Scored,
        lane: usize,
        row: PriorRow,
        start: usize,
        rules: &ScoreRules,
    ) -> (f32, Record) {
        let x = start + lane;
        let observed = self.observed.map(|plane| plane[lane]);
        let unseen = row.plane(prior::COVERAGE)[x] == 0.0;
        if unseen && rules.update.unseen_start == UnseenStart::Observation {
            return (0.0, Record::pack(&rules.update.start(observed)));
        }
        let mut posterior = Belief {
            alpha: rules.update.alpha(self.alpha[lane]),
            beta: scored.beta.map(|plane| plane[lane]),
            tau: scored.tau.map(|plane| plane[lane]),
            sigma: scored.sigma.map(|plane| plane[lane]),
            ..Belief::default()
        };
        if unseen {
            return (0.0, Record::pack(&posterior));
        }
        let mut surprise = scored.surprise[lane];
        if rules.earlier_appearance {
            let p2 = row.plane(prior::P2)[x];
            if p2 > P2_MIN || surprise > rules.surprise_threshold {
                let stored = row.belief(x);
                let widened = Belief {
                    beta: scored.widened_beta.map(|plane| plane[lane]),
                    ..stored
                };
                surprise =
                    two_appearances(&stored, &widened, observed, surprise, &mut posterior, rules);
            }
        }
        (surprise, Record::pack(&posterior))
    }
}

/// Steps 5 and 6 where a pixel has an earlier appearance or gets one: surprise of the joint belief, and what the
/// posterior remembers.
#[cold]
fn two_appearances(
    stored: &Belief,
    widened: &Belief,
    observed: [f32; CHANNELS],
    surprise1: f32,
    posterior: &mut Belief,
    rules: &ScoreRules,
) -> f32 {
    let (surprise, rho2) = if stored.p2 > P2_MIN {
        joint_surprise(widened, observed, surprise1, &rules.update, &rules.gamma)
    } else {
        (surprise1, 0.0)
    };
    let changed = |tau: [f32; CHANNELS], p2: f32| {
        let (low, high) = CHANGED_VARIANCE;
        Belief {
            alpha: posterior.alpha,
            beta: stored
                .beta
                .map(|beta0| posterior.alpha * (beta0 / stored.alpha).clamp(low, high)),
            tau,
            sigma: [CHANGED_SIGMA; CHANNELS],
            tau2: stored.tau,
            p2,
        }
    };
    *posterior = if rho2 > 0.5 {
        // What was there before is back: the two change places.
        let tau = std::array::from_fn(|c| (observed[c] + stored.tau2[c]) / 2.0);
        changed(tau, 0.5 * (1.0 - stored.p2))
    } else if surprise > rules.surprise_threshold {
        changed(observed, 0.5)
    } else {
        Belief {
            tau2: stored.tau2,
            p2: 0.5 * stored.p2 + 0.5 * rho2,
            ..*posterior
        }
    };
    if posterior.p2 < P2_MIN {
        posterior.p2 = 0.0;
    }
    surprise
}
