//! How much an observation from somewhere would teach (section VI: "taking images preferably in regions where the
//! uncertainty is highest").
//!
//! Prior at a pose -> expected fall of the predictive variance, squared grey levels, summed over Y, Cb, Cr and averaged
//! over the image's pixels.
//!
//! A belief (alpha, beta, tau, sigma) has the expected variance v = beta/alpha (11). With sigma_p of (10) the next
//! observation spreads around tau with
//!
//! ```text
//! P0 = v (1 + sigma_p)
//! ```
//!
//! Of such an observation E[(x - tau)^2] = P0, so that by (12) and (13) the expected new variance is v again: f beta + v/2
//! over f alpha + 1/2. What falls is the uncertainty about the mean, by (15):
//!
//! ```text
//! P1 = v (1 + sigma_p/(1 + sigma_p))        P0 - P1 = v sigma_p^2 / (1 + sigma_p)
//! ```
//!
//! Through (10) it grows faster than v: the uncertain is worth looking at, the settled is not. Of an unseen pixel nothing
//! is known but that its value lies within 256 grey levels: V = 255^2/12 a channel. After its first observation it has
//! the predictive variance P1 of the belief that it starts with, so it promises V - P1.
//!
//! The paper gives no measure. Chosen here: no seen pixel promises more than an unseen one, because nothing spreads
//! farther than V; the earlier appearance is left out; where (10) is evaluated twice (step 5), it is evaluated at the
//! expected variance.

use nalgebra::{Translation3, UnitQuaternion, Vector3};

use crate::{
    config::UnseenStart,
    model::{belief::CHANNELS, pose::Pose},
    stages::{
        interpolate::{
            merge::UNSEEN,
            prior::{self, Prior},
        },
        update::UpdateRules,
    },
};

/// Variance of what may be anything from 0 to 255, squared grey levels.
const UNKNOWN_VARIANCE: f32 = 255.0 * 255.0 / 12.0;

/// What an observation from one pose is expected to tell.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Promise {
    /// Expected fall of the predictive variance, squared grey levels: summed over the channels, mean over all pixels.
    pub reduction: f64,
    /// The part of it that unseen pixels promise.
    pub reduction_unseen: f64,
    /// Expected variance (11), summed over the channels, mean over the seen pixels; 0 without any.
    pub uncertainty: f64,
    /// Share of the pixels that some viewpoint saw, 0..1.
    pub covered: f64,
}

/// What an unseen pixel promises, squared grey levels over all channels.
pub fn unseen_reduction(rules: &UpdateRules) -> f32 {
    let after = match rules.unseen_start {
        UnseenStart::Observation => {
            let start = rules.start([0.0; CHANNELS]);
            start.beta[0] / start.alpha * (1.0 + start.sigma[0])
        }
        // (1, 1, 0, 5) after one observation of anything.
        UnseenStart::Paper => {
            let observed = [UNKNOWN_VARIANCE.sqrt(); CHANNELS];
            let after = rules.belief(&UNSEEN, observed);
            after.beta[0] / after.alpha * (1.0 + after.sigma[0])
        }
    };
    CHANNELS as f32 * (UNKNOWN_VARIANCE - after).max(0.0)
}

/// What a seen pixel promises, squared grey levels over all channels; `beta` and `sigma` by channel.
#[inline(always)]
pub fn seen_reduction(
    rules: &UpdateRules,
    alpha: f32,
    beta: [f32; CHANNELS],
    sigma: [f32; CHANNELS],
) -> f32 {
    let mut sum = 0.0;
    for channel in 0..CHANNELS {
        let variance = beta[channel] / alpha;
        let sigma_p = rules.sigma_p(sigma[channel], variance);
        sum += variance * sigma_p * sigma_p / (1.0 + sigma_p);
    }
    sum
}

/// What an observation where this prior was recalled is expected to tell.
pub fn promise(prior: &Prior, rules: &UpdateRules) -> Promise {
    let of_unseen = unseen_reduction(rules);
    let (mut seen, mut reduction, mut uncertainty) = (0usize, 0.0f64, 0.0f64);
    for y in 0..prior.height {
        let row = prior.row(y);
        let coverage = row.plane(prior::COVERAGE);
        for x in (0..prior.width).filter(|&x| coverage[x] > 0.0) {
            let belief = row.belief(x);
            seen += 1;
            let of_seen = seen_reduction(rules, belief.alpha, belief.beta, belief.sigma);
            reduction += f64::from(of_seen.min(of_unseen));
            uncertainty += f64::from(belief.beta.iter().sum::<f32>() / belief.alpha);
        }
    }
    let pixels = (prior.width * prior.height).max(1);
    let unseen = pixels.saturating_sub(seen) as f64 * f64::from(of_unseen);
    Promise {
        reduction: (reduction + unseen) / pixels as f64,
        reduction_unseen: unseen / pixels as f64,
        uncertainty: uncertainty / seen.max(1) as f64,
        covered: seen as f64 / pixels as f64,
    }
}

/// `count` poses around `around`: turned about the camera's vertical axis by equal angles, to the right from straight
/// ahead on, then moved `radius_m` forward.
pub fn ring(around: &Pose, radius_m: f64, count: usize) -> Vec<Pose> {
    (0..count)
        .map(|index| {
            let angle_rad = std::f64::consts::TAU * index as f64 / count as f64;
            let turned = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), angle_rad);
            around * turned * Translation3::new(0.0, 0.0, radius_m)
        })
        .collect()
}
