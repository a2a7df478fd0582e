//! Fetches what a pixel comes from: the three records of its triangle in every view, summed over the views.
//!
//! Samples of sixteen pixels -> where their records lie and what they weigh ([`Source`]), then sums of a pixel over
//! views ([`Sums`]). Records are interleaved, so a corner is one load; the sixteen pixels are turned into planes at the
//! end. Two twins give the same bits: one with 256-bit registers and one for any processor.

use crate::{
    lanes::{self, LANES, Lanes, Transpose, members, prefetch},
    model::belief::{LEVEL_SCALE, Record, f32_from_f16},
};

use super::sample::{STEPS, Sample, split};

/// Steps of a source pixel, as integers.
const WHOLE: u32 = STEPS as u32;
/// So that a view of [`super::sample::SIDE_MAX`] squared is addressed with 32 bits.
const RECORD_BYTES: u32 = size_of::<Record>() as u32;
/// Units of [`Sums`]' levels per grey level: weights count [`STEPS`], so that the sum over a triangle is exact.
pub const LEVEL_UNITS: f32 = LEVEL_SCALE * STEPS;

/// Where sixteen pixels come from in one view. Indices lie inside the view, whatever the samples.
#[derive(Clone, Copy)]
#[repr(align(64))]
pub struct Source {
    /// In bytes from the view's first record, as all that follow.
    upper_left: [u32; LANES],
    /// Upper left or lower right, whichever belongs to the triangle.
    corner: [u32; LANES],
    /// Of the corner, the upper right and the lower left record, times the view's; 0 where unseen.
    pub weights: [Lanes; 3],
    /// The same in [`STEPS`], without the view's; two of them in one word, the first below.
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

    /// Sixteen pixels, of a view of `width * height` pixels, at least 2x2, that weighs so much.
    #[inline(always)]
    pub fn locate(
        &mut self,
        samples: &[Sample; LANES],
        (width, height): (u32, u32),
        view_weight: f32,
    ) {
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
            // Where unseen, right and down are 0.
            let whole = if inverse_depth > 0.0 { WHOLE } else { 0 };
            let w = [
                if in_lower_right {
                    right + down - WHOLE
                } else {
                    whole - (right + down)
                },
                if in_lower_right { WHOLE - down } else { right },
                if in_lower_right { WHOLE - right } else { down },
            ];
            self.upper_left[lane] = upper_left * RECORD_BYTES;
            self.corner[lane] = corner * RECORD_BYTES;
            self.corner_and_right[lane] = w[0] | (w[1] << 16);
            self.lower_left[lane] = w[2];
            for (weights, w) in self.weights.iter_mut().zip(w) {
                weights[lane] = w as i32 as f32 * (1.0 / STEPS) * view_weight;
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
        let index = |bytes: u32| (bytes / RECORD_BYTES) as usize;
        let upper_left = index(self.upper_left[lane]);
        [index(self.corner[lane]), upper_left + 1, upper_left + width]
    }

    /// Of a lane's records within their triangle; together 1 where it is seen.
    #[inline(always)]
    pub fn shares(&self, lane: usize) -> [f32; 3] {
        self.steps(lane).map(|w| w as f32 * (1.0 / STEPS))
    }

    /// The same in [`STEPS`].
    #[inline(always)]
    fn steps(&self, lane: usize) -> [i32; 3] {
        let w = self.corner_and_right[lane];
        [w & 0xffff, w >> 16, self.lower_left[lane]].map(|w| w as i32)
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
fn prefetch_below(view: &GatherView, upper_left: u32) {
    prefetch(
        bytemuck::cast_slice::<_, u8>(view.records),
        upper_left as usize + 2 * view.width * RECORD_BYTES as usize,
    );
}

/// Sums of sixteen pixels over views, as planes.
#[derive(Clone, Copy)]
#[repr(align(64))]
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

/// The sums of sixteen pixels, each interleaved.
#[repr(align(64))]
struct Tile([[f32; 8]; LANES]);

impl Tile {
    const ZERO: Self = Self([[0.0; 8]; LANES]);

    #[inline(always)]
    fn planes<T: Transpose>(&self, planes: &mut [Lanes; 8]) {
        T::planes(bytemuck::cast_ref(&self.0), bytemuck::cast_mut(planes));
    }
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
        let mut spreads = Tile::ZERO;
        let mut levels = Tile::ZERO;
        let mut ranges = Tile::ZERO;
        for lane in 0..LANES {
            let spread = &mut spreads.0[lane];
            // At most 16 views of 2^15 * 2^7: no overflow.
            let mut whole = [0i32; 4];
            let (mut sum, mut square) = ([0.0f32; 4], [0.0f32; 4]);
            let mut first = None;
            let mut low = [f32::INFINITY; 4];
            let mut high = [f32::NEG_INFINITY; 4];
            for index in members(seen[lane]) {
                let source = &sources[index];
                let records = source.records(lane, &views[index]);
                prefetch_below(&views[index], source.upper_left[lane]);
                let weight = views[index].weight;
                for (record, weights) in records.into_iter().zip(&source.weights) {
                    let w = weights[lane];
                    for (spread, stored) in spread.iter_mut().zip(record.spread) {
                        *spread += w * f32_from_f16(stored);
                    }
                }
                let w = source.steps(lane);
                let level: [i32; 4] = std::array::from_fn(|channel| {
                    (0..3)
                        .map(|corner| i32::from(records[corner].level[channel]) * w[corner])
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
            levels.0[lane][..4].copy_from_slice(&sum);
            if COMPARING {
                levels.0[lane][4..].copy_from_slice(&square);
                ranges.0[lane][..4].copy_from_slice(&first.unwrap_or_default());
                for channel in 0..4 {
                    ranges.0[lane][4 + channel] = high[channel] - low[channel];
                }
            }
        }
        use lanes::Portable;
        spreads.planes::<Portable>(&mut sums.spread);
        levels.planes::<Portable>(&mut sums.level);
        if COMPARING {
            ranges.planes::<Portable>(&mut sums.range);
        }
    }
}

#[cfg(target_arch = "x86_64")]
pub use x86::Avx;

#[cfg(target_arch = "x86_64")]
mod x86 {
    use std::arch::x86_64::*;

    use crate::lanes::members;

    use super::{Gather, GatherView, LANES, RECORD_BYTES, Source, Sums, Tile};

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

    /// Pixels side by side: what a view needs is then looked up once for several, and the levels of two share a register.
    const GROUP: usize = 4;

    /// What is known of the levels of two pixels, four channels each, from the views so far.
    #[derive(Clone, Copy)]
    struct Levels {
        first: __m256,
        /// All ones once there is a first.
        has_first: __m256,
        sum: __m256,
        square: __m256,
        low: __m256,
        high: __m256,
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
        let mut spreads = Tile::ZERO;
        let mut levels = Tile::ZERO;
        let mut ranges = Tile::ZERO;
        for lane in (0..LANES).step_by(GROUP) {
            let group = seen[lane..lane + GROUP]
                .iter()
                .fold(0, |all, seen| all | seen);
            let mut spread = [_mm256_setzero_ps(); GROUP];
            let mut whole = [_mm256_setzero_si256(); GROUP / 2];
            let mut compared = [Levels {
                first: _mm256_setzero_ps(),
                has_first: _mm256_setzero_ps(),
                sum: _mm256_setzero_ps(),
                square: _mm256_setzero_ps(),
                low: _mm256_set1_ps(f32::INFINITY),
                high: _mm256_set1_ps(f32::NEG_INFINITY),
            }; GROUP / 2];
            for index in members(group) {
                // SAFETY: `seen` says which of the views, and there is a source for each.
                let (source, view) =
                    unsafe { (sources.get_unchecked(index), views.get_unchecked(index)) };
                let row = view.width * RECORD_BYTES as usize;
                let records = view.records.as_ptr().cast::<u8>();
                for pair in 0..GROUP / 2 {
                    let mut upper = [_mm_setzero_si128(); 2];
                    let mut lower = [_mm_setzero_si128(); 2];
                    for of_pair in 0..2 {
                        let in_group = 2 * pair + of_pair;
                        let lane = lane + in_group;
                        // SAFETY: sources lie inside their view, which has its records, as `sum` demands, also where
                        // they weigh nothing; a record is 32 readable bytes: eight f16, then eight i16. A prefetch is of
                        // any address.
                        let corners = unsafe {
                            let upper_left = records.add(source.upper_left[lane] as usize);
                            _mm_prefetch::<_MM_HINT_T0>(upper_left.wrapping_add(2 * row).cast());
                            [
                                records.add(source.corner[lane] as usize),
                                upper_left.add(RECORD_BYTES as usize),
                                upper_left.add(row),
                            ]
                        };
                        for (corner, weights) in corners.into_iter().zip(&source.weights) {
                            // SAFETY: as above.
                            let stored = unsafe { _mm_load_si128(corner.cast()) };
                            let w = _mm256_set1_ps(weights[lane]);
                            spread[in_group] = _mm256_add_ps(
                                spread[in_group],
                                _mm256_mul_ps(w, _mm256_cvtph_ps(stored)),
                            );
                        }
                        // SAFETY: as above.
                        let [corner, right, left] = corners.map(|corner| unsafe {
                            _mm_load_si128(corner.cast::<__m128i>().add(1))
                        });
                        upper[of_pair] = _mm_unpacklo_epi16(corner, right);
                        lower[of_pair] = _mm_cvtepu16_epi32(left);
                    }
                    let at = lane + 2 * pair;
                    let level = _mm256_add_epi32(
                        _mm256_madd_epi16(
                            _mm256_set_m128i(upper[1], upper[0]),
                            each_four_times(&source.corner_and_right, at),
                        ),
                        _mm256_madd_epi16(
                            _mm256_set_m128i(lower[1], lower[0]),
                            each_four_times(&source.lower_left, at),
                        ),
                    );
                    if !COMPARING {
                        whole[pair] = _mm256_add_epi32(whole[pair], level);
                        continue;
                    }
                    let depth = each_four_times(bytemuck::cast_ref(&source.inverse_depth), at);
                    let is_seen =
                        _mm256_castsi256_ps(_mm256_cmpgt_epi32(depth, _mm256_setzero_si256()));
                    let level = _mm256_cvtepi32_ps(level);
                    let compared = &mut compared[pair];
                    let is_first = _mm256_andnot_ps(compared.has_first, is_seen);
                    compared.first = _mm256_or_ps(compared.first, _mm256_and_ps(is_first, level));
                    compared.has_first = _mm256_or_ps(compared.has_first, is_seen);
                    let difference = _mm256_and_ps(is_seen, _mm256_sub_ps(level, compared.first));
                    let weighted = _mm256_mul_ps(_mm256_set1_ps(view.weight), difference);
                    compared.sum = _mm256_add_ps(compared.sum, weighted);
                    compared.square =
                        _mm256_add_ps(compared.square, _mm256_mul_ps(weighted, difference));
                    // Of a level that is no number the other is kept.
                    let level = _mm256_or_ps(
                        level,
                        _mm256_xor_ps(is_seen, _mm256_castsi256_ps(_mm256_set1_epi32(-1))),
                    );
                    compared.low = _mm256_min_ps(level, compared.low);
                    compared.high = _mm256_max_ps(level, compared.high);
                }
            }
            for (in_group, spread) in spread.into_iter().enumerate() {
                store(&mut spreads.0[lane + in_group], spread);
            }
            for (pair, (whole, compared)) in whole.into_iter().zip(compared).enumerate() {
                let at = lane + 2 * pair;
                let sum = if COMPARING {
                    compared.sum
                } else {
                    _mm256_cvtepi32_ps(whole)
                };
                let range = _mm256_sub_ps(compared.high, compared.low);
                store(
                    &mut levels.0[at],
                    _mm256_permute2f128_ps::<0x20>(sum, compared.square),
                );
                store(
                    &mut levels.0[at + 1],
                    _mm256_permute2f128_ps::<0x31>(sum, compared.square),
                );
                if COMPARING {
                    let first = compared.first;
                    store(
                        &mut ranges.0[at],
                        _mm256_permute2f128_ps::<0x20>(first, range),
                    );
                    store(
                        &mut ranges.0[at + 1],
                        _mm256_permute2f128_ps::<0x31>(first, range),
                    );
                }
            }
        }
        use crate::lanes::Avx;
        spreads.planes::<Avx>(&mut sums.spread);
        levels.planes::<Avx>(&mut sums.level);
        if COMPARING {
            ranges.planes::<Avx>(&mut sums.range);
        }
    }

    /// The words of lanes `at` and `at + 1`.
    #[inline]
    #[target_feature(enable = "avx2")]
    fn each_four_times(words: &[u32; LANES], at: usize) -> __m256i {
        // Two words into every half, then one of them over each: a broadcast apiece and a choice become four steps.
        // SAFETY: `at` is even and below sixteen, so two words can be read there.
        let two = unsafe { _mm_loadl_epi64(words.as_ptr().add(at).cast()) };
        let order = _mm256_setr_epi32(0, 0, 0, 0, 1, 1, 1, 1);
        _mm256_permutevar8x32_epi32(_mm256_castsi128_si256(two), order)
    }

    #[inline]
    #[target_feature(enable = "avx2")]
    fn store(row: &mut [f32; 8], value: __m256) {
        // SAFETY: eight f32.
        unsafe { _mm256_storeu_ps(row.as_mut_ptr(), value) }
    }
}
