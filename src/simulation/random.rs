//! Reproducible chance: everything random in the simulation is a function of a seed and of what it is for.
//!
//! PCG's output is fixed by its definition; the conversion to numbers is written out here because that of `rand` may
//! change between its releases, and recordings must stay the same.

use rand_pcg::{
    Pcg64Mcg,
    rand_core::{Rng, SeedableRng},
};

/// A stream of numbers.
#[derive(Debug, Clone)]
pub struct Stream(Pcg64Mcg);

impl Stream {
    /// The stream for one purpose: equal keys give equal streams, different keys unrelated ones.
    pub fn new(seed: u64, key: &[u64]) -> Self {
        Self(Pcg64Mcg::seed_from_u64(
            key.iter()
                .fold(mix(seed), |state, &part| mix(state ^ mix(part))),
        ))
    }

    /// 0 <= x < 1, 53 bits.
    pub fn uniform(&mut self) -> f64 {
        (self.0.next_u64() >> 11) as f64 * (1.0 / (1u64 << 53) as f64)
    }

    /// `low <= x < high`.
    pub fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.uniform()
    }

    /// Of `0..count`; `count` is small against 2^64, so that the bias of the remainder does not matter.
    pub fn below(&mut self, count: u64) -> u64 {
        self.0.next_u64() % count
    }

    /// Mean 0, standard deviation 1 (Box and Muller).
    pub fn normal(&mut self) -> f64 {
        // 1 - x lies in (0, 1]: its logarithm is finite.
        let radius = (-2.0 * (1.0 - self.uniform()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.uniform()).cos()
    }

    /// As [`Self::normal`] but quick and without tails beyond 3.5: the sum of four uniform numbers. For pixels.
    #[inline]
    pub fn nearly_normal(&mut self) -> f32 {
        let bits = self.0.next_u64();
        let sum: u64 = (0..4).map(|part| (bits >> (16 * part)) & 0xffff).sum();
        // Mean 4 * 65535 / 2, variance 4 * (65536^2 - 1) / 12.
        (sum as f32 - 131_070.0) * (1.732_050_8 / 65_536.0)
    }
}

/// Finaliser of SplitMix64: a permutation of the 64-bit numbers in which every bit depends on every bit.
fn mix(value: u64) -> u64 {
    let value = value.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let value = (value ^ (value >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let value = (value ^ (value >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    value ^ (value >> 31)
}

/// A smooth wandering in -1..1: random values at whole `time`, joined with continuous slope. It never repeats.
pub fn wander(seed: u64, key: u64, time: f64) -> f64 {
    let step = time.floor();
    let value = |offset: f64| {
        // Negative times wrap; they are as good a key as any other.
        Stream::new(seed, &[key, (step + offset) as i64 as u64]).between(-1.0, 1.0)
    };
    let x = time - step;
    let blend = x * x * (3.0 - 2.0 * x);
    value(0.0) * (1.0 - blend) + value(1.0) * blend
}
