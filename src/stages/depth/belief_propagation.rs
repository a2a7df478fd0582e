//! Max-product belief propagation in its min-sum form, coarse to fine (Felzenszwalb and Huttenlocher 2006, the
//! paper's [30]): E = sum of costs + sum over neighbours of min(step |l - l'|, truncation).
//! In: a cost volume, one byte a pixel and label. Out: one [`Belief`] a pixel.
//! Open in the paper: everything but the method. Chosen: messages of 8 bits, which lose nothing: no message exceeds
//! its truncation d, so a cost of more than its pixel's least + 4 d never changes a message nor wins, and is cut at
//! least + 4 d + 1; with d <= 31, the sum of a cost and four messages is at most 249. Two smoothness classes, so that
//! depth may jump where colour does, at each level. Coarser levels sum the costs of 2x2 pixels exactly (in 16 bits,
//! cut likewise per level).
//!
//! Time goes into memory, not arithmetic, if each iteration walks the whole volume. So the iterations follow one
//! another down the image one row apart, which is exact on a checkerboard: iteration t at row y needs iteration t - 1
//! at rows y - 1 to y + 1 and nothing later. Messages then live in a ring of a few rows that stays in the cache; only
//! what a level hands down to the next finer one is stored. Each thread has a band of rows and, at inner borders, also
//! does the rows beyond that its own depend on, one less an iteration.

use super::{
    checkerboard::{AlignedBytes, Checkerboard, CostRow, CostVolume},
    lanes::{Lanes, for_each_isa},
    messages::{self, ABOVE, BELOW, Belief, LEFT, RIGHT, Sender},
};
use crate::isa::Isa;
use rayon::prelude::*;
use std::ops::Range;

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
    /// Between neighbours of like colour.
    pub smooth: Smoothness,
    /// Between neighbours of unlike colour.
    pub across_contrast: Smoothness,
    /// Resolutions, each half the one before; 1 to [`MOST_LEVELS`](Self::MOST_LEVELS).
    pub levels: usize,
    /// At the finest level and the one above; at least 2, as each updates one colour of the checkerboard.
    pub iterations: usize,
    /// At each level above these two, where an iteration takes little time; at least 2 likewise.
    pub coarse_iterations: usize,
}

impl PropagationSettings {
    /// Costs of 4^4 pixels, the coarsest, still sum up in 16 bits.
    pub const MOST_LEVELS: usize = 5;

    /// Of a level; 0 is the finest.
    pub fn iterations_at(&self, level: usize) -> usize {
        if level < 2 {
            self.iterations
        } else {
            self.coarse_iterations
        }
    }

    /// A cost this far above its pixel's least is as good as infinite.
    fn saturation(&self) -> u8 {
        4 * self.smooth.truncation.max(self.across_contrast.truncation) + 1
    }
}

/// Where neighbours differ in colour: one byte a pixel, 0 = alike.
#[derive(Debug, Clone, Default)]
pub struct Contrast {
    /// Between a pixel and the one to its right.
    pub right: Vec<u8>,
    /// Between a pixel and the one below.
    pub below: Vec<u8>,
}

struct Level {
    costs: CostVolume,
    /// `[row][colour][8][index]`, see [`Sender::weights`].
    weights: AlignedBytes,
    /// First messages of the rows `2 y` and `2 y + 1`, `[y][neighbour][label][index]`: what the coarser level handed
    /// down, or one row of zeros at the coarsest. Only what colour 0 receives is ever read, as iteration 0 rewrites
    /// what colour 1 does, and each pixel of one colour has its own 2x2 parent: its index is the parent's x.
    first: AlignedBytes,
    /// Messages of a few consecutive rows, one ring a band: row `y` in slot `y % slots`, `[colour][neighbour][label][index]`.
    rings: Vec<Vec<AlignedBytes>>,
}

/// Buffers for one image size and number of labels, and the propagation in them.
pub struct BeliefPropagation {
    settings: PropagationSettings,
    isa: Isa,
    /// Finest first.
    levels: Vec<Level>,
    beliefs: Vec<Belief>,
    /// Of the level above the finest.
    coarse_beliefs: Vec<Belief>,
}

impl BeliefPropagation {
    pub fn new(
        settings: PropagationSettings,
        width: usize,
        height: usize,
        labels: usize,
        isa: Isa,
    ) -> Self {
        for Smoothness { truncation, .. } in [settings.smooth, settings.across_contrast] {
            assert!(
                truncation <= Smoothness::HIGHEST_TRUNCATION,
                "sums of messages fit a byte"
            );
        }
        assert!((1..=PropagationSettings::MOST_LEVELS).contains(&settings.levels));
        assert!(
            settings.iterations.min(settings.coarse_iterations) >= 2,
            "both colours have their turn"
        );
        let mut board = Checkerboard::new(width, height);
        let mut levels = Vec::new();
        loop {
            let coarsest =
                levels.len() + 1 == settings.levels || board.width.max(board.height) == 1;
            let rows = if coarsest {
                1
            } else {
                board.height.div_ceil(2)
            };
            let mut level = Level {
                costs: CostVolume::new(board.width, board.height, labels),
                weights: AlignedBytes::zeroed(16 * board.height * board.stride),
                first: AlignedBytes::zeroed(rows * 4 * labels * board.stride),
                rings: Vec::new(),
            };
            level.weigh(&settings, None);
            levels.push(level);
            if coarsest {
                break;
            }
            board = board.coarser();
        }
        Self {
            settings,
            isa: isa.or_best_available(),
            levels,
            beliefs: vec![Belief::default(); width * height],
            coarse_beliefs: vec![Belief::default(); width.div_ceil(2) * height.div_ceil(2)],
        }
    }

    pub fn costs(&self) -> &CostVolume {
        &self.levels[0].costs
    }

    /// Sets where depth may jump more cheaply, the finest level first; without, nowhere. Levels beyond those that
    /// there are have no effect.
    pub fn set_contrasts(&mut self, contrasts: &[Contrast]) {
        for (level, contrast) in self.levels.iter_mut().zip(contrasts) {
            level.weigh(&self.settings, Some(contrast));
        }
    }

    /// Sets the costs of the next [`solve`](Self::solve), row by row: `fill_row(state, y, row)` with a state from `init`
    /// for each thread's piece of work. `highest_cost` bounds what it writes; costs may be lowered afterwards by their
    /// pixel's least, and what is far above it cut.
    pub fn fill<S>(
        &mut self,
        highest_cost: u8,
        init: impl Fn() -> S + Sync + Send,
        fill_row: impl Fn(&mut S, usize, &mut CostRow<'_>) + Sync + Send,
    ) {
        self.fill_levels(true, highest_cost, init, fill_row);
    }

    /// As [`fill`](Self::fill), but for [`solve_coarse`](Self::solve_coarse) only: the finest level keeps its costs.
    pub fn fill_coarse<S>(
        &mut self,
        highest_cost: u8,
        init: impl Fn() -> S + Sync + Send,
        fill_row: impl Fn(&mut S, usize, &mut CostRow<'_>) + Sync + Send,
    ) {
        self.fill_levels(false, highest_cost, init, fill_row);
    }

    fn fill_levels<S>(
        &mut self,
        with_finest: bool,
        highest_cost: u8,
        init: impl Fn() -> S + Sync + Send,
        fill_row: impl Fn(&mut S, usize, &mut CostRow<'_>) + Sync + Send,
    ) {
        let (isa, highest) = (self.isa, self.settings.saturation());
        let cut = highest_cost > highest;
        let (finest, coarser) = self.levels.split_at_mut(1);
        let finest = &mut finest[0].costs;
        let (labels, board) = (finest.labels, finest.board);
        let finest_row = finest.row_bytes();
        let boards: Vec<Checkerboard> = coarser.iter().map(|level| level.costs.board).collect();
        // One strip makes one row of the coarsest level, while its rows are in the cache.
        let rows = 1 << coarser.len();
        let mut strips: Vec<(&mut [u8], Vec<&mut [u8]>)> = finest
            .bytes
            .chunks_mut(finest_row * rows)
            .map(|strip| (strip, Vec::new()))
            .collect();
        for (depth, level) in coarser.iter_mut().enumerate() {
            let bytes = level.costs.row_bytes() * (rows >> (depth + 1));
            for ((_, levels), chunk) in strips.iter_mut().zip(level.costs.bytes.chunks_mut(bytes)) {
                levels.push(chunk);
            }
        }
        // A row that is only summed up stays in the cache.
        let passing = if with_finest { 0 } else { finest_row };
        let sums = || {
            boards
                .iter()
                .map(|board| vec![0_u16; labels * board.width])
                .collect::<Vec<_>>()
        };
        strips.par_iter_mut().enumerate().for_each_init(
            || (init(), sums(), AlignedBytes::zeroed(passing)),
            |(state, sums, passing), (strip, (finest, levels))| {
                for (row, costs) in finest.chunks_exact_mut(finest_row).enumerate() {
                    let y = strip * rows + row;
                    let costs = if with_finest { costs } else { &mut passing[..] };
                    fill_row(
                        state,
                        y,
                        &mut CostRow {
                            y,
                            board: &board,
                            labels,
                            bytes: costs,
                        },
                    );
                    // Before the costs are cut, so that coarser sums are exact.
                    if let Some(sums) = sums.first_mut() {
                        let (a, b) = costs.split_at(finest_row / 2);
                        sum_into(isa, sums, boards[0].width, a, b, board.stride, y % 2 == 0);
                    }
                    if cut && with_finest {
                        for half_row in costs.chunks_exact_mut(finest_row / 2) {
                            saturate(isa, half_row, board.stride, highest);
                        }
                    }
                    // Rows that end here, at each level.
                    let (mut y, mut last) = (y, board.height - 1);
                    for (depth, level) in levels.iter_mut().enumerate() {
                        if y % 2 == 0 && y != last {
                            break;
                        }
                        (y, last) = (y / 2, last / 2);
                        let bytes = 2 * labels * boards[depth].stride;
                        let row = &mut level[y % (rows >> (depth + 1)) * bytes..][..bytes];
                        let (sum, rest) = sums[depth..].split_at_mut(1);
                        cut_into(isa, &sum[0], &boards[depth], y, highest, row);
                        if let Some(next) = rest.first_mut() {
                            sum_pairs(
                                isa,
                                &sum[0],
                                boards[depth].width,
                                next,
                                boards[depth + 1].width,
                                y % 2 == 0,
                            );
                        }
                    }
                }
            },
        );
    }

    /// Beliefs of all pixels, row by row. Runs on the threads of the current rayon pool; the result does not depend on
    /// their number.
    pub fn solve(&mut self) -> &mut [Belief] {
        for at in (0..self.levels.len()).rev() {
            self.propagate(at, at > 0);
        }
        &mut self.beliefs
    }

    /// Solves all levels but the finest: beliefs of 2x2 pixels each, row by row. Where there is but one level, all is
    /// believed to be far.
    pub fn solve_coarse(&mut self) -> &[Belief] {
        for at in (1..self.levels.len()).rev() {
            self.propagate(at, at > 1);
        }
        &self.coarse_beliefs
    }

    /// Of the last [`solve`](Self::solve).
    pub fn beliefs(&self) -> &[Belief] {
        &self.beliefs
    }

    /// All iterations of one level, and then what the next finer one gets if it is handed down, or the caller.
    fn propagate(&mut self, at: usize, hand_down: bool) {
        let Self {
            settings,
            isa,
            levels,
            beliefs,
            coarse_beliefs,
        } = self;
        let (finer, level) = levels.split_at_mut(at);
        let Level {
            costs,
            weights,
            first,
            rings,
        } = &mut level[0];
        let Checkerboard {
            width,
            height,
            stride,
            ..
        } = costs.board;
        let iterations = settings.iterations_at(at);
        // A narrow band would do more rows of its neighbours than of its own.
        let bands = rayon::current_num_threads()
            .min(height / (4 * (iterations + 1)))
            .max(1);
        let rows = height.div_ceil(bands);
        let bands = height.div_ceil(rows);
        // Even, so that each slot keeps its parity, and what nobody sends at the left and right border stays 0.
        let slots = (iterations + 3).next_multiple_of(2);
        rings.resize_with(bands, || {
            (0..slots)
                .map(|_| AlignedBytes::zeroed(8 * costs.labels * stride))
                .collect()
        });
        let walk = Walk {
            costs,
            weights,
            first,
            iterations,
            isa: *isa,
        };
        let outputs: Vec<Output<'_>> = if hand_down {
            let finer = finer.last_mut().expect("a coarser level has a finer one");
            let (labels, stride) = (finer.costs.labels, finer.costs.board.stride);
            finer
                .first
                .chunks_mut(4 * labels * stride * rows)
                .map(|first| Output::First { first, stride })
                .collect()
        } else {
            let beliefs = if at == 0 { beliefs } else { coarse_beliefs };
            beliefs
                .chunks_mut(width * rows)
                .map(Output::Beliefs)
                .collect()
        };
        rings
            .par_iter_mut()
            .zip(outputs)
            .enumerate()
            .for_each(|(band, (ring, mut output))| {
                let first = band * rows;
                walk.band(first..(first + rows).min(height), ring, &mut output);
            });
    }
}

/// Adds one row of the finest level, both colours, to the row of the next: `[label][x]`.
fn sum_into(
    isa: Isa,
    sums: &mut [u16],
    width: usize,
    a: &[u8],
    b: &[u8],
    stride: usize,
    first: bool,
) {
    #[inline(always)]
    fn run<V: Lanes>(
        sums: &mut [u16],
        width: usize,
        a: &[u8],
        b: &[u8],
        stride: usize,
        first: bool,
    ) {
        let rows = sums
            .chunks_exact_mut(width)
            .zip(a.chunks_exact(stride).zip(b.chunks_exact(stride)));
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
fn sum_pairs(
    isa: Isa,
    sums: &[u16],
    width: usize,
    next: &mut [u16],
    next_width: usize,
    first: bool,
) {
    #[inline(always)]
    fn run<V: Lanes>(sums: &[u16], width: usize, next: &mut [u16], next_width: usize, first: bool) {
        for (sums, next) in sums
            .chunks_exact(width)
            .zip(next.chunks_exact_mut(next_width))
        {
            let (pairs, rest) = sums.as_chunks::<2>();
            if first {
                next.fill(0);
            }
            for (pair, next) in pairs.iter().zip(&mut *next) {
                *next += pair[0] + pair[1];
            }
            if let [last] = rest {
                next[pairs.len()] += last;
            }
        }
    }
    for_each_isa! {
        unsafe fn dispatched = run(sums: &[u16], width: usize, next: &mut [u16], next_width: usize, first: bool)
    }
    // SAFETY: `isa` is available; the kernel is safe code.
    unsafe { dispatched(isa, sums, width, next, next_width, first) }
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
                let at = label * stride + from / 2;
                let even = &mut even[at..at + n.div_ceil(2)];
                let odd = &mut odd[at..at + n / 2];
                // As words, which compilers vectorise.
                for (to, cut) in even.iter_mut().zip(cut.as_chunks::<2>().0) {
                    *to = u16::from_le_bytes(*cut) as u8;
                }
                for (to, cut) in odd.iter_mut().zip(cut.as_chunks::<2>().0) {
                    *to = (u16::from_le_bytes(*cut) >> 8) as u8;
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

/// Cuts costs, `[label][index]`, to what messages can hold: each pixel's least becomes 0.
fn saturate(isa: Isa, half_row: &mut [u8], stride: usize, highest: u8) {
    let labels = half_row.len() / stride;
    // SAFETY: `isa` is available; the half row has `labels` rows of `stride` bytes, a multiple of 64.
    unsafe { saturate_half_row(isa, half_row.as_mut_ptr(), labels, stride, highest) };
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
        let Checkerboard {
            width,
            height,
            stride,
            half,
        } = self.costs.board;
        if let Some(Contrast { right, below }) = contrast {
            assert!(
                right.len() == width * height && below.len() == width * height,
                "one contrast a pixel"
            );
        }
        let PropagationSettings {
            smooth,
            across_contrast,
            ..
        } = *settings;
        let alike = vec![0; width];
        let isa = Isa::detect();
        self.weights
            .par_chunks_exact_mut(16 * stride)
            .enumerate()
            .for_each_init(
                || [(); 4].map(|()| vec![0; 2 * half + 1]),
                |classes, (y, weights)| {
                    let row = |differs: fn(&Contrast) -> &[u8], y: usize| {
                        contrast.map_or(&alike[..], |contrast| {
                            &differs(contrast)[y * width..][..width]
                        })
                    };
                    // Per pixel towards each neighbour: 0 = alike, 1 = not, 2 = there is none.
                    let mut put = |neighbour: usize, first: usize, edges: &[u8]| {
                        let class = &mut classes[neighbour];
                        class.fill(NO_EDGE);
                        for (class, differs) in class[first..].iter_mut().zip(edges) {
                            *class = u8::from(*differs > 0);
                        }
                    };
                    put(RIGHT, 0, &row(|contrast| &contrast.right, y)[..width - 1]);
                    put(LEFT, 1, &row(|contrast| &contrast.right, y)[..width - 1]);
                    put(
                        BELOW,
                        0,
                        if y + 1 < height {
                            row(|contrast| &contrast.below, y)
                        } else {
                            &[]
                        },
                    );
                    put(
                        ABOVE,
                        0,
                        if y > 0 {
                            row(|contrast| &contrast.below, y - 1)
                        } else {
                            &[]
                        },
                    );
                    for (colour, weights) in weights.chunks_exact_mut(8 * stride).enumerate() {
                        let parity = Checkerboard::parity(y, colour);
                        for (neighbour, class) in classes.iter().enumerate() {
                            let (steps, truncations) =
                                weights[neighbour * stride..].split_at_mut(4 * stride);
                            let class = &class[parity..parity + 2 * half];
                            weigh_edges(
                                isa,
                                class,
                                [smooth.step, across_contrast.step],
                                &mut steps[..half],
                            );
                            let truncation = [smooth.truncation, across_contrast.truncation];
                            weigh_edges(isa, class, truncation, &mut truncations[..half]);
                        }
                    }
                },
            );
    }
}

const NO_EDGE: u8 = 2;

/// Of every second class its value, 0 where there is no edge.
fn weigh_edges(isa: Isa, classes: &[u8], values: [u8; 2], weights: &mut [u8]) {
    #[inline(always)]
    fn run<V: Lanes>(classes: &[u8], values: [u8; 2], weights: &mut [u8]) {
        for (weight, class) in weights.iter_mut().zip(classes.as_chunks::<2>().0) {
            let value = if class[0] == 0 { values[0] } else { values[1] };
            *weight = if class[0] == NO_EDGE { 0 } else { value };
        }
    }
    for_each_isa! {
        unsafe fn dispatched = run(classes: &[u8], values: [u8; 2], weights: &mut [u8])
    }
    // SAFETY: `isa` is available; the kernel is safe code.
    unsafe { dispatched(isa, classes, values, weights) }
}

/// What a band leaves behind.
enum Output<'a> {
    /// Of its rows.
    Beliefs(&'a mut [Belief]),
    /// Its rows' messages, as [`Level::first`] of the finer level with that stride.
    First { first: &'a mut [u8], stride: usize },
}

/// What the rows of one level share, see [`Level`].
struct Walk<'a> {
    costs: &'a CostVolume,
    weights: &'a [u8],
    first: &'a [u8],
    iterations: usize,
    isa: Isa,
}

impl Walk<'_> {
    /// Iteration 0 up to the last, and then the output, each one row behind the one before.
    fn band(&self, rows: Range<usize>, ring: &mut [AlignedBytes], output: &mut Output<'_>) {
        let height = self.costs.board.height;
        let start = rows.start.saturating_sub(self.iterations);
        let end = (rows.end + self.iterations).min(height);
        self.enter(start, ring);
        for front in start..end + self.iterations {
            if front + 1 < height {
                self.enter(front + 1, ring);
            }
            for pass in 0..=self.iterations {
                // What depends on rows that this band has not done is not its own either.
                let beyond = self.iterations - pass;
                let Some(y) = front.checked_sub(pass) else {
                    break;
                };
                if y + beyond < rows.start || y >= (rows.end + beyond).min(height) {
                    continue;
                }
                if pass < self.iterations {
                    self.iterate(pass, y, ring);
                } else {
                    self.put(y, y - rows.start, &ring[y % ring.len()], output);
                }
            }
        }
    }

    /// A row comes into the ring: whatever is received there will be written before it is read, but for what nobody
    /// sends across the upper and lower border.
    fn enter(&self, y: usize, ring: &mut [AlignedBytes]) {
        let plane = self.costs.labels * self.costs.board.stride;
        let slot = y % ring.len();
        for block in ring[slot].chunks_exact_mut(4 * plane) {
            if y == 0 {
                block[ABOVE * plane..][..plane].fill(0);
            }
            if y + 1 == self.costs.board.height {
                block[BELOW * plane..][..plane].fill(0);
            }
        }
    }

    fn sender<'a>(&'a self, y: usize, colour: usize, received: &'a [u8]) -> Sender<'a> {
        let Checkerboard { half, stride, .. } = self.costs.board;
        Sender {
            labels: self.costs.labels,
            half,
            stride,
            parity: Checkerboard::parity(y, colour),
            costs: self.costs.half_row(y, colour),
            received,
            ask_for_next: false,
            weights: &self.weights[(2 * y + colour) * 8 * stride..][..8 * stride],
        }
    }

    fn iterate(&self, iteration: usize, y: usize, ring: &mut [AlignedBytes]) {
        let slots = ring.len();
        // Rows outside the image have slots too, whose rows are done or not yet there: nobody reads what they get.
        let near = [(y + slots - 1) % slots, y % slots, (y + 1) % slots];
        let [above, own, below] = ring
            .get_disjoint_mut(near)
            .expect("a ring has at least four slots");
        let block = own.len() / 2;
        let (colour_0, colour_1) = own.split_at_mut(block);
        let colour = iteration & 1;
        let (received, row) = if colour == 0 {
            (colour_0, colour_1)
        } else {
            (colour_1, colour_0)
        };
        let received = if iteration == 0 {
            let rows = self.first.len() / block;
            &self.first[(y / 2 % rows) * block..][..block]
        } else {
            &*received
        };
        let other = (1 - colour) * block..(2 - colour) * block;
        let (above, below) = (&mut above[other.clone()], &mut below[other]);
        let mut sender = self.sender(y, colour, received);
        // Two rows share what was handed down.
        sender.ask_for_next = iteration == 0 && y % 2 == 1;
        messages::send(self.isa, &sender, above, row, below);
    }

    fn put(&self, y: usize, row: usize, messages: &[u8], output: &mut Output<'_>) {
        let Checkerboard { width, stride, .. } = self.costs.board;
        let (colour_0, colour_1) = messages.split_at(messages.len() / 2);
        match output {
            Output::Beliefs(beliefs) => {
                let row = &mut beliefs[row * width..][..width];
                messages::believe(self.isa, &self.sender(y, 0, colour_0), width, row);
                messages::believe(self.isa, &self.sender(y, 1, colour_1), width, row);
            }
            Output::First {
                first,
                stride: finer_stride,
            } => {
                let bytes = 4 * self.costs.labels * *finer_stride;
                let to = &mut first[row * bytes..][..bytes];
                let (even, odd) = if Checkerboard::parity(y, 0) == 0 {
                    (colour_0, colour_1)
                } else {
                    (colour_1, colour_0)
                };
                interleave(self.isa, even, odd, stride, to, *finer_stride, width);
            }
        }
    }
}

/// Two half rows of a coarser level, `[..][index]`, into one half row of the finer: each pixel of one colour has its own
/// 2x2 parent, so its index is the parent's x.
fn interleave(
    isa: Isa,
    even: &[u8],
    odd: &[u8],
    coarse_stride: usize,
    to: &mut [u8],
    stride: usize,
    half: usize,
) {
    #[inline(always)]
    fn run<V: Lanes>(
        even: &[u8],
        odd: &[u8],
        coarse_stride: usize,
        to: &mut [u8],
        stride: usize,
        half: usize,
    ) {
        let rows = even
            .chunks_exact(coarse_stride)
            .zip(odd.chunks_exact(coarse_stride));
        for ((even, odd), to) in rows.zip(to.chunks_exact_mut(stride)) {
            // An odd last one takes its pair's other half into the padding.
            let pairs = to[..half.next_multiple_of(2)].as_chunks_mut::<2>().0;
            // As words, which compilers vectorise.
            for ((to, even), odd) in pairs.iter_mut().zip(even).zip(odd) {
                *to = (u16::from(*even) | u16::from(*odd) << 8).to_le_bytes();
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
