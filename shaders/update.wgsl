// Twin of src/stages/update.rs: what an observation does to a belief, (10) and (12) to (15).

const EXPONENT_MAX: f32 = 115.0;
const START_ALPHA: f32 = 1.3;
const START_SIGMA: f32 = 0.8;

/// beta, tau and sigma of one channel.
struct Channel {
    beta: f32,
    tau: f32,
    sigma: f32,
}

/// (12)
fn alpha_after(alpha0: f32) -> f32 {
    return rules.forgetting * alpha0 + 0.5;
}

/// (10)
fn sigma_p_of(sigma0: f32, uncertainty: f32) -> f32 {
    let grown = sigma0 * exp2_of(min(rules.xi * LOG2_E * uncertainty, EXPONENT_MAX));
    return min(max(grown, rules.sigma_min), rules.sigma_max);
}

/// (13) to (15)
fn channel(alpha0: f32, prior: Channel, observed: f32) -> Channel {
    let difference = observed - prior.tau;
    var sigma_p = sigma_p_of(prior.sigma, prior.beta / alpha0);
    let beta = rules.forgetting * prior.beta + difference * difference / (2.0 * (sigma_p + 1.0));
    if rules.second_look != 0u {
        sigma_p = sigma_p_of(prior.sigma, beta / alpha_after(alpha0));
    }
    // (14) as a step from tau0: no digits are lost when little moves.
    let sigma = sigma_p / (sigma_p + 1.0);
    return Channel(beta, prior.tau + sigma * difference, sigma);
}

/// The whole belief of a pixel. The earlier appearance is left as it was.
fn belief_after(prior: Belief, observed: vec3<f32>) -> Belief {
    var posterior = prior;
    posterior.alpha = alpha_after(prior.alpha);
    for (var c = 0u; c < CHANNELS; c++) {
        let after = channel(prior.alpha, Channel(prior.beta[c], prior.tau[c], prior.sigma[c]), observed[c]);
        posterior.beta[c] = after.beta;
        posterior.tau[c] = after.tau;
        posterior.sigma[c] = after.sigma;
    }
    return posterior;
}

/// A pixel that no viewpoint saw, after its first observation, if it starts there.
fn start(observed: vec3<f32>) -> Belief {
    return Belief(
        START_ALPHA,
        vec3<f32>(START_ALPHA * rules.unseen_variance),
        observed,
        vec3<f32>(START_SIGMA),
        vec3<f32>(0.0),
        0.0,
    );
}
