//! What an observation does to a belief (section III-A).
//!
//! Prior (as stored) and observation, grey levels -> posterior: (10) and (12) to (15). The exponent of (10) is bounded,
//! because it overflows after a change. Two additions are switches: (10) evaluated once more with the uncertainty after
//! the observation, for tau and sigma only; and an unseen pixel that starts at its observation.

use crate::{
    config::{Settings, UnseenStart},
    lanes::exp,
    model::belief::{Belief, CHANNELS},
};

/// Where the exponent of (10) is cut off: sigma_p has long reached its upper bound there.
const EXPONENT_MAX: f32 = 80.0;
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
        let grown = sigma0 * exp((self.xi * uncertainty).min(EXPONENT_MAX));
        grown.max(self.sigma_min).min(self.sigma_max)
    }

    /// One channel: (beta0, tau0, sigma0) and the observation -> (beta, tau, sigma), (13) to (15).
    #[inline(always)]
    pub fn channel(&self, alpha0: f32, prior: (f32, f32, f32), observed: f32) -> (f32, f32, f32) {
        let (beta0, tau0, sigma0) = prior;
        let difference = observed - tau0;
        let mut sigma_p = self.sigma_p(sigma0, beta0 / alpha0);
        let mut share = 1.0 / (sigma_p + 1.0);
        let beta = self.forgetting * beta0 + 0.5 * difference * difference * share;
        if self.second_look {
            sigma_p = self.sigma_p(sigma0, beta / self.alpha(alpha0));
            share = 1.0 / (sigma_p + 1.0);
        }
        // (14) as a step from tau0: no digits are lost when little moves.
        let sigma = sigma_p * share;
        (beta, tau0 + sigma * difference, sigma)
    }

    /// The whole belief of a pixel. The earlier appearance is left as it was.
    pub fn belief(&self, prior: &Belief, observed: [f32; CHANNELS]) -> Belief {
        let mut posterior = Belief {
            alpha: self.alpha(prior.alpha),
            ..*prior
        };
        for (c, observed) in observed.into_iter().enumerate() {
            let channel = (prior.beta[c], prior.tau[c], prior.sigma[c]);
            (posterior.beta[c], posterior.tau[c], posterior.sigma[c]) =
                self.channel(prior.alpha, channel, observed);
        }
        posterior
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
