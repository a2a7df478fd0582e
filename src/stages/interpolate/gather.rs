//! Fetches what a pixel comes from: the three records of its triangle in every view, summed over the views.
//!
//! Samples of sixteen pixels -> where their records lie and what they weigh ([`Source`]), then sums of a pixel over
//! views ([`Sums`]). Records are interleaved, so a corner is one load; the sixteen pixels are turned into planes at the
//! end. Two twins give the same bits: one with 256-bit registers and one for any processor.

use crate::{
    lanes::{self, LANES, Lanes, Transpose, members, prefetch},
    model::belief::{LEVEL_SCALE, Record, f32_from_f16},
};

use super::project::{STEPS, Sample, split};

/// Steps of a source pixel, as integers.
const WHOLE: u32 = STEPS as u32;
/// Units of [`Sums`]' levels per grey level: weights count [`STEPS`], so that the sum over a triangle is exact.
pub const LEVEL_UNITS: f32 = LEVEL_SCALE * STEPS;

/// Where sixteen pixels come from in one view. Indices lie inside the view, whatever the samples.
#[derive(Clone, Copy)]
pub struct Source {
    upper_left: [u32; LANES],
    /// Upper left or lower right, whichever belongs to the triangle.
    corner: [u32; LANES],
    /// Of the corner, the upper right and the lower left record; 0 where unseen.
    pub weights: [Lanes; 3],
    /// The same in [`STEPS`]; two of them in one word, the first below.
    corner_and_right: [u32; LANES],
    lower_left: [u32; LANES],
    /// 1/metres; 0 where unseen.
    pub inverse_depth: Lanes,
}

impl Source {
    pub const NONE: Self = Self {
        upper_left: [0; LANES],
        corner: [0; LANES],
        weights: [[0.0; LANES]; 3],
        corner_and_right: [0; LANES],
        lower_left: [0; LANES],
        inverse_depth: [0.0; LANES],
    };

    /// Sixteen pixels, of a view of `width * height` pixels, at least 2x2.
    #[inline(always)]
    pub fn locate(&mut self, samples: &[Sample; LANES], width: u32, height: u32) {
        // In halves first, so that all that follows is done sixteen at a time.
        let (mut lows, mut highs) = ([0u32; LANES], [0u32; LANES]);
        for lane in 0..LANES {
            lows[lane] = samples[lane] as u32;
            highs[lane] = (samples[lane] >> 32) as u32;
        }
        for lane in 0..LANES {
            let (u, v, inverse_depth) = split(lows[lane], highs[lane]);
            // A sample on the last column or row belongs to the quad before it.
            let column = (u / WHOLE).min(width - 2);
            let row = (v / WHOLE).min(height - 2);
            let right = (u - column * WHOLE).min(WHOLE);
            let down = (v - row * WHOLE).min(WHOLE);
            let upper_left = row * width + column;
            let in_lower_right = right + down > WHOLE;
            let corner = upper_left + if in_lower_right { width + 1 } else { 0 };
            let w = [
                if in_lower_right {
                    right + down - WHOLE
                } else {
                    WHOLE - (right + down)
                },
                if in_lower_right { WHOLE - down } else { right },
                if in_lower_right { WHOLE - right } else { down },
            ];
            self.upper_left[lane] = upper_left;
            self.corner[lane] = corner;
            self.corner_and_right[lane] = w[0] | (w[1] << 16);
            self.lower_left[lane] = w[2];
            for (weights, w) in self.weights.iter_mut().zip(w) {
                weights[lane] = w as i32 as f32 * (1.0 / STEPS);
            }
            self.inverse_depth[lane] = inverse_depth;
        }
    }

    /// The three records of a lane, in the order of the weights.
    #[inline(always)]
    pub fn records<'a>(&self, lane: usize, view: &GatherView<'a>) -> [&'a Record; 3] {
        self.corners(lane, view.width).map(|at| &view.records[at])
    }

    /// Where they lie in a view so wide.
    #[inline(always)]
    pub fn corners(&self, lane: usize, width: usize) -> [usize; 3] {
        let upper_left = self.upper_left[lane] as usize;
        [
            self.corner[lane] as usize,
            upper_left + 1,
            upper_left + width,
        ]
    }
}

/// A view's records, row by row, and its weight in means.
#[derive(Clone, Copy)]
pub struct GatherView<'a> {
    pub records: &'a [Record],
    pub width: usize,
    pub weight: f32,
}

/// Asks for what the row below will need: of its three records two are near those of this row. One at a time, between
/// other work: only so many may be on their way at once, and who asks for one more waits.
#[inline(always)]
fn prefetch_below(view: &GatherView, upper_left: usize) {
    prefetch(view.records, upper_left + 2 * view.width);
}

/// Sums of sixteen pixels over views, as planes.
#[derive(Clone, Copy)]
pub struct Sums {
    /// Weighted spread: alpha, beta, sigma, p2.
    pub spread: [Lanes; 8],
    /// Weighted tau less `first`, then its weighted square; three channels and a spare each. In [`LEVEL_UNITS`] around
    /// the stored offset.
    pub level: [Lanes; 8],
    /// Tau of the first view, then greatest less least tau; only when comparing.
    pub range: [Lanes; 8],
}

impl Sums {
    pub const ZERO: Self = Self {
        spread: [[0.0; LANES]; 8],
        level: [[0.0; LANES]; 8],
        range: [[0.0; LANES]; 8],
    };
}

/// The sums of one pixel, interleaved.
type Tile = [[f32; 8]; LANES];

#[inline(always)]
fn planes<T: Transpose>(tile: &Tile, planes: &mut [Lanes; 8]) {
    T::planes(bytemuck::cast_ref(tile), bytemuck::cast_mut(planes));
}

/// The two twins.
pub trait Gather {
    /// Sums the views in `seen`, a bit mask a pixel; pixels without any get zeros. When `COMPARING`, views are compared
    /// (squares and ranges); otherwise they all must weigh 1, and `first` is 0.
    ///
    /// # Safety
    /// `seen` names views only, each with a source that was located in it, and its records are there.
    unsafe fn sum<const COMPARING: bool>(
        views: &[GatherView],
        sources: &[Source],
        seen: &[u32; LANES],
        sums: &mut Sums,
    );
}

/// For any processor.
pub struct Portable;

impl Gather for Portable {
    #[inline(always)]
    unsafe fn sum<const COMPARING: bool>(
        views: &[GatherView],
        sources: &[Source],
        seen: &[u32; LANES],
        sums: &mut Sums,
    ) {
        let mut spreads: Tile = [[0.0; 8]; LANES];
        let mut levels: Tile = [[0.0; 8]; LANES];
        let mut ranges: Tile = [[0.0; 8]; LANES];
        for lane in 0..LANES {
            let spread = &mut spreads[lane];
            // At most 16 views of 2^15 * 2^7: no overflow.
            let mut whole = [0i32; 4];
            let (mut sum, mut square) = ([0.0f32; 4], [0.0f32; 4]);
            let mut first = None;
            let mut low = [f32::INFINITY; 4];
            let mut high = [f32::NEG_INFINITY; 4];
            for index in members(seen[lane]) {
                let source = &sources[index];
                let records = source.records(lane, &views[index]);
                prefetch_below(&views[index], source.upper_left[lane] as usize);
                let weight = views[index].weight;
                for (record, weights) in records.into_iter().zip(&source.weights) {
                    let w = weights[lane] * weight;
                    for (spread, stored) in spread.iter_mut().zip(record.spread) {
                        *spread += w * f32_from_f16(stored);
                    }
                }
                let w = source.corner_and_right[lane];
                let w = [w & 0xffff, w >> 16, source.lower_left[lane]];
                let level: [i32; 4] = std::array::from_fn(|channel| {
                    (0..3)
                        .map(|corner| i32::from(records[corner].level[channel]) * w[corner] as i32)
                        .sum()
                });
                if !COMPARING {
                    for (whole, level) in whole.iter_mut().zip(level) {
                        *whole += level;
                    }
                    continue;
                }
                let level = level.map(|level| level as f32);
                let first = *first.get_or_insert(level);
                for channel in 0..4 {
                    let difference = level[channel] - first[channel];
                    let weighted = weight * difference;
                    sum[channel] += weighted;
                    square[channel] += weighted * difference;
                    low[channel] = low[channel].min(level[channel]);
                    high[channel] = high[channel].max(level[channel]);
                }
            }
            if !COMPARING {
                sum = whole.map(|whole| whole as f32);
            }
            levels[lane][..4].copy_from_slice(&sum);
            if COMPARING {
                levels[lane][4..].copy_from_slice(&square);
                ranges[lane][..4].copy_from_slice(&first.unwrap_or_default());
                for channel in 0..4 {
                    ranges[lane][4 + channel] = high[channel] - low[channel];
                }
            }
        }
        use lanes::Portable;
        planes::<Portable>(&spreads, &mut sums.spread);
        planes::<Portable>(&levels, &mut sums.level);
        if COMPARING {
            planes::<Portable>(&ranges, &mut sums.range);
        }
    }
}

#[cfg(target_arch = "x86_64")]
pub use x86::Avx;

#[cfg(target_arch = "x86_64")]
mod x86 {
    use std::arch::x86_64::*;

    use crate::lanes::members;

    use super::{Gather, GatherView, LANES, Source, Sums, Tile, planes, prefetch_below};

    /// With AVX2 and F16C.
    pub struct Avx;

    impl Gather for Avx {
        #[inline(always)]
        unsafe fn sum<const COMPARING: bool>(
            views: &[GatherView],
            sources: &[Source],
            seen: &[u32; LANES],
            sums: &mut Sums,
        ) {
            // SAFETY: `Avx` is only named in kernels that are compiled for AVX2 and F16C; the rest is demanded here too.
            unsafe { sum::<COMPARING>(views, sources, seen, sums) }
        }
    }

    /// # Safety
    /// `seen` names views only, each with a source that was located in it, and its records are there.
    #[inline]
    #[target_feature(enable = "avx2,f16c")]
    unsafe fn sum<const COMPARING: bool>(
        views: &[GatherView],
        sources: &[Source],
        seen: &[u32; LANES],
        sums: &mut Sums,
    ) {
        let zero = _mm_setzero_si128();
        let mut spreads: Tile = [[0.0; 8]; LANES];
        let mut levels: Tile = [[0.0; 8]; LANES];
        let mut ranges: Tile = [[0.0; 8]; LANES];
        for lane in 0..LANES {
            let mut spread = _mm256_setzero_ps();
            let mut whole = zero;
            let mut sum = _mm_setzero_ps();
            let mut square = _mm_setzero_ps();
            let mut first = _mm_setzero_ps();
            let mut low = _mm_set1_ps(f32::INFINITY);
            let mut high = _mm_set1_ps(f32::NEG_INFINITY);
            let mut is_first = true;
            for index in members(seen[lane]) {
                // SAFETY: `seen` says which of the views, and there is a source for each.
                let (source, view) =
                    unsafe { (sources.get_unchecked(index), views.get_unchecked(index)) };
                // SAFETY: sources lie inside their view, which has its records, as `sum` demands; a record is 32 readable
                // bytes: eight f16, then eight i16.
                let halves = unsafe {
                    let upper_left = view.records.as_ptr().add(source.upper_left[lane] as usize);
                    let corner = view.records.as_ptr().add(source.corner[lane] as usize);
                    prefetch_below(view, source.upper_left[lane] as usize);
                    [corner, upper_left.add(1), upper_left.add(view.width)].map(|record| {
                        (
                            _mm_load_si128(record.cast()),
                            _mm_load_si128(record.cast::<__m128i>().add(1)),
                        )
                    })
                };
                for ((stored, _), weights) in halves.into_iter().zip(&source.weights) {
                    let w = if COMPARING {
                        weights[lane] * view.weight
                    } else {
                        weights[lane]
                    };
                    let w = _mm256_set1_ps(w);
                    spread = _mm256_add_ps(spread, _mm256_mul_ps(w, _mm256_cvtph_ps(stored)));
                }
                let [(_, corner), (_, upper_right), (_, lower_left)] = halves;
                let two = _mm_madd_epi16(
                    _mm_unpacklo_epi16(corner, upper_right),
                    _mm_set1_epi32(source.corner_and_right[lane] as i32),
                );
                let one = _mm_madd_epi16(
                    _mm_unpacklo_epi16(lower_left, zero),
                    _mm_set1_epi32(source.lower_left[lane] as i32),
                );
                let level = _mm_add_epi32(two, one);
                if COMPARING {
                    let level = _mm_cvtepi32_ps(level);
                    if is_first {
                        first = level;
                        is_first = false;
                    }
                    let difference = _mm_sub_ps(level, first);
                    let weighted = _mm_mul_ps(_mm_set1_ps(view.weight), difference);
                    sum = _mm_add_ps(sum, weighted);
                    square = _mm_add_ps(square, _mm_mul_ps(weighted, difference));
                    low = _mm_min_ps(low, level);
                    high = _mm_max_ps(high, level);
                } else {
                    whole = _mm_add_epi32(whole, level);
                }
            }
            if !COMPARING {
                sum = _mm_cvtepi32_ps(whole);
            }
            // SAFETY: eight f32 each.
            unsafe {
                _mm256_storeu_ps(spreads[lane].as_mut_ptr(), spread);
                _mm256_storeu_ps(levels[lane].as_mut_ptr(), _mm256_set_m128(square, sum));
                if COMPARING {
                    let range = _mm_sub_ps(high, low);
                    _mm256_storeu_ps(ranges[lane].as_mut_ptr(), _mm256_set_m128(range, first));
                }
            }
        }
        use crate::lanes::Avx;
        planes::<Avx>(&spreads, &mut sums.spread);
        planes::<Avx>(&levels, &mut sums.level);
        if COMPARING {
            planes::<Avx>(&ranges, &mut sums.range);
        }
    }
}
