//! The reference itself is right: closed forms against integrals and against the equations as printed.

mod reference;

use reference::{
    Random,
    belief::{NormalGamma, Rules, T5, bayes, surprise, t1, t2, t3, t4},
    joint::Joint,
};
use statrs::function::gamma::{digamma, gamma};
use surprised::config::Settings;

fn any(random: &mut Random) -> NormalGamma {
    NormalGamma {
        alpha: random.uniform(1.0, 2.5),
        beta: random.log_uniform(0.5, 300.0),
        tau: random.uniform(-100.0, 255.0),
        sigma: random.log_uniform(0.05, 5.0),
    }
}

fn near(belief: &NormalGamma, random: &mut Random) -> NormalGamma {
    let sd = (belief.beta / belief.alpha).sqrt();
    NormalGamma {
        alpha: random.uniform(1.0, 2.5),
        beta: belief.beta * random.log_uniform(0.5, 2.0),
        tau: belief.tau + sd * random.uniform(-3.0, 3.0),
        sigma: random.log_uniform(0.05, 5.0),
    }
}

fn assert_near(got: f64, expected: f64, relative: f64) {
    let error = (got - expected).abs();
    assert!(
        error <= relative * expected.abs().max(1.0),
        "{got} is not {expected}"
    );
}

#[test]
fn the_density_integrates_to_one_and_has_the_papers_moment() {
    let mut random = Random(1);
    for _ in 0..4 {
        let belief = any(&mut random);
        assert_near(belief.expectation(|_, _| 1.0), 1.0, 1e-8);
        let m01 = belief.expectation(|_, lambda| lambda);
        assert_near(m01, belief.alpha / belief.beta, 1e-8);
    }
}

#[test]
fn the_closed_form_is_the_integral_of_the_divergence() {
    let mut random = Random(2);
    for _ in 0..6 {
        let prior = any(&mut random);
        let posterior = near(&prior, &mut random);
        let integral = posterior.expectation(|mu, lambda| {
            posterior.ln_density(mu, lambda) - prior.ln_density(mu, lambda)
        });
        assert_near(surprise(&posterior, &prior), integral, 1e-7);
    }
}

#[test]
fn each_term_is_the_equation_as_printed() {
    let mut random = Random(3);
    for _ in 0..1000 {
        let p0 = any(&mut random);
        let p = near(&p0, &mut random);
        let literal_t1 = ((p.beta.powf(p.alpha) * gamma(p0.alpha) * p0.sigma.sqrt())
            / (p0.beta.powf(p0.alpha) * gamma(p.alpha) * p.sigma.sqrt()))
        .ln();
        let literal_t2 = (p0.beta - p.beta) * (p.alpha / p.beta);
        let literal_t3 = (p.alpha - p0.alpha) * (digamma(p.alpha) - p.beta.ln());
        let square = p0.tau * p0.tau - 2.0 * p0.tau * p.tau + p.tau * p.tau;
        let literal_t4 = 1.0 / (2.0 * p0.sigma) * (square * (p.alpha / p.beta) + p.sigma);
        assert_near(t1(&p, &p0), literal_t1, 1e-10);
        assert_near(t2(&p, &p0), literal_t2, 1e-12);
        assert_near(t3(&p, &p0), literal_t3, 1e-12);
        assert_near(t4(&p, &p0), literal_t4, 1e-6);
        let literal = literal_t1 + literal_t2 + literal_t3 + literal_t4 + T5;
        assert_near(surprise(&p, &p0), literal, 1e-6);
    }
}

#[test]
fn the_divergence_is_zero_for_itself_and_positive_for_others() {
    let mut random = Random(4);
    for _ in 0..10_000 {
        let belief = any(&mut random);
        assert!(surprise(&belief, &belief).abs() < 1e-12);
        assert!(surprise(&near(&belief, &mut random), &belief) > 0.0);
    }
}

#[test]
fn without_forgetting_the_update_is_bayes_rule() {
    let mut random = Random(5);
    // f = 1, and bounds that leave sigma_p = sigma0.
    let rules = Rules {
        f: 1.0,
        xi: 0.0,
        sigma_min: 0.0,
        sigma_max: 100.0,
        second_look: false,
    };
    for _ in 0..200 {
        let prior = any(&mut random);
        let x = prior.tau + random.uniform(-30.0, 30.0);
        let posterior = rules.posterior(&prior, x);
        assert_eq!(posterior, bayes(&prior, x));
        for _ in 0..20 {
            let mu = prior.tau + random.uniform(-30.0, 30.0);
            let lambda = random.log_uniform(1e-3, 1.0);
            let ln_likelihood =
                0.5 * (lambda / std::f64::consts::TAU).ln() - 0.5 * lambda * (x - mu) * (x - mu);
            let product = ln_likelihood + prior.ln_density(mu, lambda);
            // (5): proportional, and the factor is the predictive density.
            let expected = posterior.ln_density(mu, lambda) + prior.ln_predictive(x);
            assert_near(product, expected, 1e-9);
        }
    }
}

#[test]
fn the_predictive_density_is_the_integral_of_the_likelihood() {
    let mut random = Random(6);
    for _ in 0..4 {
        let belief = any(&mut random);
        let x = belief.tau + random.uniform(-20.0, 20.0);
        let integral = belief.expectation(|mu, lambda| {
            (lambda / std::f64::consts::TAU).sqrt() * (-0.5 * lambda * (x - mu) * (x - mu)).exp()
        });
        assert_near(belief.ln_predictive(x), integral.ln(), 1e-6);
    }
}

#[test]
fn the_joint_surprise_is_the_integral_over_appearance_and_parameters() {
    let rules = Rules::new(&Settings::robust());
    let mut random = Random(7);
    for p in [0.05, 0.45, 0.55] {
        let first = any(&mut random);
        let second = near(&first, &mut random);
        let x = random.uniform(first.tau.min(second.tau), first.tau.max(second.tau));
        let joint = Joint::observe([(1.0 - p, [first]), (p, [second])], [x], &rules);
        let integral: f64 = joint
            .posterior
            .iter()
            .zip(&joint.prior)
            .map(|((rho, [after]), (p, [before]))| {
                rho * after.expectation(|mu, lambda| {
                    (rho.ln() + after.ln_density(mu, lambda))
                        - (p.ln() + before.ln_density(mu, lambda))
                })
            })
            .sum();
        assert_near(joint.surprise(), integral, 1e-7);
        let weights = joint.posterior[0].0 + joint.posterior[1].0;
        assert_near(weights, 1.0, 1e-12);
    }
}
