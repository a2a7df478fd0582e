//! Values side by side, and `ln` and `exp` without branches or calls, so that a loop over pixels becomes vector code on any processor.
//! Single precision: relative error below 2e-7 over the ranges that beliefs take (tested against `f64`).

use std::f32::consts::LOG2_E;

/// Values a step: one AVX-512 register of f32.
pub const LANES: usize = 16;
pub type Lanes = [f32; LANES];

/// ln 2 in two parts, so that `exponent * LN2_HIGH` is exact.
const LN2_HIGH: f32 = 0.693_359_4;
const LN2_LOW: f32 = -2.121_944_4e-4;

/// Natural logarithm of a positive normal number.
#[inline(always)]
pub fn ln(x: f32) -> f32 {
    // Split into 2^exponent * m, sqrt(1/2) <= m < sqrt(2).
    let offset = x.to_bits().wrapping_sub(0x3f35_04f3);
    let exponent = (offset as i32) >> 23;
    let m = f32::from_bits(x.to_bits().wrapping_sub((exponent as u32) << 23)) - 1.0;
    let exponent = exponent as f32;
    // Minimax polynomial of (ln(1+m) - m + m^2/2) / m^3 (Cephes, logf).
    let mut p = 7.037_683_6e-2f32;
    p = p * m - 1.151_461e-1;
    p = p * m + 1.167_699_9e-1;
    p = p * m - 1.242_014_1e-1;
    p = p * m + 1.424_932_3e-1;
    p = p * m - 1.666_805_7e-1;
    p = p * m + 2.000_071_5e-1;
    p = p * m - 2.499_999_4e-1;
    p = p * m + 3.333_333e-1;
    let square = m * m;
    let tail = p * m * square + exponent * LN2_LOW - 0.5 * square;
    exponent * LN2_HIGH + (m + tail)
}

/// e^x for -87 <= x <= 87; clamped outside.
#[inline(always)]
pub fn exp(x: f32) -> f32 {
    let x = x.clamp(-87.0, 87.0);
    // Adding 1.5 * 2^23 rounds to the nearest integer, in the low bits.
    const ROUND: f32 = 12_582_912.0;
    let shifted = x * LOG2_E + ROUND;
    let n = shifted - ROUND;
    let r = x - n * LN2_HIGH - n * LN2_LOW;
    // Minimax polynomial of (e^r - 1 - r) / r^2 (Cephes, expf).
    let mut p = 1.987_569_1e-4f32;
    p = p * r + 1.398_199_9e-3;
    p = p * r + 8.333_452e-3;
    p = p * r + 4.166_579_6e-2;
    p = p * r + 1.666_666_5e-1;
    p = p * r + 5e-1;
    let fraction = p * r * r + r + 1.0;
    let scale = f32::from_bits(
        shifted
            .to_bits()
            .wrapping_sub(ROUND.to_bits())
            .wrapping_add(127)
            << 23,
    );
    fraction * scale
}

/// 1/x of a positive normal number, to 7e-6 of itself: where a division would cost more than all around it.
#[inline(always)]
pub fn reciprocal(x: f32) -> f32 {
    // Negating the exponent is within 6 %; each step of Newton's squares the error.
    let r = f32::from_bits(0x7ef3_11c7u32.wrapping_sub(x.to_bits()));
    let r = r * (2.0 - x * r);
    r * (2.0 - x * r)
}

/// A bit mask of the lanes for which something holds.
#[inline(always)]
pub fn bits(holds: impl Fn(usize) -> bool) -> u32 {
    let mut lanes = [0u32; LANES];
    for (lane, bit) in lanes.iter_mut().enumerate() {
        *bit = u32::from(holds(lane)) << lane;
    }
    lanes.iter().fold(0, |bits, bit| bits | bit)
}

/// Indices of the set bits, ascending.
#[inline(always)]
pub fn members(mut set: u32) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        (set != 0).then(|| {
            let index = set.trailing_zeros() as usize;
            set &= set - 1;
            index
        })
    })
}

/// Asks for the memory at `index` of a slice, or beyond it, before it is needed; nothing where there is no such
/// instruction.
#[inline(always)]
pub fn prefetch<T>(slice: &[T], index: usize) {
    let at = slice.as_ptr().wrapping_add(index);
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        // SAFETY: a prefetch of any address, valid or not, has no effect that can be seen.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(at.cast()) };
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = at;
}
