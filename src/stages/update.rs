//! What an observation does to a belief (section III-A).
//!
//! Prior (as stored) and observation, grey levels -> posterior: (10) and (12) to (15). The exponent of (10) is bounded,
//! because it overflows after a change. Two additions are switches: (10) evaluated once more with the uncertainty after
//! the observation, for tau and sigma only; and an unseen pixel that starts at its observation.

use std::f32::consts::LOG2_E;

use crate::{
    config::{Settings, UnseenStart},
    lanes::{exp2, greatest, least, reciprocals},
    model::belief::{Belief, CHANNELS},
};

/// Where the exponent of (10), to base 2, is cut off: sigma_p has long reached its upper bound there.
const EXPONENT_MAX: f32 = 115.0;
/// An unseen pixel's belief at its observation: settled enough not to be thrown by the next, open enough to follow it.
const START_ALPHA: f32 = 1.3;
const START_SIGMA: f32 = 0.8;

#[derive(Debug, Clone, Copy)]
pub struct UpdateRules {
    pub forgetting: f32,
    pub xi: f32,
    pub sigma_min: f32,
    pub sigma_max: f32,
    pub second_look: bool,
    pub unseen_start: UnseenStart,
    pub unseen_variance: f32,
}

#[inline(always)]
fn each(value: impl Fn(usize) -> f32) -> [f32; CHANNELS] {
    [value(0), value(1), value(2)]
}

/// What a belief says of each channel.
#[derive(Debug, Clone, Copy)]
pub struct Channels {
    pub beta: [f32; CHANNELS],
    pub tau: [f32; CHANNELS],
    pub sigma: [f32; CHANNELS],
}

impl From<&Belief> for Channels {
    #[inline(always)]
    fn from(belief: &Belief) -> Self {
        Self {
            beta: belief.beta,
            tau: belief.tau,
            sigma: belief.sigma,
        }
    }
}

impl UpdateRules {
    pub fn new(settings: &Settings) -> Self {
        Self {
            forgetting: settings.forgetting,
            xi: settings.xi,
            sigma_min: settings.sigma_min,
            sigma_max: settings.sigma_max,
            second_look: settings.second_look,
            unseen_start: settings.unseen_start,
            unseen_variance: settings.unseen_variance,
        }
    }

    /// (12)
    #[inline(always)]
    pub fn alpha(&self, alpha0: f32) -> f32 {
        self.forgetting * alpha0 + 0.5
    }

    /// (10): the uncertainty `beta / alpha` decides how far the expectation may move.
    #[inline(always)]
    pub fn sigma_p(&self, sigma0: f32, uncertainty: f32) -> f32 {
        // Neither xi nor an uncertainty is negative.
        let grown = sigma0 * exp2(least(self.xi * LOG2_E * uncertainty, EXPONENT_MAX));
        least(greatest(grown, self.sigma_min), self.sigma_max)
    }

    /// The three channels: prior with alpha0, beta0, tau0, sigma0 and observation -> beta, tau, sigma, (13) to (15).
    #[inline(always)]
    pub fn channels(&self, alpha0: f32, prior: &Channels, observed: [f32; CHANNELS]) -> Channels {
        let per_alpha = 1.0 / alpha0;
        let mut sigma_p = each(|c| self.sigma_p(prior.sigma[c], prior.beta[c] * per_alpha));
        let mut share = reciprocals(sigma_p.map(|sigma_p| sigma_p + 1.0));
        let difference = each(|c| observed[c] - prior.tau[c]);
        let beta = each(|c| {
            self.forgetting * prior.beta[c] + 0.5 * difference[c] * difference[c] * share[c]
        });
        if self.second_look {
            let per_alpha = 1.0 / self.alpha(alpha0);
            sigma_p = each(|c| self.sigma_p(prior.sigma[c], beta[c] * per_alpha));
            share = reciprocals(sigma_p.map(|sigma_p| sigma_p + 1.0));
        }
        // (14) as a step from tau0: no digits are lost when little moves.
        let sigma = each(|c| sigma_p[c] * share[c]);
        Channels {
            beta,
            tau: each(|c| prior.tau[c] + sigma[c] * difference[c]),
            sigma,
        }
    }

    /// The whole belief of a pixel. The earlier appearance is left as it was.
    pub fn belief(&self, prior: &Belief, observed: [f32; CHANNELS]) -> Belief {
        let Channels { beta, tau, sigma } = self.channels(prior.alpha, &prior.into(), observed);
        Belief {
            alpha: self.alpha(prior.alpha),
            beta,
            tau,
            sigma,
            ..*prior
        }
    }

    /// A pixel that no viewpoint saw, after its first observation, if it starts there.
    pub fn start(&self, observed: [f32; CHANNELS]) -> Belief {
        Belief {
            alpha: START_ALPHA,
            beta: [START_ALPHA * self.unseen_variance; CHANNELS],
            tau: observed,
            sigma: [START_SIGMA; CHANNELS],
            tau2: [0.0; CHANNELS],
            p2: 0.0,
        }
    }

    /// What alpha can be in a stored or merged belief: it starts at 1 or 1.3 and settles at 0.5/(1-f).
    pub fn alpha_range(&self) -> (f32, f32) {
        let settled = 0.5 / (1.0 - self.forgetting);
        (settled.min(1.0), settled.max(START_ALPHA))
    }
}
