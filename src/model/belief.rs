//! What is believed about one pixel, and its storage record.
//!
//! A belief is a normal-gamma distribution over mean mu and precision lambda of a channel (eq. 2):
//! lambda ~ Gamma(alpha, rate beta), mu | lambda ~ N(tau, sigma/lambda). `sigma` scales the variance of the mean;
//! it is no standard deviation. `alpha` does not depend on the data, so one value serves Y, Cb and Cr.
//! A second appearance (`tau2`, with weight `p2`) remembers what was there before a change.

use crate::lanes::{LANES, Lanes, Planes, Transpose};

/// Y, Cb, Cr.
pub const CHANNELS: usize = 3;

/// Everything believed about one pixel, in working precision.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Belief {
    pub alpha: f32,
    pub beta: [f32; CHANNELS],
    /// Expected Y 0..255, Cb and Cr centred on 0.
    pub tau: [f32; CHANNELS],
    pub sigma: [f32; CHANNELS],
    /// What was there before; meaningless where `p2` is 0.
    pub tau2: [f32; CHANNELS],
    /// How much still speaks for `tau2`, 0..1.
    pub p2: f32,
}

impl Belief {
    /// Of a pixel about which nothing is known: anything from 0 to 255 is as likely. It is stored where something was
    /// forgotten, and lies on no surface.
    pub fn unknown() -> Self {
        const ALPHA: f32 = 1.0;
        const VARIANCE: f32 = 255.0 * 255.0 / 12.0;
        Self {
            alpha: ALPHA,
            beta: [ALPHA * VARIANCE; CHANNELS],
            tau: [127.5, 0.0, 0.0],
            sigma: [1.0; CHANNELS],
            tau2: [0.0; CHANNELS],
            p2: 0.0,
        }
    }
}

/// Sixteen beliefs with one appearance, a plane a value.
#[derive(Debug, Clone, Copy, Default)]
pub struct BeliefLanes {
    pub alpha: Lanes,
    pub beta: [Lanes; CHANNELS],
    pub tau: [Lanes; CHANNELS],
    pub sigma: [Lanes; CHANNELS],
}

impl BeliefLanes {
    pub fn at(&self, lane: usize) -> Belief {
        Belief {
            alpha: self.alpha[lane],
            beta: self.beta.map(|plane| plane[lane]),
            tau: self.tau.map(|plane| plane[lane]),
            sigma: self.sigma.map(|plane| plane[lane]),
            ..Belief::default()
        }
    }
}

/// A belief as stored: 32 bytes, so that one aligned load brings a pixel.
///
/// ```text
/// spread  f16   alpha  beta_y beta_cb beta_cr  sigma_y sigma_cb sigma_cr  p2
/// level   i16   tau_y tau_cb tau_cr  tau2_y tau2_cb tau2_cr  -  -          in 1/128, less LEVEL_OFFSET
/// ```
///
/// Fixed point for tau, because f16 at grey level 200 would change the surprise by 11 %. Luminance is stored around 128,
/// because an observation divided by the exposure gain reaches 255 / 0.7.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C, align(32))]
pub struct Record {
    pub spread: [u16; 8],
    pub level: [i16; 8],
}

/// Steps of stored tau and tau2 per grey level.
pub const LEVEL_SCALE: f32 = 128.0;
/// Grey level that is stored as 0, by lane.
pub const LEVEL_OFFSET: [f32; 8] = [128.0, 0.0, 0.0, 128.0, 0.0, 0.0, 0.0, 0.0];

/// Bounds of what f16 holds with full precision; beta leaves them on a perfectly still picture and after a change.
pub const SPREAD_MIN: f32 = 6.103_515_6e-5;
pub const SPREAD_MAX: f32 = 65_504.0;

impl Record {
    #[inline(always)]
    pub fn pack(belief: &Belief) -> Self {
        let [b0, b1, b2] = belief.beta;
        let [s0, s1, s2] = belief.sigma;
        let [t0, t1, t2] = belief.tau;
        let [e0, e1, e2] = belief.tau2;
        let spread = [belief.alpha, b0, b1, b2, s0, s1, s2]
            .map(|value| f16_from_f32(value.clamp(SPREAD_MIN, SPREAD_MAX)));
        let mut level = [0; 8];
        for (lane, value) in [t0, t1, t2, e0, e1, e2].into_iter().enumerate() {
            level[lane] = level_from(value - LEVEL_OFFSET[lane]);
        }
        Self {
            spread: [
                spread[0],
                spread[1],
                spread[2],
                spread[3],
                spread[4],
                spread[5],
                spread[6],
                f16_from_f32(belief.p2.clamp(0.0, 1.0)),
            ],
            level,
        }
    }

    /// The same bits as [`Self::pack`].
    #[inline(always)]
    pub fn pack_lanes<T: Transpose>(beliefs: &BeliefLanes, records: &mut [Self; LANES]) {
        // Two values a word, as records hold them side by side.
        let mut words: Planes = [[0; LANES]; 8];
        let BeliefLanes {
            alpha,
            beta,
            tau,
            sigma,
        } = beliefs;
        let spread = |value: f32| u32::from(f16_from_f32(value.clamp(SPREAD_MIN, SPREAD_MAX)));
        let level =
            |value: f32, k: usize| u32::from(level_from(value - LEVEL_OFFSET[k]).cast_unsigned());
        // The second appearance is at its stored zero.
        let none = level(0.0, CHANNELS) << 16;
        for lane in 0..LANES {
            words[0][lane] = spread(alpha[lane]) | (spread(beta[0][lane]) << 16);
            words[1][lane] = spread(beta[1][lane]) | (spread(beta[2][lane]) << 16);
            words[2][lane] = spread(sigma[0][lane]) | (spread(sigma[1][lane]) << 16);
            words[3][lane] = spread(sigma[2][lane]);
            words[4][lane] = level(tau[0][lane], 0) | (level(tau[1][lane], 1) << 16);
            words[5][lane] = level(tau[2][lane], 2) | none;
        }
        T::rows(&words, bytemuck::cast_mut(records));
    }

    /// Whether it is one that [`Self::pack`] may make: nothing of it is negative, infinite or no number.
    pub fn is_sound(&self) -> bool {
        const INFINITE: u16 = 0x7c00;
        self.spread.iter().all(|&value| value < INFINITE)
    }

    #[inline(always)]
    pub fn unpack(&self) -> Belief {
        let spread = self.spread.map(f32_from_f16);
        let mut level = self.level.map(|value| f32::from(value) / LEVEL_SCALE);
        for (level, offset) in level.iter_mut().zip(LEVEL_OFFSET) {
            *level += offset;
        }
        Belief {
            alpha: spread[0],
            beta: [spread[1], spread[2], spread[3]],
            sigma: [spread[4], spread[5], spread[6]],
            p2: spread[7],
            tau: [level[0], level[1], level[2]],
            tau2: [level[3], level[4], level[5]],
        }
    }
}

/// Nearest step, ties to even; saturates.
#[inline(always)]
fn level_from(value: f32) -> i16 {
    // 1.5 * 2^23: adding it leaves the nearest integer in the low bits.
    const ROUND: f32 = 12_582_912.0;
    let steps = (value * LEVEL_SCALE).clamp(i16::MIN.into(), i16::MAX.into());
    ((steps + ROUND).to_bits() as i32 - ROUND.to_bits() as i32) as i16
}

/// 2^112: the difference of the exponent biases of f32 and f16.
const BIAS_SCALE: f32 = f32::from_bits((127 + 112) << 23);

/// Of a non-negative f16. Two instructions in any vector width, on any processor; the sign is never needed here.
#[inline(always)]
pub fn f32_from_f16(bits: u16) -> f32 {
    f32::from_bits(u32::from(bits) << 13) * BIAS_SCALE
}

/// Nearest f16 of `0 <= value <= SPREAD_MAX`, ties to even.
#[inline(always)]
pub fn f16_from_f32(value: f32) -> u16 {
    let bits = (value * (1.0 / BIAS_SCALE)).to_bits();
    ((bits + 0x0fff + ((bits >> 13) & 1)) >> 13) as u16
}

/// JPEG 2000 irreversible colour transform of one RGB pixel, 0..255 -> Y 0..255, Cb and Cr centred on 0.
#[inline(always)]
pub fn ycbcr_from_rgb(rgb: [f32; 3]) -> [f32; CHANNELS] {
    let [r, g, b] = rgb;
    [
        0.299 * r + 0.587 * g + 0.114 * b,
        -0.168_75 * r - 0.331_26 * g + 0.5 * b,
        0.5 * r - 0.418_69 * g - 0.081_31 * b,
    ]
}

/// Its inverse, rounded and clipped to 0..255.
pub fn rgb_from_ycbcr(ycbcr: [f32; CHANNELS]) -> [u8; 3] {
    let [y, cb, cr] = ycbcr;
    [
        y + 1.402 * cr,
        y - 0.344_13 * cb - 0.714_14 * cr,
        y + 1.772 * cb,
    ]
    .map(|value| value.round().clamp(0.0, 255.0) as u8)
}
