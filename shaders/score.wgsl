// Twin of src/engine/cpu/score.rs: what is particular about a pixel, and what its posterior remembers.

const CHANGED_VARIANCE_LOW: f32 = 60.0;
const CHANGED_VARIANCE_HIGH: f32 = 400.0;
const CHANGED_SIGMA: f32 = 0.8;

struct Settled {
    surprise: f32,
    posterior: Belief,
}

fn changed(stored: Belief, alpha: f32, tau: vec3<f32>, p2: f32) -> Belief {
    let variance = clamp(stored.beta / stored.alpha, vec3<f32>(CHANGED_VARIANCE_LOW), vec3<f32>(CHANGED_VARIANCE_HIGH));
    return Belief(alpha, alpha * variance, tau, vec3<f32>(CHANGED_SIGMA), stored.tau, p2);
}

/// Steps 5 and 6 where a pixel has an earlier appearance or gets one.
fn two_appearances(stored: Belief, widened: Belief, observed: vec3<f32>, surprise1: f32, posterior: Belief) -> Settled {
    var joint = vec2<f32>(surprise1, 0.0);
    if stored.p2 > P2_MIN {
        joint = joint_surprise(widened, observed, surprise1);
    }
    let rho2 = joint.y;
    var settled = Settled(joint.x, posterior);
    if rho2 > 0.5 {
        // What was there before is back: the two change places.
        let tau = (observed + stored.tau2) / 2.0;
        settled.posterior = changed(stored, posterior.alpha, tau, 0.5 * (1.0 - stored.p2));
    } else if joint.x > rules.surprise_threshold {
        settled.posterior = changed(stored, posterior.alpha, observed, 0.5);
    } else {
        settled.posterior.tau2 = stored.tau2;
        settled.posterior.p2 = 0.5 * stored.p2 + 0.5 * rho2;
    }
    if settled.posterior.p2 < P2_MIN {
        settled.posterior.p2 = 0.0;
    }
    return settled;
}

/// One pixel's surprise and posterior; `edge` is the squared gradient of tau.
fn settle(stored: Belief, coverage: f32, edge: vec3<f32>, observed: vec3<f32>) -> Settled {
    let unseen = coverage == 0.0;
    if unseen && rules.starts_at_observation != 0u {
        return Settled(0.0, start(observed));
    }
    var posterior = belief_after(stored, observed);
    posterior.tau2 = vec3<f32>(0.0);
    posterior.p2 = 0.0;
    if unseen {
        return Settled(0.0, posterior);
    }
    var widened = stored;
    widened.beta += stored.alpha * rules.edge_variance_px * edge;
    let surprise = surprise_of(widened, belief_after(widened, observed), observed);
    if rules.earlier_appearance != 0u && (stored.p2 > P2_MIN || surprise > rules.surprise_threshold) {
        return two_appearances(stored, widened, observed, surprise, posterior);
    }
    return Settled(surprise, posterior);
}
