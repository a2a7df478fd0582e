//! Values side by side, and `ln` and `exp2` without branches or calls, so that a loop over pixels becomes vector code on
//! any processor.
//! Single precision: relative error below 2e-7 over the ranges that beliefs take (tested against `f64`).

use std::f32::consts::LN_2;

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
    // In pairs: what comes next waits half as long.
    let square = m * m;
    let fourth = square * square;
    let highest =
        (7.037_683_6e-2f32 * m - 1.151_461e-1) * square + (1.167_699_9e-1f32 * m - 1.242_014_1e-1);
    let middle = (1.424_932_3e-1f32 * m - 1.666_805_7e-1) * square
        + (2.000_071_5e-1f32 * m - 2.499_999_4e-1);
    let p = (highest * fourth + middle) * m + 3.333_333e-1;
    let tail = p * m * square + exponent * LN2_LOW - 0.5 * square;
    exponent * LN2_HIGH + (m + tail)
}

/// The lesser and the greater of two: one instruction, where `min` and `max` take three to be sure of NaN.
#[inline(always)]
pub fn least(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

#[inline(always)]
pub fn greatest(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

/// 2^x for -126 <= x <= 127; anything outside.
#[inline(always)]
pub fn exp2(x: f32) -> f32 {
    // Adding 1.5 * 2^23 rounds to the nearest integer, in the low bits.
    const ROUND: f32 = 12_582_912.0;
    let shifted = x + ROUND;
    let f = x - (shifted - ROUND);
    // Minimax polynomial of 2^f, |f| <= 1/2, in pairs, so that nothing waits for all terms before it.
    let square = f * f;
    let high = 1.330_026_4e-3f32 * f + 9.669_708e-3;
    let middle = 5.550_56e-2f32 * f + 2.402_228_1e-1;
    let fraction = (high * square + middle) * square + LN_2 * f + 1.0;
    // Into the exponent.
    f32::from_bits(fraction.to_bits().wrapping_add(shifted.to_bits() << 23))
}

/// 1/x of a positive normal number, to 7e-6 of itself: where a division would cost more than all around it.
#[inline(always)]
pub fn reciprocal(x: f32) -> f32 {
    // Negating the exponent is within 6 %; each step of Newton's squares the error.
    let r = f32::from_bits(0x7ef3_11c7u32.wrapping_sub(x.to_bits()));
    let r = r * (2.0 - x * r);
    r * (2.0 - x * r)
}

/// 1/x of three positive numbers by one division. Their product must be a normal number.
#[inline(always)]
pub fn reciprocals([a, b, c]: [f32; 3]) -> [f32; 3] {
    let r = 1.0 / (a * b * c);
    [r * (b * c), r * (a * c), r * (a * b)]
}

/// The first values of a slice; of one that ends sooner, padding after them.
#[inline(always)]
pub fn load_or(padding: f32, values: &[f32]) -> Lanes {
    match values.first_chunk::<LANES>() {
        Some(lanes) => *lanes,
        None => {
            let mut lanes = [padding; LANES];
            lanes[..values.len()].copy_from_slice(values);
            lanes
        }
    }
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

/// Eight words of sixteen pixels: a row a pixel, or a plane a word.
pub type Rows = [[u32; 8]; LANES];
pub type Planes = [[u32; LANES]; 8];

/// Turns rows into planes and back.
pub trait Transpose {
    fn planes(rows: &Rows, planes: &mut Planes);
    fn rows(planes: &Planes, rows: &mut Rows);
}

/// For any processor.
pub struct Portable;

impl Transpose for Portable {
    #[inline(always)]
    fn planes(rows: &Rows, planes: &mut Planes) {
        for (k, plane) in planes.iter_mut().enumerate() {
            for (word, row) in plane.iter_mut().zip(rows) {
                *word = row[k];
            }
        }
    }

    #[inline(always)]
    fn rows(planes: &Planes, rows: &mut Rows) {
        for (lane, row) in rows.iter_mut().enumerate() {
            for (word, plane) in row.iter_mut().zip(planes) {
                *word = plane[lane];
            }
        }
    }
}

#[cfg(target_arch = "x86_64")]
pub use x86::Avx;

#[cfg(target_arch = "x86_64")]
mod x86 {
    use std::arch::x86_64::*;

    use super::{Planes, Rows, Transpose};

    /// With AVX2: only for kernels that are compiled for it.
    pub struct Avx;

    impl Transpose for Avx {
        #[inline(always)]
        fn planes(rows: &Rows, planes: &mut Planes) {
            // SAFETY: `Avx` is only named in kernels that are compiled for AVX2.
            unsafe {
                for half in 0..2 {
                    let eight = transpose(std::array::from_fn(|k| load(&rows[8 * half + k])));
                    for (plane, word) in planes.iter_mut().zip(eight) {
                        let half = plane.as_chunks_mut::<8>().0.get_unchecked_mut(half);
                        store(half, word);
                    }
                }
            }
        }

        #[inline(always)]
        fn rows(planes: &Planes, rows: &mut Rows) {
            // SAFETY: as above.
            unsafe {
                for half in 0..2 {
                    let eight = transpose(std::array::from_fn(|k| {
                        load(planes[k].as_chunks::<8>().0.get_unchecked(half))
                    }));
                    for (k, word) in eight.into_iter().enumerate() {
                        store(&mut rows[8 * half + k], word);
                    }
                }
            }
        }
    }

    #[inline]
    #[target_feature(enable = "avx2")]
    fn load(words: &[u32; 8]) -> __m256 {
        // SAFETY: eight words.
        unsafe { _mm256_loadu_ps(words.as_ptr().cast()) }
    }

    #[inline]
    #[target_feature(enable = "avx2")]
    fn store(words: &mut [u32; 8], value: __m256) {
        // SAFETY: eight words.
        unsafe { _mm256_storeu_ps(words.as_mut_ptr().cast(), value) }
    }

    #[inline]
    #[target_feature(enable = "avx2")]
    fn transpose(r: [__m256; 8]) -> [__m256; 8] {
        let (a0, a1) = (
            _mm256_unpacklo_ps(r[0], r[1]),
            _mm256_unpackhi_ps(r[0], r[1]),
        );
        let (b0, b1) = (
            _mm256_unpacklo_ps(r[2], r[3]),
            _mm256_unpackhi_ps(r[2], r[3]),
        );
        let (c0, c1) = (
            _mm256_unpacklo_ps(r[4], r[5]),
            _mm256_unpackhi_ps(r[4], r[5]),
        );
        let (d0, d1) = (
            _mm256_unpacklo_ps(r[6], r[7]),
            _mm256_unpackhi_ps(r[6], r[7]),
        );
        let left = [
            _mm256_shuffle_ps::<0b01_00_01_00>(a0, b0),
            _mm256_shuffle_ps::<0b11_10_11_10>(a0, b0),
            _mm256_shuffle_ps::<0b01_00_01_00>(a1, b1),
            _mm256_shuffle_ps::<0b11_10_11_10>(a1, b1),
        ];
        let right = [
            _mm256_shuffle_ps::<0b01_00_01_00>(c0, d0),
            _mm256_shuffle_ps::<0b11_10_11_10>(c0, d0),
            _mm256_shuffle_ps::<0b01_00_01_00>(c1, d1),
            _mm256_shuffle_ps::<0b11_10_11_10>(c1, d1),
        ];
        [
            _mm256_permute2f128_ps::<0x20>(left[0], right[0]),
            _mm256_permute2f128_ps::<0x20>(left[1], right[1]),
            _mm256_permute2f128_ps::<0x20>(left[2], right[2]),
            _mm256_permute2f128_ps::<0x20>(left[3], right[3]),
            _mm256_permute2f128_ps::<0x31>(left[0], right[0]),
            _mm256_permute2f128_ps::<0x31>(left[1], right[1]),
            _mm256_permute2f128_ps::<0x31>(left[2], right[2]),
            _mm256_permute2f128_ps::<0x31>(left[3], right[3]),
        ]
    }
}
