//! One channel's belief: normal-gamma density (2), posterior (6) to (9) and (12) to (15), surprise (16) to (21).

use statrs::function::gamma::{digamma, ln_gamma};
use surprised::config::Settings;

/// (2): `lambda ~ Gamma(alpha, rate beta)`, `mu | lambda ~ N(tau, sigma/lambda)`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NormalGamma {
    pub alpha: f64,
    pub beta: f64,
    pub tau: f64,
    pub sigma: f64,
}

impl NormalGamma {
    /// ln of (2) with (3); the root in (3) covers `2 pi sigma` (misprint).
    pub fn ln_density(&self, mu: f64, lambda: f64) -> f64 {
        let Self {
            alpha,
            beta,
            tau,
            sigma,
        } = *self;
        let ln_kappa =
            alpha * beta.ln() - ln_gamma(alpha) - 0.5 * (2.0 * std::f64::consts::PI * sigma).ln();
        ln_kappa + (alpha - 0.5) * lambda.ln()
            - beta * lambda
            - lambda * (mu - tau) * (mu - tau) / (2.0 * sigma)
    }

    /// ln of the density of the next observation: Student's t with `2 alpha` degrees of freedom.
    pub fn ln_predictive(&self, x: f64) -> f64 {
        let freedom = 2.0 * self.alpha;
        let scale2 = self.beta * (1.0 + self.sigma) / self.alpha;
        let z2 = (x - self.tau) * (x - self.tau) / scale2;
        ln_gamma((freedom + 1.0) / 2.0)
            - ln_gamma(freedom / 2.0)
            - 0.5 * (freedom * std::f64::consts::PI * scale2).ln()
            - (freedom + 1.0) / 2.0 * (z2 / freedom).ln_1p()
    }

    /// The expectation of any function, by the trapezoidal rule in ln lambda and in standard deviations of mu.
    pub fn expectation(&self, value: impl Fn(f64, f64) -> f64) -> f64 {
        let (steps_lambda, steps_mu) = (600, 200);
        let (low, high) = (-40.0, 6.0);
        let step_lambda = (high - low) / f64::from(steps_lambda);
        let step_mu = 24.0 / f64::from(steps_mu);
        let mut sum = 0.0;
        for i in 0..=steps_lambda {
            let lambda = (low + f64::from(i) * step_lambda).exp() * self.alpha / self.beta;
            let sd = (self.sigma / lambda).sqrt();
            for j in 0..=steps_mu {
                let mu = self.tau + sd * (-12.0 + f64::from(j) * step_mu);
                let mass = self.ln_density(mu, lambda).exp() * lambda * step_lambda * sd * step_mu;
                if mass > 0.0 {
                    sum += mass * value(mu, lambda);
                }
            }
        }
        sum
    }
}

#[derive(Debug, Clone, Copy)]
pub struct Rules {
    pub f: f64,
    pub xi: f64,
    pub sigma_min: f64,
    pub sigma_max: f64,
    /// Step 5: (10) once more after the observation, for tau and sigma.
    pub second_look: bool,
}

impl Rules {
    pub fn new(settings: &Settings) -> Self {
        Self {
            f: settings.forgetting.into(),
            xi: settings.xi.into(),
            sigma_min: settings.sigma_min.into(),
            sigma_max: settings.sigma_max.into(),
            second_look: settings.second_look,
        }
    }

    /// (10), the exponent bounded.
    fn sigma_p(&self, sigma0: f64, beta: f64, alpha: f64) -> f64 {
        (sigma0 * (self.xi * beta / alpha).min(80.0).exp())
            .max(self.sigma_min)
            .min(self.sigma_max)
    }

    /// (12) to (15).
    pub fn posterior(&self, prior: &NormalGamma, x: f64) -> NormalGamma {
        let sigma_p = self.sigma_p(prior.sigma, prior.beta, prior.alpha);
        let alpha = self.f * prior.alpha + 0.5;
        let beta = self.f * prior.beta + 0.5 * (x - prior.tau).powi(2) / (sigma_p + 1.0);
        let sigma_p = if self.second_look {
            self.sigma_p(prior.sigma, beta, alpha)
        } else {
            sigma_p
        };
        NormalGamma {
            alpha,
            beta,
            tau: (sigma_p * x + prior.tau) / (sigma_p + 1.0),
            sigma: sigma_p / (sigma_p + 1.0),
        }
    }
}

/// (6) to (9).
pub fn bayes(prior: &NormalGamma, x: f64) -> NormalGamma {
    NormalGamma {
        alpha: prior.alpha + 0.5,
        beta: prior.beta + 0.5 * (x - prior.tau).powi(2) / (prior.sigma + 1.0),
        tau: (prior.sigma * x + prior.tau) / (prior.sigma + 1.0),
        sigma: prior.sigma / (prior.sigma + 1.0),
    }
}

/// (17), the logarithm taken apart: the powers overflow.
pub fn t1(posterior: &NormalGamma, prior: &NormalGamma) -> f64 {
    posterior.alpha * posterior.beta.ln() + ln_gamma(prior.alpha) + 0.5 * prior.sigma.ln()
        - prior.alpha * prior.beta.ln()
        - ln_gamma(posterior.alpha)
        - 0.5 * posterior.sigma.ln()
}

/// (18)
pub fn t2(posterior: &NormalGamma, prior: &NormalGamma) -> f64 {
    (prior.beta - posterior.beta) * posterior.alpha / posterior.beta
}

/// (19)
pub fn t3(posterior: &NormalGamma, prior: &NormalGamma) -> f64 {
    (posterior.alpha - prior.alpha) * (digamma(posterior.alpha) - posterior.beta.ln())
}

/// (20), the square put together: no digits are lost when little moved.
pub fn t4(posterior: &NormalGamma, prior: &NormalGamma) -> f64 {
    let moved2 = (posterior.tau - prior.tau).powi(2);
    (moved2 * posterior.alpha / posterior.beta + posterior.sigma) / (2.0 * prior.sigma)
}

/// (21)
pub const T5: f64 = -0.5;

/// (16): the Kullback-Leibler divergence of posterior and prior, nats.
pub fn surprise(posterior: &NormalGamma, prior: &NormalGamma) -> f64 {
    t1(posterior, prior) + t2(posterior, prior) + t3(posterior, prior) + t4(posterior, prior) + T5
}
