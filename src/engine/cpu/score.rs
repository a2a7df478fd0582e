//! The update and surprise passes over one row: sixteen pixels a step in lanes, then what is particular about each
//! pixel (unseen, an earlier appearance, a new one) and its record.

use crate::{
    config::UnseenStart,
    isa::for_each_isa,
    lanes::{LANES, Lanes, Portable, Transpose, bits, load_or, members, prefetch},
    model::belief::{Belief, BeliefLanes, CHANNELS, Record},
    stages::{
        interpolate::prior::{self, PriorRow},
        surprise::{EdgeWeights, GammaTerm, P2_MIN, divergence, joint_surprise},
        update::{Channels, UpdateRules},
    },
};

#[cfg(target_arch = "x86_64")]
use crate::lanes::Avx;

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

impl ScoreRules {
    /// Whether a pixel's score depends on those around it.
    pub fn looks_around(&self) -> bool {
        self.edge_variance_px > 0.0
    }
}

/// Planes that a pixel's score depends on, and those of which the pixels around it matter too.
const OF_A_PIXEL: [usize; 8] = [
    prior::ALPHA,
    prior::BETA,
    prior::BETA + 1,
    prior::BETA + 2,
    prior::SIGMA,
    prior::SIGMA + 1,
    prior::SIGMA + 2,
    prior::P2,
];
const OF_THOSE_AROUND: [usize; 4] = [prior::TAU, prior::TAU + 1, prior::TAU + 2, prior::COVERAGE];

/// Working memory of one thread.
#[derive(Default)]
pub struct ScoreScratch {
    edge_weights: EdgeWeights,
    edge_gradient: [Vec<f32>; CHANNELS],
}

for_each_isa! {
    /// A row of the image, between its neighbours: surprise in nats and the posterior's records. Adds to `seen` how many
    /// pixels some view saw.
    pub fn score_row(
        above: Option<PriorRow<'_>>,
        row: PriorRow<'_>,
        below: Option<PriorRow<'_>>,
        observed: [&[f32]; CHANNELS],
        inverse_gain: f32,
        rules: &ScoreRules,
        scratch: &mut ScoreScratch,
        surprise: &mut [f32],
        posterior: &mut [Record],
        seen: &mut usize,
    ) = score_row_kernel::<Portable>, avx score_row_kernel::<Avx>;
}

#[inline(always)]
#[allow(clippy::too_many_arguments)]
fn score_row_kernel<T: Transpose>(
    above: Option<PriorRow>,
    row: PriorRow,
    below: Option<PriorRow>,
    observed: [&[f32]; CHANNELS],
    inverse_gain: f32,
    rules: &ScoreRules,
    scratch: &mut ScoreScratch,
    surprise: &mut [f32],
    posterior: &mut [Record],
    seen: &mut usize,
) {
    let width = row.width;
    let widened = rules.looks_around();
    if widened {
        let around = |plane: usize| {
            (
                above.map(|row| row.plane(plane)),
                row.plane(plane),
                below.map(|row| row.plane(plane)),
            )
        };
        scratch.edge_weights.find(around(prior::COVERAGE));
        for (channel, gradient) in scratch.edge_gradient.iter_mut().enumerate() {
            gradient.resize(width, 0.0);
            let tau = around(prior::TAU + channel);
            scratch.edge_weights.gradient(tau, gradient);
        }
    }
    for start in (0..width).step_by(LANES) {
        let count = LANES.min(width - start);
        for plane in OF_A_PIXEL {
            prefetch(row.data, width * (prior::PLANES + plane) + start);
        }
        // Edges are found in the row below already.
        let around_rows = if widened { 2 } else { 1 };
        for plane in OF_THOSE_AROUND {
            let below = around_rows * prior::PLANES;
            prefetch(row.data, width * (below + plane) + start);
        }
        for record in (0..LANES).step_by(2) {
            // The next row's, two a line of cache: they are written whole, but lines are fetched first.
            prefetch(posterior, width + start + record);
        }
        let mut step = Step::load(row, observed, inverse_gain, start);
        let mut scored = if widened {
            for (channel, gradient) in scratch.edge_gradient.iter().enumerate() {
                step.edge[channel] = load(gradient, start);
            }
            step.score::<true>(rules)
        } else {
            step.score::<false>(rules)
        };
        let two = step.settle(&mut scored, rules);
        let surprise = &mut surprise[start..start + count];
        let posterior = &mut posterior[start..start + count];
        match posterior.first_chunk_mut::<LANES>() {
            Some(records) => Record::pack_lanes::<T>(&scored.posterior, records),
            None => {
                let mut records = [Record::default(); LANES];
                Record::pack_lanes::<T>(&scored.posterior, &mut records);
                posterior.copy_from_slice(&records[..count]);
            }
        }
        surprise.copy_from_slice(&scored.surprise[..count]);
        let covered = bits(|lane| (lane < count) & (step.coverage[lane] > 0.0));
        *seen += covered.count_ones() as usize;
        for lane in members(two).take_while(|&lane| lane < count) {
            (surprise[lane], posterior[lane]) =
                two_appearances(&step, &scored, lane, row.belief(start + lane), rules);
        }
    }
}

/// Any value that makes no exception serves beyond the end of a row.
#[inline(always)]
fn load(plane: &[f32], start: usize) -> Lanes {
    load_or(1.0, &plane[start..])
}

/// Sixteen pixels on their way through the update.
#[derive(Default)]
struct Step {
    alpha: Lanes,
    beta: [Lanes; CHANNELS],
    tau: [Lanes; CHANNELS],
    sigma: [Lanes; CHANNELS],
    p2: Lanes,
    coverage: Lanes,
    observed: [Lanes; CHANNELS],
    /// Squared gradient of tau; 0 unless edges are widened.
    edge: [Lanes; CHANNELS],
}

/// Their surprise with one appearance, and their posterior.
struct Scored {
    surprise: Lanes,
    /// The prior's beta as scored: with the variance of edges.
    widened_beta: [Lanes; CHANNELS],
    posterior: BeliefLanes,
}

impl Step {
    #[inline(always)]
    fn load(row: PriorRow, observed: [&[f32]; CHANNELS], inverse_gain: f32, start: usize) -> Self {
        let mut step = Self {
            alpha: load(row.plane(prior::ALPHA), start),
            p2: load(row.plane(prior::P2), start),
            coverage: load(row.plane(prior::COVERAGE), start),
            ..Self::default()
        };
        for c in 0..CHANNELS {
            step.beta[c] = load(row.plane(prior::BETA + c), start);
            step.tau[c] = load(row.plane(prior::TAU + c), start);
            step.sigma[c] = load(row.plane(prior::SIGMA + c), start);
            step.observed[c] = load(observed[c], start);
            for observed in &mut step.observed[c] {
                *observed *= inverse_gain;
            }
        }
        step
    }

    #[inline(always)]
    fn score<const WIDENED: bool>(&self, rules: &ScoreRules) -> Scored {
        let mut scored = Scored {
            surprise: [0.0; LANES],
            widened_beta: self.beta,
            posterior: BeliefLanes::default(),
        };
        let posterior = &mut scored.posterior;
        for lane in 0..LANES {
            let at =
                |planes: &[Lanes; CHANNELS]| [planes[0][lane], planes[1][lane], planes[2][lane]];
            let alpha0 = self.alpha[lane];
            let alpha = rules.update.alpha(alpha0);
            let prior = Channels {
                beta: at(&self.beta),
                tau: at(&self.tau),
                sigma: at(&self.sigma),
            };
            let observed = at(&self.observed);
            let updated = rules.update.channels(alpha0, &prior, observed);
            posterior.alpha[lane] = alpha;
            for c in 0..CHANNELS {
                posterior.beta[c][lane] = updated.beta[c];
                posterior.tau[c][lane] = updated.tau[c];
                posterior.sigma[c][lane] = updated.sigma[c];
            }
            let (prior, updated) = if WIDENED {
                let mut prior = prior;
                for c in 0..CHANNELS {
                    prior.beta[c] += alpha0 * rules.edge_variance_px * self.edge[c][lane];
                    scored.widened_beta[c][lane] = prior.beta[c];
                }
                (prior, rules.update.channels(alpha0, &prior, observed))
            } else {
                (prior, updated)
            };
            scored.surprise[lane] = divergence(
                (alpha0, &prior),
                (alpha, &updated),
                [
                    observed[0] - prior.tau[0],
                    observed[1] - prior.tau[1],
                    observed[2] - prior.tau[2],
                ],
                &rules.gamma,
            );
        }
        scored
    }

    /// What is particular to unseen pixels; returns those, a bit mask, that have an earlier appearance or get one.
    #[inline(always)]
    fn settle(&self, scored: &mut Scored, rules: &ScoreRules) -> u32 {
        let starts = rules.update.unseen_start == UnseenStart::Observation;
        let start = rules.update.start([0.0; CHANNELS]);
        let Scored {
            surprise,
            posterior,
            ..
        } = scored;
        if bits(|lane| self.coverage[lane] == 0.0) != 0 {
            for lane in 0..LANES {
                let unseen = self.coverage[lane] == 0.0;
                surprise[lane] = if unseen { 0.0 } else { surprise[lane] };
                let starts = unseen & starts;
                let or = |value: f32, start: f32| if starts { start } else { value };
                posterior.alpha[lane] = or(posterior.alpha[lane], start.alpha);
                for c in 0..CHANNELS {
                    posterior.beta[c][lane] = or(posterior.beta[c][lane], start.beta[c]);
                    posterior.tau[c][lane] = or(posterior.tau[c][lane], self.observed[c][lane]);
                    posterior.sigma[c][lane] = or(posterior.sigma[c][lane], start.sigma[c]);
                }
            }
        }
        if !rules.earlier_appearance {
            return 0;
        }
        bits(|lane| {
            (self.coverage[lane] > 0.0)
                & ((self.p2[lane] > P2_MIN) | (surprise[lane] > rules.surprise_threshold))
        })
    }
}

/// Steps 5 and 6 where a pixel has an earlier appearance or gets one: surprise of the joint belief, and what the
/// posterior remembers.
#[cold]
fn two_appearances(
    step: &Step,
    scored: &Scored,
    lane: usize,
    stored: Belief,
    rules: &ScoreRules,
) -> (f32, Record) {
    let observed = step.observed.map(|plane| plane[lane]);
    let widened = Belief {
        beta: scored.widened_beta.map(|plane| plane[lane]),
        ..stored
    };
    let surprise1 = scored.surprise[lane];
    let mut posterior = scored.posterior.at(lane);
    let (surprise, rho2) = if stored.p2 > P2_MIN {
        joint_surprise(&widened, observed, surprise1, &rules.update, &rules.gamma)
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
    posterior = if rho2 > 0.5 {
        // What was there before is back: the two change places.
        let tau = std::array::from_fn(|c| (observed[c] + stored.tau2[c]) / 2.0);
        changed(tau, 0.5 * (1.0 - stored.p2))
    } else if surprise > rules.surprise_threshold {
        changed(observed, 0.5)
    } else {
        Belief {
            tau2: stored.tau2,
            p2: 0.5 * stored.p2 + 0.5 * rho2,
            ..posterior
        }
    };
    if posterior.p2 < P2_MIN {
        posterior.p2 = 0.0;
    }
    (surprise, Record::pack(&posterior))
}
