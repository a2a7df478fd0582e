// Twin of src/stages/surprise.rs: the Kullback-Leibler divergence of posterior and prior, nats.

const DEGREE: u32 = 12u;
const P2_MIN: f32 = 0.05;
const EARLIER_VARIANCE: f32 = 100.0;
const EARLIER_SIGMA: f32 = 0.3;
const EARLIER_SHARE_LOW: f32 = 0.45;
const EARLIER_SHARE_HIGH: f32 = 0.55;

/// lnG(alpha0) - lnG(alpha) + (alpha - alpha0) psi(alpha)
fn gamma_at(alpha0: f32) -> f32 {
    let t = (alpha0 - rules.gamma_center) * rules.gamma_scale;
    var sum = 0.0;
    for (var power = i32(DEGREE); power >= 0; power--) {
        sum = sum * t + rules.gamma_coefficients[power / 4][power % 4];
    }
    return sum;
}

/// Per channel the parts of the surprise that need no logarithm, the ratio of beta and that of sigma.
fn channel_terms(alpha: f32, prior: Channel, posterior: Channel, deviation: f32) -> vec3<f32> {
    let expected_precision = alpha / posterior.beta;
    // tau - tau0 by (14): the difference of the two would have few digits left, which a small beta magnifies.
    let moved = posterior.sigma * deviation;
    let plain = (prior.beta - posterior.beta) * expected_precision
        + (moved * moved * expected_precision + posterior.sigma) / (2.0 * prior.sigma) - 0.5;
    return vec3<f32>(plain, posterior.beta / prior.beta, prior.sigma / posterior.sigma);
}

/// (16) to (23)
fn total(alpha0: f32, plain: f32, beta_ratios: f32, sigma_ratios: f32) -> f32 {
    let sum = plain + alpha0 * ln(beta_ratios) + 0.5 * ln(sigma_ratios) + f32(CHANNELS) * gamma_at(alpha0);
    // A divergence is never negative; rounding may be.
    return max(sum, 0.0);
}

/// The surprise of a belief with one appearance.
fn surprise_of(prior: Belief, posterior: Belief, observed: vec3<f32>) -> f32 {
    var plain = 0.0;
    var ratios = vec2<f32>(1.0);
    for (var c = 0u; c < CHANNELS; c++) {
        let terms = channel_terms(
            posterior.alpha,
            Channel(prior.beta[c], prior.tau[c], prior.sigma[c]),
            Channel(posterior.beta[c], posterior.tau[c], posterior.sigma[c]),
            observed[c] - prior.tau[c],
        );
        plain += terms.x;
        ratios *= terms.yz;
    }
    return total(prior.alpha, plain, ratios.x, ratios.y);
}

/// The belief that the earlier appearance stands for.
fn earlier_belief(prior: Belief) -> Belief {
    return Belief(
        prior.alpha,
        vec3<f32>(prior.alpha * EARLIER_VARIANCE),
        prior.tau2,
        vec3<f32>(EARLIER_SIGMA),
        prior.tau2,
        prior.p2,
    );
}

fn share_term(rho: f32, p: f32, surprise: f32) -> f32 {
    if rho > 0.0 {
        return rho * (ln(rho / p) + surprise);
    }
    return 0.0;
}

/// Surprise of the joint belief, and how much the observation speaks for the earlier appearance.
fn joint_surprise(prior: Belief, observed: vec3<f32>, surprise1: f32) -> vec2<f32> {
    let earlier = earlier_belief(prior);
    let surprise2 = surprise_of(earlier, belief_after(earlier, observed), observed);
    let p2 = clamp(prior.p2, EARLIER_SHARE_LOW, EARLIER_SHARE_HIGH);
    let p1 = 1.0 - p2;
    let log_odds = log_predictive(earlier, observed) - log_predictive(prior, observed) + ln(p2 / p1);
    let rho2 = 1.0 / (1.0 + exp2_of(clamp(-LOG2_E * log_odds, -126.0, 127.0)));
    let rho1 = 1.0 - rho2;
    let sum = share_term(rho1, p1, surprise1) + share_term(rho2, p2, surprise2);
    return vec2<f32>(max(sum, 0.0), rho2);
}

/// Logarithm of the predictive density, up to what depends on alpha alone.
fn log_predictive(belief: Belief, observed: vec3<f32>) -> f32 {
    var sum = 0.0;
    for (var c = 0u; c < CHANNELS; c++) {
        // 2 alpha times the squared scale.
        let spread = 2.0 * belief.beta[c] * (1.0 + belief.sigma[c]);
        let difference = observed[c] - belief.tau[c];
        sum -= 0.5 * ln(spread) + (belief.alpha + 0.5) * ln_1p(difference * difference / spread);
    }
    return sum;
}

/// Squared one-sided difference to a neighbour, and 1 if both were seen, else 0.
fn squared(here: vec4<f32>, neighbour: vec4<f32>) -> vec4<f32> {
    let both = select(0.0, 1.0, here.w > 0.0 && neighbour.w > 0.0);
    let difference = here.xyz - neighbour.xyz;
    return vec4<f32>(difference * difference * both, both);
}

/// Mean squared one-sided difference of tau in x plus that in y: G of step 4. A place is (tau, coverage); 0 beyond the
/// image.
fn edge_gradient(here: vec4<f32>, left: vec4<f32>, right: vec4<f32>, up: vec4<f32>, down: vec4<f32>) -> vec3<f32> {
    let x = squared(here, left) + squared(here, right);
    let y = squared(here, up) + squared(here, down);
    return x.xyz / max(x.w, 1.0) + y.xyz / max(y.w, 1.0);
}
