//! Max-product belief propagation in its min-sum form, coarse to fine (Felzenszwalb and Huttenlocher 2006, the
//! paper's [30]): E = sum of costs + sum over neighbours of min(step |l - l'|, truncation).
//! In: a cost volume, one byte a pixel and label. Out: one [`Belief`] a pixel.
//! Open in the paper: everything but the method. Chosen: messages of 8 bits, which lose nothing: no message exceeds
//! its truncation d, so a cost of more than its pixel's least + 4 d never changes a message nor wins, and is cut at
//! least + 4 d + 1; with d <= 31, the sum of a cost and four messages is at most 249. Two smoothness classes, so that
//! depth may jump where luminance does. Coarser levels sum the costs of 2x2 pixels exactly (in 16 bits, cut likewise
//! per level) and know one class only.
//!
//! Time goes into memory, not arithmetic, if each iteration walks the whole volume. So the iterations follow one
//! another down the image one row apart, which is exact on a checkerboard: iteration t at row y needs iteration t - 1
//! at rows y - 1 to y + 1 and nothing later. Bands of rows, one a thread, shrink by one row an iteration at each
//! inner border; the wedge between two bands is done when both are.

use super::{
    checkerboard::{AlignedBytes, Checkerboard, CostVolume},
    lanes::{Lanes, for_each_isa},
    messages::{self, ABOVE, BELOW, Belief, LEFT, RIGHT, Sender},
};
use crate::engine::isa::Isa;
use rayon::prelude::*;

/// Cost of a difference of labels between neighbours: min(step * difference, truncation).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Smoothness {
    pub step: u8,
    /// At most [`Smoothness::HIGHEST_TRUNCATION`].
    pub truncation: u8,
}

impl Smoothness {
    /// Above it, sums would not fit a byte.
    pub const HIGHEST_TRUNCATION: u8 = 31;
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PropagationSettings {
    /// Between neighbours of like luminance, and at all coarse levels.
    pub smooth: Smoothness,
    /// Between neighbours of unlike luminance.
    pub across_contrast: Smoothness,
    /// Resolutions, each half the one before; 1 to [`MOST_LEVELS`](Self::MOST_LEVELS).
    pub levels: usize,
    /// At each level; at least 1. Each updates one colour of the checkerboard.
    pub iterations: usize,
}

impl PropagationSettings {
    /// Costs of 4^4 pixels, the coarsest, still sum up in 16 bits.
    pub const MOST_LEVELS: usize = 5;

    /// A cost this far above its pixel's least is as good as infinite.
    fn saturation(&self) -> u8 {
        4 * self.smooth.truncation.max(self.across_contrast.truncation) + 1
    }
}

/// Where neighbours differ in luminance: one byte a pixel, 0 = alike.
#[derive(Debug, Clone, Default)]
pub struct Contrast {
    /// Between a pixel and the one to its right.
    pub right: Vec<u8>,
    /// Between a pixel and the one below.
    pub below: Vec<u8>,
}

struct Level {
    costs: CostVolume,
    /// `[row][colour][neighbour][label][index]`
    messages: AlignedBytes,
    /// `[row][colour][8][index]`, see [`Sender::weights`].
    weights: AlignedBytes,
}

/// Buffers for one image size and number of labels, and the propagation in them.
pub struct BeliefPropagation {
    settings: PropagationSettings,
    isa: Isa,
    /// Finest first.
    levels: Vec<Level>,
    beliefs: Vec<Belief>,
}

impl BeliefPropagation {
    pub fn new(settings: PropagationSettings, width: usize, height: usize, labels: usize, isa: Isa) -> Self {
        for Smoothness { truncation, .. } in [settings.smooth, settings.across_contrast] {
            assert!(truncation <= Smoothness::HIGHEST_TRUNCATION, "sums of messages fit a byte");
        }
        assert!((1..=PropagationSettings::MOST_LEVELS).contains(&settings.levels));
        assert!(settings.iterations > 0);
        let mut board = Checkerboard::new(width, height);
        let mut levels = Vec::new();
        for _ in 0..settings.levels {
            let costs = CostVolume::new(board.width, board.height, labels);
            let mut level = Level {
                messages: AlignedBytes::zeroed(4 * costs.bytes.len()),
                weights: AlignedBytes::zeroed(16 * board.height * board.stride),
                costs,
            };
            level.weigh(&settings, None);
            levels.push(level);
            if board.width <= 1 && board.height <= 1 {
                break;
            }
            board = board.coarser();
        }
        Self { settings, isa: isa.or_best_available(), levels, beliefs: vec![Belief::default(); width * height] }
    }

    /// The costs of the next [`solve`](Self::solve), which may lower all costs of a pixel alike and those far above its
    /// least.
    pub fn costs_mut(&mut self) -> &mut CostVolume {
        &mut self.levels[0].costs
    }

    pub fn costs(&self) -> &CostVolume {
        &self.levels[0].costs
    }

    /// Beliefs of all pixels, row by row. `highest_cost` bounds what [`costs_mut`](Self::costs_mut) was given. Runs on
    /// the threads of the current rayon pool; the result does not depend on their number.
    pub fn solve(&mut self, highest_cost: u8, contrast: &Contrast) -> &[Belief] {
        self.levels[0].weigh(&self.settings, Some(contrast));
        // Before the finest are cut, so that coarser sums are exact.
        self.build_coarser();
        if highest_cost > self.settings.saturation() {
            self.saturate();
        }
        let Self { settings, isa, levels, beliefs } = self;
        for at in (0..levels.len()).rev() {
            let (finer, coarser) = levels.split_at_mut(at + 1);
            let level = &mut finer[at];
            let beliefs = (at == 0).then_some(&mut beliefs[..]);
            propagate(level, coarser.first(), settings.iterations, *isa, beliefs);
        }
        &self.beliefs
    }

    /// Cuts the finest costs to what messages can hold.
    fn saturate(&mut self) {
        let (isa, highest) = (self.isa, self.settings.saturation());
        let volume = &mut self.levels[0].costs;
        let half_row = volume.row_bytes() / 2;
        let (labels, stride) = (volume.labels, volume.board.stride);
        volume.bytes.par_chunks_exact_mut(half_row).for_each(|half_row| {
            assert_eq!(half_row.len(), labels * stride);
            // SAFETY: `isa` is available; the half row has `labels` rows of `stride` bytes.
            unsafe { saturate_half_row(isa, half_row.as_mut_ptr(), labels, stride, highest) };
        });
    }

    /// Sums the costs of 2x2 pixels, level by level.
    fn build_coarser(&mut self) {
        let (isa, highest) = (self.isa, self.settings.saturation());
        let (finest, coarser) = self.levels.split_at_mut(1);
        let finest = &finest[0].costs;
        if coarser.is_empty() {
            return;
        }
        // One strip makes one row of the coarsest level.
        let mut strips: Vec<Vec<&mut [u8]>> = Vec::new();
        let rows_of_coarsest = 1 << (coarser.len() - 1);
        let labels = finest.labels;
        let boards: Vec<Checkerboard> = coarser.iter().map(|level| level.costs.board).collect();
        for (depth, level) in coarser.iter_mut().enumerate() {
            let rows = rows_of_coarsest >> depth;
            let bytes = level.costs.row_bytes() * rows;
            for (strip, chunk) in level.costs.bytes.chunks_mut(bytes).enumerate() {
                match strips.get_mut(strip) {
                    Some(levels) => levels.push(chunk),
                    None => strips.push(vec![chunk]),
                }
            }
        }
        strips.par_iter_mut().enumerate().for_each_init(
            || {
                boards
                    .iter()
                    .map(|board| vec![0_u16; labels * board.width])
                    .collect::<Vec<_>>()
            },
            |sums, (strip, levels)| {
                let first = strip * rows_of_coarsest * 2;
                let rows = first..(first + 2 * rows_of_coarsest).min(finest.board.height);
                for y in rows {
                    sum_into(
                        isa,
                        &mut sums[0],
                        boards[0].width,
                        finest.half_row(y, 0),
                        finest.half_row(y, 1),
                        finest.board.stride,
                        y % 2 == 0,
                    );
                    // Rows that end here, at each level.
                    let (mut y, mut last) = (y, finest.board.height - 1);
                    for depth in 0..levels.len() {
                        if y % 2 == 0 && y != last {
                            break;
                        }
                        (y, last) = (y / 2, last / 2);
                        let (board, rows) = (boards[depth], rows_of_coarsest >> depth);
                        let bytes = 2 * labels * board.stride;
                        let row = &mut levels[depth][(y % rows) * bytes..][..bytes];
                        let (sum, rest) = sums[depth..].split_first_mut().expect("one a level");
                        cut_into(isa, sum, &board, y, highest, row);
                        if let Some(next) = rest.first_mut() {
                            sum_pairs(sum, board.width, next, boards[depth + 1].width, y % 2 == 0);
                        }
                    }
                }
            },
        );
    }
}

/// Adds one row of the finest level, both colours, to the row of the next: `[label][x]`.
fn sum_into(isa: Isa, sums: &mut [u16], width: usize, a: &[u8], b: &[u8], stride: usize, first: bool) {
    #[inline(always)]
    fn run<V: Lanes>(sums: &mut [u16], width: usize, a: &[u8], b: &[u8], stride: usize, first: bool) {
        let rows = sums.chunks_exact_mut(width).zip(a.chunks_exact(stride).zip(b.chunks_exact(stride)));
        for (sums, (a, b)) in rows {
            for (sum, (a, b)) in sums.iter_mut().zip(a.iter().zip(b)) {
                let pair = u16::from(*a) + u16::from(*b);
                *sum = if first { pair } else { *sum + pair };
            }
        }
    }
    for_each_isa! {
        unsafe fn dispatched = run(sums: &mut [u16], width: usize, a: &[u8], b: &[u8], stride: usize, first: bool)
    }
    // SAFETY: `isa` is available; the kernel is safe code.
    unsafe { dispatched(isa, sums, width, a, b, stride, first) }
}

/// Adds pairs of pixels of one row to the row of the next level.
fn sum_pairs(sums: &[u16], width: usize, next: &mut [u16], next_width: usize, first: bool) {
    for (sums, next) in sums.chunks_exact(width).zip(next.chunks_exact_mut(next_width)) {
        if first {
            next.fill(0);
        }
        for (pair, next) in sums.chunks(2).zip(next) {
            *next += pair.iter().sum::<u16>();
        }
    }
}

/// Stores sums of costs, `[label][x]`, as row `y` of a level: each pixel's least becomes 0, what exceeds `highest` is
/// cut to it.
fn cut_into(isa: Isa, sums: &[u16], board: &Checkerboard, y: usize, highest: u8, row: &mut [u8]) {
    #[inline(always)]
    fn run<V: Lanes>(sums: &[u16], board: &Checkerboard, y: usize, highest: u8, row: &mut [u8]) {
        let Checkerboard { width, stride, .. } = *board;
        let labels = sums.len() / width;
        let mut least = [u16::MAX; 128];
        for from in (0..width).step_by(128) {
            let n = (width - from).min(128);
            least.fill(u16::MAX);
            for label in 0..labels {
                let sums = &sums[label * width + from..][..n];
                for (least, sum) in least.iter_mut().zip(sums) {
                    *least = (*least).min(*sum);
                }
            }
            let (even, odd) = row.split_at_mut(labels * stride);
            // `from` is even: the first pixel is of colour y & 1.
            let (even, odd) = if y & 1 == 0 { (even, odd) } else { (odd, even) };
            for label in 0..labels {
                let sums = &sums[label * width + from..][..n];
                let mut cut = [0_u8; 128];
                for ((cut, sum), least) in cut.iter_mut().zip(sums).zip(&least) {
                    *cut = (sum - least).min(u16::from(highest)) as u8;
                }
                let even = &mut even[label * stride + from / 2..][..n.div_ceil(2)];
                let odd = &mut odd[label * stride + from / 2..][..n / 2];
                for (to, cut) in even.iter_mut().zip(cut.as_chunks::<2>().0) {
                    *to = cut[0];
                }
                for (to, cut) in odd.iter_mut().zip(cut.as_chunks::<2>().0) {
                    *to = cut[1];
                }
            }
        }
    }
    for_each_isa! {
        unsafe fn dispatched = run(sums: &[u16], board: &Checkerboard, y: usize, highest: u8, row: &mut [u8])
    }
    // SAFETY: `isa` is available; the kernel is safe code.
    unsafe { dispatched(isa, sums, board, y, highest, row) }
}

for_each_isa! {
    unsafe fn saturate_half_row = saturate_kernel(costs: *mut u8, labels: usize, stride: usize, highest: u8)
}

/// # Safety
/// `labels * stride` bytes at `costs`; `stride` a multiple of 64.
#[inline(always)]
unsafe fn saturate_kernel<V: Lanes>(costs: *mut u8, labels: usize, stride: usize, highest: u8) {
    for start in (0..stride).step_by(V::N) {
        // SAFETY: `start + N <= stride`, as N divides 64.
        unsafe {
            let mut least = V::splat(255);
            for label in 0..labels {
                least = least.min(V::load(costs.add(label * stride + start)));
            }
            for label in 0..labels {
                let at = costs.add(label * stride + start);
                V::load(at).sub(least).min(V::splat(highest)).store(at);
            }
        }
    }
}

impl Level {
    /// Writes the weights of all edges; without contrast all are smooth.
    fn weigh(&mut self, settings: &PropagationSettings, contrast: Option<&Contrast>) {
        let Checkerboard { width, height, stride, half } = self.costs.board;
        if let Some(contrast) = contrast {
            assert!(contrast.right.len() == width * height && contrast.below.len() == width * height);
        }
        let PropagationSettings { smooth, across_contrast, .. } = *settings;
        let class = |differ: Option<u8>| match differ {
            None => Smoothness { step: 0, truncation: 0 },
            Some(0) => smooth,
            Some(_) => across_contrast,
        };
        let right = |x: usize, y: usize| (x + 1 < width).then(|| contrast.map_or(0, |c| c.right[y * width + x]));
        let below = |x: usize, y: usize| (y + 1 < height).then(|| contrast.map_or(0, |c| c.below[y * width + x]));
        for (row, weights) in self.weights.chunks_exact_mut(8 * stride).enumerate() {
            let (y, colour) = (row / 2, row % 2);
            for i in 0..half {
                let x = 2 * i + Checkerboard::parity(y, colour);
                if x >= width {
                    continue;
                }
                let mut put = |neighbour: usize, differ: Option<u8>| {
                    let Smoothness { step, truncation } = class(differ);
                    weights[neighbour * stride + i] = step;
                    weights[(4 + neighbour) * stride + i] = truncation;
                };
                put(RIGHT, right(x, y));
                put(BELOW, below(x, y));
                put(LEFT, if x > 0 { right(x - 1, y) } else { None });
                put(ABOVE, if y > 0 { below(x, y - 1) } else { None });
            }
        }
    }
}

/// What the rows of one level share.
struct Walk<'a> {
    costs: &'a CostVolume,
    weights: &'a [u8],
    coarser: Option<&'a Level>,
    iterations: usize,
    isa: Isa,
}

/// The rows `first..` of a level that one thread works on.
struct Band<'a> {
    first: usize,
    /// As in [`Level`].
    messages: &'a mut [u8],
    /// Empty where no beliefs are asked.
    beliefs: &'a mut [Belief],
    /// Receives what is sent off the image.
    outside: Vec<u8>,
}

/// All iterations of one level, starting from the messages of the coarser one, or from none.
fn propagate(level: &mut Level, coarser: Option<&Level>, iterations: usize, isa: Isa, beliefs: Option<&mut [Belief]>) {
    let Level { costs, messages, weights } = level;
    let Checkerboard { width, height, .. } = costs.board;
    let walk = Walk { costs, weights, coarser, iterations, isa };
    let block = walk.block();
    let wanted = beliefs.is_some();
    let beliefs = beliefs.unwrap_or_default();
    // A band must be higher than the wedges at its two borders.
    let bands = rayon::current_num_threads().min(height / (4 * (iterations + 2))).max(1);
    let rows = height.div_ceil(bands);
    let belief_rows = if wanted { width * rows } else { 1 };
    let mut beliefs_left = beliefs.chunks_mut(belief_rows);
    let mut work: Vec<Band<'_>> = messages
        .chunks_mut(2 * block * rows)
        .enumerate()
        .map(|(band, messages)| Band {
            first: band * rows,
            messages,
            beliefs: beliefs_left.next().unwrap_or_default(),
            outside: vec![0; 2 * block],
        })
        .collect();
    let bands = work.len();
    work.par_iter_mut().for_each(|band| {
        let (first, end) = (band.first, band.first + band.messages.len() / (2 * block));
        for front in first..end + iterations + 1 {
            if front < end {
                walk.start(band, front);
            }
            // Iteration 0 up to the last, then what is believed, each one row behind the one before.
            for pass in 0..=iterations {
                let Some(y) = front.checked_sub(pass) else { break };
                let top = if first == 0 { 0 } else { first + pass + 1 };
                let bottom = if end == height { end } else { end - pass - 1 };
                if (top..bottom).contains(&y) {
                    walk.pass(band, pass, y);
                }
            }
        }
    });
    drop(work);
    let mut whole = Band { first: 0, messages, beliefs, outside: vec![0; 2 * block] };
    for border in (1..bands).map(|band| band * rows) {
        for pass in 0..=iterations {
            for y in border - pass - 1..border + pass + 1 {
                walk.pass(&mut whole, pass, y);
            }
        }
    }
}

impl Walk<'_> {
    /// Bytes of one colour of one row of messages.
    fn block(&self) -> usize {
        4 * self.costs.labels * self.costs.board.stride
    }

    /// First messages of row `y`: those of the coarser level. Only what colour 0 receives is ever read, as iteration 0
    /// rewrites what colour 1 does.
    fn start(&self, band: &mut Band<'_>, y: usize) {
        let block = self.block();
        let Checkerboard { half, stride, .. } = self.costs.board;
        let to = &mut band.messages[(y - band.first) * 2 * block..][..block];
        let Some(coarser) = self.coarser else {
            to.fill(0);
            return;
        };
        let board = coarser.costs.board;
        let coarse_block = 4 * self.costs.labels * board.stride;
        let row = &coarser.messages[y / 2 * 2 * coarse_block..][..2 * coarse_block];
        let (even, odd) = row.split_at(coarse_block);
        let (even, odd) = if Checkerboard::parity(y / 2, 0) == 0 { (even, odd) } else { (odd, even) };
        interleave(self.isa, even, odd, board.stride, to, stride, half);
    }

    fn pass(&self, band: &mut Band<'_>, pass: usize, y: usize) {
        let Checkerboard { width, height, half, stride } = self.costs.board;
        let block = self.block();
        let sender = |colour: usize, received| Sender {
            labels: self.costs.labels,
            half,
            stride,
            parity: Checkerboard::parity(y, colour),
            costs: self.costs.half_row(y, colour),
            received,
            weights: &self.weights[(2 * y + colour) * 8 * stride..][..8 * stride],
        };
        let (before, rest) = band.messages.split_at_mut((y - band.first) * 2 * block);
        let (own, after) = rest.split_at_mut(2 * block);
        let (colour_0, colour_1) = own.split_at_mut(block);
        if pass == self.iterations {
            if !band.beliefs.is_empty() {
                let row = &mut band.beliefs[(y - band.first) * width..][..width];
                messages::believe(self.isa, &sender(0, colour_0), width, row);
                messages::believe(self.isa, &sender(1, colour_1), width, row);
            }
            return;
        }
        let colour = pass & 1;
        let (received, row) = if colour == 0 { (colour_0, colour_1) } else { (colour_1, colour_0) };
        let (outside_above, outside_below) = band.outside.split_at_mut(block);
        let other = (1 - colour) * block;
        let row_above = if y == 0 {
            outside_above
        } else {
            let row = before.len() - 2 * block;
            &mut before[row + other..][..block]
        };
        let row_below = if y + 1 == height { outside_below } else { &mut after[other..][..block] };
        messages::send(self.isa, &sender(colour, received), row_above, row, row_below);
    }
}

/// Two half rows of a coarser level, `[..][index]`, into one half row of the finer: each pixel of one colour has its own
/// 2x2 parent, so its index is the parent's x.
fn interleave(isa: Isa, even: &[u8], odd: &[u8], coarse_stride: usize, to: &mut [u8], stride: usize, half: usize) {
    #[inline(always)]
    fn run<V: Lanes>(even: &[u8], odd: &[u8], coarse_stride: usize, to: &mut [u8], stride: usize, half: usize) {
        let rows = even.chunks_exact(coarse_stride).zip(odd.chunks_exact(coarse_stride));
        for ((even, odd), to) in rows.zip(to.chunks_exact_mut(stride)) {
            // An odd last one takes its pair's other half into the padding.
            let pairs = to[..half.next_multiple_of(2)].as_chunks_mut::<2>().0;
            for ((to, even), odd) in pairs.iter_mut().zip(even).zip(odd) {
                *to = [*even, *odd];
            }
        }
    }
    for_each_isa! {
        unsafe fn dispatched = run(
            even: &[u8], odd: &[u8], coarse_stride: usize, to: &mut [u8], stride: usize, half: usize,
        )
    }
    // SAFETY: `isa` is available; the kernel is safe code.
    unsafe { dispatched(isa, even, odd, coarse_stride, to, stride, half) }
}
