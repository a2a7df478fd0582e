//! Plane sweep over inverse depth (the paper's section III-C and its [29]): what it costs to believe that a pixel of the
//! middle image lies at each hypothesis, by its luminance in the left and in the right image.
//! In: luminance of two or three cameras, the rig, the range of inverse depth (1/m). Out: a cost volume, grey levels.
//! Open in the paper: the cost. Chosen: per side the difference to the interval of luminance that the hypothesis and
//! its halves towards the next ones span (Birchfield and Tomasi 1998), three times where there is little texture, cut at
//! `most_difference`; of the two sides the mean, but where they disagree no more than the better one and `occlusion`,
//! as the other camera may not see the point; a side that looks past its image has no vote. Exposure of the side images
//! is matched to the middle's.

use super::{
    checkerboard::{Checkerboard, CostRow},
    lanes::{Lanes, for_each_isa},
    rig::InverseDepthRange,
    sampling::{Sampler, Strip, VECTOR_SLACK},
    side::{OUTSIDE, Side},
};
use crate::{isa::Isa, model::camera::Intrinsics};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SweepSettings {
    /// Grey levels; a larger difference says no more than this.
    pub most_difference: u8,
    /// Grey levels that seeing a point from one side only costs.
    pub occlusion: u8,
    /// The most that a label far from the expected depth costs, grey levels: far less than `most_difference`, so that
    /// it decides where the images do not, and never against them.
    pub most_surprise: u8,
    /// What a label costs that neither side could see, grey levels.
    pub unseen: u8,
}

impl SweepSettings {
    /// No cost exceeds it.
    pub fn highest_cost(&self) -> u8 {
        self.most_difference.saturating_add(self.most_surprise)
    }
}

/// The middle image and what is known of it.
#[derive(Clone, Copy)]
pub(super) struct Middle<'a> {
    pub intrinsics: &'a Intrinsics,
    pub luminance: &'a [u8],
    /// 255 where a difference counts three times, else 0.
    pub weak: &'a [u8],
    /// 255 where it has a vote what is expected, else 0.
    pub blank: &'a [u8],
    /// Metres, 0 = none.
    pub expected_depth_m: Option<&'a [f32]>,
}

/// Everything that the rows of one frame share.
pub(super) struct Sweep<'a> {
    isa: Isa,
    settings: &'a SweepSettings,
    middle: Middle<'a>,
    range: &'a InverseDepthRange,
    samplers: [Sampler<'a>; 2],
    tolerance: usize,
    board: Checkerboard,
    /// Samples in half grey levels, not whole ones.
    fine: bool,
}

/// What one thread fills rows with.
pub(super) struct Scratch {
    strips: [Strip; 2],
    luminance: Vec<u8>,
    weak: Vec<u8>,
    expected: Vec<u8>,
}

impl<'a> Sweep<'a> {
    /// Both sides have been turned. `fine` costs time that a first answer does not need.
    pub fn new(
        isa: Isa,
        settings: &'a SweepSettings,
        middle: Middle<'a>,
        sides: [Option<&'a Side>; 2],
        range: &'a InverseDepthRange,
        fine: bool,
    ) -> Self {
        let board = Checkerboard::new(middle.intrinsics.width, middle.intrinsics.height);
        let samplers = sides.map(|side| Sampler::new(side, middle.intrinsics, range));
        let tolerance = sides
            .iter()
            .flatten()
            .map(|side| side.tolerance(range))
            .max()
            .unwrap_or(0);
        Self {
            isa,
            settings,
            middle,
            range,
            samplers,
            tolerance,
            board,
            fine,
        }
    }

    pub fn scratch(&self) -> Scratch {
        let line = vec![0; self.board.half + VECTOR_SLACK];
        Scratch {
            strips: [0, 1].map(|side| self.samplers[side].strip(self.range.labels, &self.board)),
            luminance: line.clone(),
            weak: line.clone(),
            expected: line,
        }
    }

    /// Costs of row `y`.
    pub fn fill_row(&self, scratch: &mut Scratch, y: usize, row: &mut CostRow<'_>) {
        let Self {
            board,
            range,
            middle,
            ..
        } = self;
        let Scratch {
            strips,
            luminance,
            weak,
            expected,
        } = scratch;
        let labels = range.labels;
        for (sampler, strip) in self.samplers.iter().zip(strips.iter_mut()) {
            sampler.fill(self.isa, y, board, self.fine, strip);
        }
        let pixels = y * board.width..(y + 1) * board.width;
        let colour_bytes = row.bytes.len() / 2;
        for (colour, costs) in row.bytes.chunks_exact_mut(colour_bytes).enumerate() {
            let parity = Checkerboard::parity(y, colour);
            let here = middle.luminance[pixels.clone()]
                .iter()
                .skip(parity)
                .step_by(2);
            for (to, from) in luminance.iter_mut().zip(here) {
                *to = *from;
            }
            let here = middle.weak[pixels.clone()].iter().skip(parity);
            for (to, from) in weak.iter_mut().zip(here.step_by(2)) {
                *to = *from;
            }
            if let Some(depth_m) = middle.expected_depth_m {
                let here = depth_m[pixels.clone()]
                    .iter()
                    .zip(&middle.blank[pixels.clone()]);
                let here = here.skip(parity).step_by(2);
                for (to, (depth_m, blank)) in expected.iter_mut().zip(here) {
                    *to = if *depth_m > 0.0 && *blank != 0 {
                        range
                            .label_of_depth(f64::from(*depth_m))
                            .round()
                            .clamp(0.0, labels as f64 - 1.0) as u8
                    } else {
                        NOT_EXPECTED
                    };
                }
            }
            let half_row = HalfRow {
                luminance,
                weak,
                expected: middle.expected_depth_m.map(|_| &expected[..]),
                strips,
                parity,
                tolerance: self.tolerance,
                board,
                fine: self.fine,
            };
            half_row.check(labels, costs);
            let isa = if board.half < 64 {
                self.isa.min(Isa::Avx2)
            } else {
                self.isa
            };
            // SAFETY: `isa` is available; `check` has found all slices long enough for vectors that start below
            // `half`, and no vector is longer than a half row or 32.
            unsafe { cost_half_row(isa, self.settings, &half_row, labels, costs) };
            // Outside the image there is nothing to cost; coarser levels sum these too.
            if 2 * (board.half - 1) + parity >= board.width {
                for costs in costs.chunks_exact_mut(board.stride) {
                    costs[board.half - 1] = 0;
                }
            }
        }
    }
}

/// Label that stands for an unknown depth; a range of 256 labels loses its nearest as an expectation.
const NOT_EXPECTED: u8 = 255;

struct HalfRow<'a> {
    luminance: &'a [u8],
    weak: &'a [u8],
    expected: Option<&'a [u8]>,
    strips: &'a [Strip; 2],
    parity: usize,
    /// Labels by which a blocker must be nearer.
    tolerance: usize,
    board: &'a Checkerboard,
    fine: bool,
}

impl HalfRow<'_> {
    fn check(&self, labels: usize, costs: &[u8]) {
        let reach = self.board.half.max(32);
        assert!(self.luminance.len() >= reach && costs.len() >= labels * self.board.stride);
        assert!(self.weak.len() >= reach);
        assert!(self.expected.is_none_or(|expected| expected.len() >= reach));
        for strip in self.strips {
            let end =
                |at: &[[usize; 2]]| at.iter().map(|at| at[self.parity]).max().unwrap_or(0) + reach;
            assert!(strip.at.len() == labels && strip.blocker_at.len() == labels);
            let samples_end = end(&strip.at);
            let mut samples = strip.low.iter().chain(&strip.high);
            assert!(samples.all(|samples| samples.len() >= samples_end));
            assert!(strip.blocker.len() >= end(&strip.blocker_at));
        }
    }
}

for_each_isa! {
    unsafe fn cost_half_row = cost_kernel(settings: &SweepSettings, row: &HalfRow<'_>, labels: usize, costs: &mut [u8])
}

/// # Safety
/// [`HalfRow::check`] has passed.
#[inline(always)]
unsafe fn cost_kernel<V: Lanes>(
    settings: &SweepSettings,
    row: &HalfRow<'_>,
    labels: usize,
    costs: &mut [u8],
) {
    let Checkerboard { half, stride, .. } = *row.board;
    // SAFETY: see `sweep`.
    unsafe {
        // Half levels, up to the mean of the two sides.
        let most = V::splat(settings.most_difference.saturating_mul(2));
        let occlusion = V::splat(settings.occlusion.saturating_mul(2));
        let unseen = V::splat(settings.unseen.saturating_mul(2));
        let most_surprise = V::splat(settings.most_surprise);
        for start in Checkerboard::vector_starts(half, V::N) {
            let luminance = V::load(row.luminance.as_ptr().add(start));
            let weak = V::load(row.weak.as_ptr().add(start));
            for label in 0..labels {
                // Plain loops: a closure would be a function of its own, without the vector instructions.
                let mut differences = [most; 2];
                let mut blockers = [most; 2];
                for side in 0..2 {
                    let strip = &row.strips[side];
                    let at = strip.at.get_unchecked(label)[row.parity] + start;
                    let mut difference = V::splat(0);
                    for rounding in [0, usize::from(row.fine)] {
                        let low = V::load(strip.low[rounding].as_ptr().add(at));
                        let high = V::load(strip.high[rounding].as_ptr().add(at));
                        let rounded = luminance
                            .sub_saturating(high)
                            .max(low.sub_saturating(luminance));
                        difference = difference.add_saturating(rounded);
                    }
                    let more = difference.min(weak);
                    differences[side] = difference
                        .add_saturating(more)
                        .add_saturating(more)
                        .min(most);
                    let blocker_at = strip.blocker_at.get_unchecked(label)[row.parity] + start;
                    blockers[side] = V::load(strip.blocker.as_ptr().add(blocker_at));
                }
                let ([left, right], [left_blocker, right_blocker]) = (differences, blockers);
                let passes = V::splat((label + row.tolerance).min(OUTSIDE as usize - 1) as u8);
                let l = left.replace_where_less(passes, left_blocker, right);
                let r = right.replace_where_less(passes, right_blocker, left);
                let mut cost = l.average(r).min(l.min(r).add_saturating(occlusion));
                cost = cost.replace_where_less(passes, left_blocker.min(right_blocker), unseen);
                cost = cost.average(V::splat(0));
                if let Some(expected) = row.expected {
                    let expected = V::load(expected.as_ptr().add(start));
                    let here = V::splat(label as u8);
                    let away = here
                        .sub_saturating(expected)
                        .max(expected.sub_saturating(here))
                        .min(most_surprise);
                    let away =
                        away.replace_where_less(V::splat(NOT_EXPECTED - 1), expected, V::splat(0));
                    cost = cost.add_saturating(away);
                }
                cost.store(costs.as_mut_ptr().add(label * stride + start));
            }
        }
    }
}
