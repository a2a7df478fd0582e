//! The fast functions and the storage formats are as exact as they say.

mod reference;

use reference::Random;
use statrs::function::gamma::{digamma, ln_gamma};
use surprised::{
    config::Settings,
    lanes,
    model::belief::{
        Belief, CHANNELS, Record, SPREAD_MAX, SPREAD_MIN, f16_from_f32, f32_from_f16,
        rgb_from_ycbcr, ycbcr_from_rgb,
    },
    stages::{surprise::GammaTerm, update::UpdateRules},
};

#[test]
fn ln_is_exact_to_single_precision_over_all_normal_numbers() {
    let mut random = Random(1);
    for _ in 0..2_000_000 {
        let bits = 0x0080_0000 + random.below(0x7f80_0000 - 0x0080_0000) as u32;
        let x = f32::from_bits(bits);
        let expected = f64::from(x).ln();
        let error = (f64::from(lanes::ln(x)) - expected).abs();
        assert!(error <= 2e-7 * expected.abs(), "ln({x}) is not {expected}");
    }
    for x in [0.999_f32, 0.999_999, 1.000_001, 1.001] {
        let expected = f64::from(x).ln();
        assert!((f64::from(lanes::ln(x)) - expected).abs() <= 2e-7 * expected.abs());
    }
    assert_eq!(lanes::ln(1.0), 0.0);
}

#[test]
fn exp2_is_exact_to_single_precision_within_its_range() {
    let mut random = Random(2);
    for _ in 0..1_000_000 {
        let x = random.uniform(-126.0, 127.0) as f32;
        let expected = f64::from(x).exp2();
        let error = (f64::from(lanes::exp2(x)) - expected).abs();
        assert!(error <= 2e-7 * expected, "2^{x} is not {expected}");
    }
    for n in -126..=127 {
        assert_eq!(lanes::exp2(n as f32), (n as f32).exp2());
    }
}

/// By definition (IEEE 754 binary16).
fn f16_value(bits: u16) -> f64 {
    let (exponent, fraction) = (i32::from(bits >> 10), f64::from(bits & 0x3ff));
    if exponent == 0 {
        fraction * 2f64.powi(-24)
    } else {
        (1.0 + fraction / 1024.0) * 2f64.powi(exponent - 15)
    }
}

#[test]
fn every_non_negative_half_float_is_read_and_written_exactly() {
    for bits in 0..0x7c00u16 {
        let value = f32_from_f16(bits);
        assert_eq!(f64::from(value), f16_value(bits), "{bits:#06x}");
        assert_eq!(f16_from_f32(value), bits);
    }
}

#[test]
fn half_floats_round_to_nearest_and_ties_to_even() {
    for bits in 0..0x7bffu16 {
        let tie = ((f16_value(bits) + f16_value(bits + 1)) / 2.0) as f32;
        let even = bits + (bits & 1);
        assert_eq!(f16_from_f32(tie), even, "halfway above {bits:#06x}");
        // Below the smallest normal number single precision itself has no neighbours left to tell apart.
        if bits >= 0x0400 {
            assert_eq!(f16_from_f32(tie.next_down()), bits);
            assert_eq!(f16_from_f32(tie.next_up()), bits + 1);
        }
    }
    assert_eq!(f32_from_f16(f16_from_f32(SPREAD_MAX)), SPREAD_MAX);
    assert_eq!(f32_from_f16(f16_from_f32(SPREAD_MIN)), SPREAD_MIN);
}

#[test]
fn a_record_keeps_a_belief_to_half_a_step_and_clamps_what_it_cannot_hold() {
    let mut random = Random(3);
    for _ in 0..20_000 {
        let colour =
            |random: &mut Random| std::array::from_fn(|_| random.uniform(-128.0, 255.0) as f32);
        let belief = Belief {
            alpha: random.uniform(1.0, 5.0) as f32,
            beta: std::array::from_fn(|_| random.log_uniform(1e-6, 1e7) as f32),
            tau: colour(&mut random),
            sigma: std::array::from_fn(|_| random.log_uniform(0.04, 5.0) as f32),
            tau2: colour(&mut random),
            p2: random.uniform(0.05, 1.0) as f32,
        };
        let stored = Record::pack(&belief).unpack();
        let spread = |got: f32, given: f32| {
            let given = given.clamp(SPREAD_MIN, SPREAD_MAX);
            assert!((got - given).abs() <= given / 2048.0, "{got} {given}");
        };
        spread(stored.alpha, belief.alpha);
        spread(stored.p2, belief.p2);
        for c in 0..CHANNELS {
            spread(stored.beta[c], belief.beta[c]);
            spread(stored.sigma[c], belief.sigma[c]);
            assert!((stored.tau[c] - belief.tau[c]).abs() <= 0.5 / 128.0 + 2e-5);
            assert!((stored.tau2[c] - belief.tau2[c]).abs() <= 0.5 / 128.0 + 2e-5);
        }
        assert_eq!(
            Record::pack(&stored).unpack(),
            stored,
            "stored twice is stored once"
        );
    }
    let bright = Belief {
        tau: [400.0, -300.0, 0.0],
        ..Belief::default()
    };
    let stored = Record::pack(&bright).unpack();
    let brightest = f32::from(i16::MAX) / 128.0 + 128.0;
    assert_eq!(stored.tau, [brightest, -256.0, 0.0]);
    assert_eq!(size_of::<Record>(), 32);
}

#[test]
fn the_gamma_terms_are_exact_for_every_forgetting_factor() {
    for forgetting in [0.5, 0.6, 0.7, 0.8, 0.9] {
        let rules = UpdateRules::new(&Settings {
            forgetting,
            ..Settings::robust()
        });
        let gamma = GammaTerm::new(&rules);
        let (low, high) = rules.alpha_range();
        let f = f64::from(forgetting);
        let mut worst = 0.0f64;
        for step in 0..=10_000 {
            let alpha0 = low + (high - low) * step as f32 / 10_000.0;
            let a0 = f64::from(alpha0);
            let a = f * a0 + 0.5;
            let expected = ln_gamma(a0) - ln_gamma(a) + (a - a0) * digamma(a);
            worst = worst.max((f64::from(gamma.at(alpha0)) - expected).abs());
        }
        println!("f = {forgetting}: {worst:.1e}");
        assert!(worst < 1e-6, "f = {forgetting}: {worst:e}");
    }
}

#[test]
fn colours_are_transformed_as_jpeg_2000_does_and_back() {
    let mut random = Random(4);
    for _ in 0..100_000 {
        let rgb = [
            random.below(256) as u8,
            random.below(256) as u8,
            random.below(256) as u8,
        ];
        let [r, g, b] = rgb.map(f64::from);
        let [y, cb, cr] = ycbcr_from_rgb(rgb.map(f32::from)).map(f64::from);
        // ISO/IEC 15444-1, annex G.3, to the digits of the coefficients.
        assert!((y - (0.299 * r + 0.587 * g + 0.114 * b)).abs() < 1e-4);
        assert!((cb - 0.5 / (1.0 - 0.114) * (b - y)).abs() < 5e-3);
        assert!((cr - 0.5 / (1.0 - 0.299) * (r - y)).abs() < 5e-3);
        assert_eq!(rgb_from_ycbcr([y as f32, cb as f32, cr as f32]), rgb);
    }
    assert_eq!(ycbcr_from_rgb([0.0; 3]), [0.0; 3]);
    assert_eq!(rgb_from_ycbcr([300.0, 0.0, 0.0]), [255; 3]);
    assert_eq!(rgb_from_ycbcr([-20.0, 0.0, 0.0]), [0; 3]);
}
