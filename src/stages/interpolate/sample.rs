//! One pixel of a view's map: where in the viewpoint it comes from, and how far away it is, in one word.

use crate::lanes::LANES;

/// A pixel of the map: `inverse depth (24 bit) | v (20 bit) | u (20 bit)`; 0 = the viewpoint does not see it.
pub type Sample = u64;

/// Steps of u and v per source pixel: half a step times the steepest edge stays below a grey level.
pub const STEPS: f32 = 128.0;
pub const POSITION_BITS: u32 = 20;
const POSITION_MASK: u32 = (1 << POSITION_BITS) - 1;
/// The largest width and height that u and v can address.
pub const SIDE_MAX: usize = 1 << (POSITION_BITS - 7);
/// Of a positive `f32` the sign is 0 and 7 bits of the mantissa are left out: depth to 1.5e-5 of itself.
pub const INVERSE_DEPTH_SHIFT: u32 = 7;
/// 2^23: adding it leaves a non-negative number's nearest integer in the mantissa.
pub const INTEGER: f32 = 8_388_608.0;
pub const INTEGER_MASK: u32 = (1 << 23) - 1;

/// Samples of the map of a strip of so many pixels: steps of sixteen may reach beyond the last.
pub fn map_size(pixels: usize) -> usize {
    pixels + LANES
}

/// Where it lies and how far away it is, 1/metres; u and v in source pixels.
#[inline(always)]
pub fn pack(inverse_depth: f32, u: f32, v: f32) -> Sample {
    let steps =
        |position: f32| u64::from((position.max(0.0) * STEPS + INTEGER).to_bits() & INTEGER_MASK);
    (u64::from(inverse_depth.to_bits() >> INVERSE_DEPTH_SHIFT) << (2 * POSITION_BITS))
        | (steps(v) << POSITION_BITS)
        | steps(u)
}

/// The lower and the upper half of a sample -> u and v in steps, 1/depth.
#[inline(always)]
pub fn split(low: u32, high: u32) -> (u32, u32, f32) {
    const OF_V: u32 = 2 * POSITION_BITS - 32;
    let u = low & POSITION_MASK;
    let v = (low >> POSITION_BITS) | ((high << (32 - OF_V)) >> (POSITION_BITS - OF_V));
    let inverse_depth = f32::from_bits((high >> OF_V) << INVERSE_DEPTH_SHIFT);
    (u, v, inverse_depth)
}
