//! How much an observation changes a belief (section IV): the Kullback-Leibler divergence of posterior and prior.
//!
//! Prior (as stored: before forgetting, before (10)) and posterior -> nats, summed over Y, Cb, Cr (16) to (23), in the
//! log domain: T1 + T3 simplify to `alpha0 ln(beta/beta0) + (alpha - alpha0) psi(alpha) + lnG(alpha0) - lnG(alpha)`.
//! With an earlier appearance the belief is a mixture of two; its surprise is exact by the chain rule (steps 5 and 6 of
//! the robust preset). Edges may widen the prior for the score (step 4).

use crate::{
    lanes::{ln, reciprocals},
    model::belief::{Belief, CHANNELS},
    stages::update::{Channels, UpdateRules},
};

pub(crate) const DEGREE: usize = 12;

/// The gamma terms `lnG(alpha0) - lnG(alpha) + (alpha - alpha0) psi(alpha)` with `alpha = f alpha0 + 1/2`: they depend on
/// alpha0 alone, which stays in a short range, so one polynomial serves the three channels.
#[derive(Debug, Clone)]
pub struct GammaTerm {
    pub(crate) center: f32,
    pub(crate) scale: f32,
    /// In `(alpha0 - center) * scale`, lowest power first.
    pub(crate) coefficients: [f32; DEGREE + 1],
}

impl GammaTerm {
    /// Interpolates at the Chebyshev nodes of the range that alpha can take; exact to 2e-8 for f = 0.8.
    pub fn new(rules: &UpdateRules) -> Self {
        let (low, high) = rules.alpha_range();
        // Stored values are rounded to 11 bits.
        let (low, high) = (f64::from(low) * 0.999, f64::from(high) * 1.001);
        let center = (low + high) / 2.0;
        let half = (high - low) / 2.0;
        let n = DEGREE + 1;
        let value = |alpha0: f64| {
            let alpha = f64::from(rules.forgetting) * alpha0 + 0.5;
            libm::lgamma(alpha0) - libm::lgamma(alpha) + (alpha - alpha0) * digamma(alpha)
        };
        let angle = |k: usize| std::f64::consts::PI * (k as f64 + 0.5) / n as f64;
        // Chebyshev coefficients, then their sum as powers.
        let mut powers = [0.0f64; DEGREE + 1];
        let mut previous = [0.0f64; DEGREE + 1];
        let mut current = [0.0f64; DEGREE + 1];
        current[0] = 1.0;
        for order in 0..n {
            let weight = if order == 0 { 1.0 } else { 2.0 } / n as f64;
            let coefficient: f64 = weight
                * (0..n)
                    .map(|k| {
                        value(center + half * angle(k).cos()) * (order as f64 * angle(k)).cos()
                    })
                    .sum::<f64>();
            for (power, current) in powers.iter_mut().zip(current) {
                *power += coefficient * current;
            }
            // T(n+1) = 2 t T(n) - T(n-1), and T(1) = t.
            let factor = if order == 0 { 1.0 } else { 2.0 };
            let mut next = [0.0; DEGREE + 1];
            for power in 0..DEGREE {
                next[power + 1] = factor * current[power];
            }
            for (next, previous) in next.iter_mut().zip(previous) {
                *next -= previous;
            }
            previous = current;
            current = next;
        }
        Self {
            center: center as f32,
            scale: (1.0 / half) as f32,
            coefficients: powers.map(|power| power as f32),
        }
    }

    #[inline(always)]
    pub fn at(&self, alpha0: f32) -> f32 {
        let t = (alpha0 - self.center) * self.scale;
        // By three, so that no term waits for all after it.
        let cube = t * t * t;
        let mut sum = self.coefficients[DEGREE];
        for power in (0..DEGREE).step_by(3).rev() {
            let c = &self.coefficients[power..power + 3];
            sum = sum * cube + ((c[2] * t + c[1]) * t + c[0]);
        }
        sum
    }
}

/// psi(x) for x > 0: recurrence to where the asymptotic series holds to double precision.
fn digamma(x: f64) -> f64 {
    let mut x = x;
    let mut sum = 0.0;
    while x < 12.0 {
        sum -= 1.0 / x;
        x += 1.0;
    }
    let r = 1.0 / (x * x);
    sum + x.ln()
        - 0.5 / x
        - r * (1.0 / 12.0 - r * (1.0 / 120.0 - r * (1.0 / 252.0 - r * (1.0 / 240.0 - r / 132.0))))
}

/// (16) to (23), nats: of a prior, the one that was updated, and its posterior. `deviation` is the observation's from
/// tau0. The channels share divisions and logarithms: products of three stay below 1e16.
#[inline(always)]
pub fn divergence(
    (alpha0, prior): (f32, &Channels),
    (alpha, posterior): (f32, &Channels),
    deviation: [f32; CHANNELS],
    gamma: &GammaTerm,
) -> f32 {
    let per_beta = reciprocals(posterior.beta);
    let per_sigma0 = reciprocals(prior.sigma);
    let mut plain = 0.0;
    for c in 0..CHANNELS {
        let (beta0, beta, sigma) = (prior.beta[c], posterior.beta[c], posterior.sigma[c]);
        let precision = alpha * per_beta[c];
        // tau - tau0 by (14): the difference of the two would have few digits left, which a small beta magnifies.
        let moved = sigma * deviation[c];
        plain += (beta0 - beta) * precision
            + 0.5 * (moved * moved * precision + sigma) * per_sigma0[c]
            - 0.5;
    }
    let product = |[a, b, c]: [f32; CHANNELS]| a * b * c;
    let sum = plain
        + alpha0 * ln(product(posterior.beta) / product(prior.beta))
        + 0.5 * ln(product(prior.sigma) / product(posterior.sigma))
        + CHANNELS as f32 * gamma.at(alpha0);
    // A divergence is never negative; rounding may be.
    sum.max(0.0)
}

/// The surprise of one pixel whose belief has one appearance; `posterior` is the prior's after `observed`.
#[inline(always)]
pub fn surprise(
    prior: &Belief,
    posterior: &Belief,
    observed: [f32; CHANNELS],
    gamma: &GammaTerm,
) -> f32 {
    divergence(
        (prior.alpha, &prior.into()),
        (posterior.alpha, &posterior.into()),
        std::array::from_fn(|c| observed[c] - prior.tau[c]),
        gamma,
    )
}

/// From this weight on an earlier appearance takes part.
pub const P2_MIN: f32 = 0.05;
/// The variance and mean's scale that an earlier appearance is given, grey levels squared.
const EARLIER_VARIANCE: f32 = 100.0;
const EARLIER_SIGMA: f32 = 0.3;
/// However much speaks for one appearance, the other stays thinkable: coming back costs at most ln(1/0.45) nats.
const EARLIER_SHARE: (f32, f32) = (0.45, 0.55);

/// The belief that the earlier appearance stands for.
pub fn earlier_belief(prior: &Belief) -> Belief {
    Belief {
        beta: [prior.alpha * EARLIER_VARIANCE; CHANNELS],
        tau: prior.tau2,
        sigma: [EARLIER_SIGMA; CHANNELS],
        ..*prior
    }
}

/// Surprise of the joint belief (which appearance, its parameters), and how much the observation speaks for the earlier
/// one: `(nats, rho2)`. `surprise1` is that of the main appearance alone.
pub fn joint_surprise(
    prior: &Belief,
    observed: [f32; CHANNELS],
    surprise1: f32,
    rules: &UpdateRules,
    gamma: &GammaTerm,
) -> (f32, f32) {
    let earlier = earlier_belief(prior);
    let surprise2 = surprise(&earlier, &rules.belief(&earlier, observed), observed, gamma);
    let (low, high) = EARLIER_SHARE;
    let p2 = prior.p2.clamp(low, high);
    let p1 = 1.0 - p2;
    let log_odds =
        log_predictive(&earlier, observed) - log_predictive(prior, observed) + (p2 / p1).ln();
    let rho2 = 1.0 / (1.0 + (-log_odds).exp());
    let rho1 = 1.0 - rho2;
    let term = |rho: f32, p: f32, surprise: f32| {
        if rho > 0.0 {
            rho * ((rho / p).ln() + surprise)
        } else {
            0.0
        }
    };
    let sum = term(rho1, p1, surprise1) + term(rho2, p2, surprise2);
    (sum.max(0.0), rho2)
}

/// Logarithm of the predictive density (Student's t with 2 alpha degrees of freedom), up to what depends on alpha alone.
fn log_predictive(belief: &Belief, observed: [f32; CHANNELS]) -> f32 {
    let mut sum = 0.0;
    for ((&beta, &sigma), (&tau, x)) in belief
        .beta
        .iter()
        .zip(&belief.sigma)
        .zip(belief.tau.iter().zip(observed))
    {
        // 2 alpha times the squared scale.
        let spread = 2.0 * beta * (1.0 + sigma);
        let difference = x - tau;
        sum -=
            0.5 * spread.ln() + (belief.alpha + 0.5) * (difference * difference / spread).ln_1p();
    }
    sum
}

/// How much each pixel's differences to those around it count in G of step 4: the two of an axis are averaged, those to
/// pixels that nobody saw or beyond the image do not count. The same for every channel.
#[derive(Debug, Default)]
pub struct EdgeWeights {
    /// Above, left, right and below, a row each.
    rows: Vec<f32>,
}

/// A plane's row between its neighbours; `None` = beyond the image.
pub type RowAround<'a> = (Option<&'a [f32]>, &'a [f32], Option<&'a [f32]>);

impl EdgeWeights {
    /// From how many views saw the pixels.
    #[inline(always)]
    pub fn find(&mut self, (above, here, below): RowAround) {
        let width = here.len();
        self.rows.clear();
        self.rows.resize(4 * width, 0.0);
        let (above_left, right_below) = self.rows.split_at_mut(2 * width);
        let (above_weights, left_weights) = above_left.split_at_mut(width);
        let (right_weights, below_weights) = right_below.split_at_mut(width);
        let [above, below] =
            [(above, above_weights), (below, below_weights)].map(|(coverage, weights)| {
                if let Some(coverage) = coverage {
                    for ((weight, &there), &here) in weights.iter_mut().zip(coverage).zip(here) {
                        *weight = both_seen(here, there);
                    }
                }
                weights
            });
        average(above, below);
        if width < 2 {
            return;
        }
        let pairs = here.iter().zip(&here[1..]);
        let weights = right_weights.iter_mut().zip(&mut left_weights[1..]);
        for ((right, left), (&a, &b)) in weights.zip(pairs) {
            *right = both_seen(a, b);
            *left = *right;
        }
        average(left_weights, right_weights);
    }

    /// Mean squared one-sided difference of one plane in x plus that in y: G of step 4, squared grey levels a pixel.
    #[inline(always)]
    pub fn gradient(&self, (above, here, below): RowAround, gradient: &mut [f32]) {
        let width = gradient.len();
        // Beyond the image any row does, as it has no weight.
        let (above, below) = (above.unwrap_or(here), below.unwrap_or(here));
        let (above, here, below) = (&above[..width], &here[..width], &below[..width]);
        let [above_weight, left_weight, right_weight, below_weight] =
            [0, 1, 2, 3].map(|side| &self.rows[side * width..][..width]);
        for x in 0..width {
            gradient[x] = squared(here[x], above[x]) * above_weight[x]
                + squared(here[x], below[x]) * below_weight[x];
        }
        if width < 2 {
            return;
        }
        // Slices of one length, so that no step has to be checked.
        let inner = width - 2;
        let [left, right] = [0, 2].map(|first| &here[first..][..inner]);
        let [left_weight, right_weight] =
            [left_weight, right_weight].map(|weight| &weight[1..][..inner]);
        let (middle, sums) = (&here[1..][..inner], &mut gradient[1..][..inner]);
        for x in 0..inner {
            sums[x] += squared(middle[x], left[x]) * left_weight[x]
                + squared(middle[x], right[x]) * right_weight[x];
        }
        let [first_weight, last_weight] = [self.rows[2 * width], self.rows[2 * width - 1]];
        gradient[0] += squared(here[0], here[1]) * first_weight;
        gradient[width - 1] += squared(here[width - 1], here[width - 2]) * last_weight;
    }
}

#[inline(always)]
fn both_seen(a: f32, b: f32) -> f32 {
    if (a > 0.0) & (b > 0.0) { 1.0 } else { 0.0 }
}

/// Where both count, each does by half.
#[inline(always)]
fn average(a: &mut [f32], b: &mut [f32]) {
    for (a, b) in a.iter_mut().zip(b) {
        let share = if *a + *b > 1.0 { 0.5 } else { 1.0 };
        *a *= share;
        *b *= share;
    }
}

#[inline(always)]
fn squared(a: f32, b: f32) -> f32 {
    (a - b) * (a - b)
}
