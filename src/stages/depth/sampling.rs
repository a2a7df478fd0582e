//! Where each hypothesis finds a row of the middle image in a side image: samples, and the interval of luminance that
//! a hypothesis and its halves towards the next ones span. In half grey levels, as dark wood has few: whole levels would
//! make depths cheap whose samples fall on pixels, all over a plain surface.
//! In: a turned side image. Out: a [`Strip`] a row. A rig that shifts along rows alone takes its samples from one table a
//! row of eight sub-pixel phases; any other has each hypothesis' row sampled by itself.

use super::{
    checkerboard::Checkerboard,
    lanes::{Lanes, for_each_isa},
    rig::InverseDepthRange,
    side::{OUTSIDE, Side},
};
use crate::{isa::Isa, model::camera::Intrinsics};

/// Of a level, added before it is cut off: the two roundings of a [`Strip`], or one if it is not `fine`.
fn roundings(fine: bool) -> &'static [u16] {
    if fine { &[1, 3] } else { &[2] }
}

/// Sub-pixel phases of the tables.
const PHASES: usize = 8;

/// Pixels of a row that a hypothesis may reach beyond the image; no vote there.
pub(super) const VECTOR_SLACK: usize = 64;

/// Samples of one side for one row: where each label's are.
#[derive(Default, Clone)]
pub(super) struct Strip {
    /// Least, greatest luminance of each sample's interval, once rounded up above a quarter and once above three
    /// quarters of a level: their sum is in half levels. Where it is not `fine`, the first alone, rounded as usual.
    pub low: [Vec<u8>; 2],
    pub high: [Vec<u8>; 2],
    /// What blocks the view of a sample.
    pub blocker: Vec<u8>,
    /// `[label][parity]`: first sample of the half row, in `low` and `high` and in `blocker`.
    pub at: Vec<[usize; 2]>,
    pub blocker_at: Vec<[usize; 2]>,
    scratch: Vec<u8>,
}

impl Strip {
    /// One that never has a vote.
    fn blind(labels: usize, half: usize) -> Self {
        let none = vec![0; half + VECTOR_SLACK];
        let at = vec![[0; 2]; labels];
        Self {
            low: [none.clone(), none.clone()],
            high: [none.clone(), none],
            blocker: vec![OUTSIDE; half + VECTOR_SLACK],
            blocker_at: at.clone(),
            at,
            scratch: Vec::new(),
        }
    }
}

/// How a row of one side is sampled.
pub(super) enum Sampler<'a> {
    Blind,
    /// All labels shift along the row: `[label]` in 1/8 pixel, `radius` to the interval's ends.
    Rows {
        side: &'a Side,
        eighths: Vec<isize>,
        radius: isize,
    },
    /// `[2 * label + 1]` and the two halves beside it: scale and first x, y.
    Free {
        side: &'a Side,
        motions: Vec<(f64, f64, f64)>,
    },
}

impl<'a> Sampler<'a> {
    pub fn new(side: Option<&'a Side>, middle: &Intrinsics, range: &InverseDepthRange) -> Self {
        let Some(side) = side else { return Self::Blind };
        if side.motion.along_rows(middle, range) {
            let most = side.margin as f64 - 1.0;
            let eighths = |label: f64| {
                let (_, x, _) = side.motion.at(range.inverse_depth(label));
                (x.clamp(-most, most) * PHASES as f64).round() as isize
            };
            let step = (range.step() * side.motion.x).abs();
            return Self::Rows {
                side,
                eighths: (0..range.labels)
                    .map(|label| eighths(label as f64))
                    .collect(),
                radius: (step / 2.0 * PHASES as f64)
                    .round()
                    .clamp(0.0, PHASES as f64 / 2.0) as isize,
            };
        }
        let motions = (0..=2 * range.labels)
            .map(|half_label| {
                side.motion
                    .at(range.inverse_depth((half_label as f64 - 1.0) / 2.0))
            })
            .collect();
        Self::Free { side, motions }
    }

    pub fn strip(&self, labels: usize, board: &Checkerboard) -> Strip {
        match self {
            Self::Blind => Strip::blind(labels, board.half),
            Self::Rows { side, eighths, .. } => {
                let line = side.width.div_ceil(2) + VECTOR_SLACK;
                // First pixel and phase of a label, and of its half rows.
                let place = |eighths: &isize, parity: usize| {
                    let (pixels, phase) = (
                        eighths.div_euclid(PHASES as isize),
                        eighths.rem_euclid(PHASES as isize),
                    );
                    let x = (side.margin as isize + pixels) as usize + parity;
                    (x, phase as usize)
                };
                let at = |eighths: &isize, parity: usize| {
                    let (x, phase) = place(eighths, parity);
                    (x % 2 * PHASES + phase) * line + x / 2
                };
                let blocker_at = |eighths: &isize, parity: usize| {
                    let (x, phase) = place(eighths, parity);
                    (x % 2 * 2 + phase.min(1)) * line + x / 2
                };
                Strip {
                    low: [(); 2].map(|()| vec![0; 2 * PHASES * line]),
                    high: [(); 2].map(|()| vec![0; 2 * PHASES * line]),
                    blocker: vec![OUTSIDE; 4 * line],
                    at: eighths
                        .iter()
                        .map(|eighths| [at(eighths, 0), at(eighths, 1)])
                        .collect(),
                    blocker_at: eighths
                        .iter()
                        .map(|eighths| [blocker_at(eighths, 0), blocker_at(eighths, 1)])
                        .collect(),
                    scratch: vec![0; (2 * PHASES + 4) * line],
                }
            }
            Self::Free { side, motions } => {
                let line = board.half + VECTOR_SLACK;
                let at: Vec<_> = (0..labels)
                    .map(|label| [0, 1].map(|parity| (label * 2 + parity) * line))
                    .collect();
                Strip {
                    low: [(); 2].map(|()| vec![0; labels * 2 * line]),
                    high: [(); 2].map(|()| vec![0; labels * 2 * line]),
                    blocker: vec![OUTSIDE; labels * 2 * line],
                    blocker_at: at.clone(),
                    at,
                    scratch: vec![0; 2 * (side.width + 2) + 2 * motions.len() * (board.width + 1)],
                }
            }
        }
    }

    pub fn fill(&self, isa: Isa, y: usize, board: &Checkerboard, fine: bool, strip: &mut Strip) {
        match self {
            Self::Blind => {}
            Self::Rows { side, radius, .. } => {
                let from = (y + side.margin_rows) * side.width;
                let row = &side.luminance[from..from + side.width];
                let blocker = &side.blocker[from..from + side.width];
                // SAFETY: `isa` is available; the kernel is safe code.
                unsafe { fill_phases(isa, row, blocker, *radius, fine, strip) };
            }
            Self::Free { side, motions } => fill_free(isa, side, motions, y, board, fine, strip),
        }
    }
}

for_each_isa! {
    unsafe fn fill_phases = fill_phases_kernel(row: &[u8], blocker: &[u8], radius: isize, fine: bool, strip: &mut Strip)
}

/// The row at eight sub-pixel phases, even and odd pixels apart, with the interval to `radius` eighths around. Sample `i`
/// of phase `q` in 0..16 stands at pixel `2 i + q / 8`.
#[inline(always)]
fn fill_phases_kernel<V: Lanes>(
    row: &[u8],
    blocker: &[u8],
    radius: isize,
    fine: bool,
    strip: &mut Strip,
) {
    let line = row.len().div_ceil(2) + VECTOR_SLACK;
    let n = row.len().div_ceil(2);
    let Strip {
        low,
        high,
        blocker: blockers,
        scratch,
        ..
    } = strip;
    let (phases, pixels) = scratch.split_at_mut(2 * PHASES * line);
    let (row_even, rest) = pixels.split_at_mut(line);
    let (row_odd, rest) = rest.split_at_mut(line);
    let (blocker_even, blocker_odd) = rest.split_at_mut(line);
    part(row, row_even, row_odd);
    part(blocker, blocker_even, blocker_odd);
    // One sample of margin at the front, for intervals that begin before the row, and one at the end.
    for ((low, high), quarters) in low.iter_mut().zip(high).zip(roundings(fine)) {
        let up = quarters * PHASES as u16 / 4;
        for phase in 0..PHASES {
            let (w1, w0) = (phase as u16, (PHASES - phase) as u16);
            let even = &mut phases[phase * line..][..n + 2];
            for i in 0..n {
                even[1 + i] = ((u16::from(row_even[i]) * w0 + u16::from(row_odd[i]) * w1 + up)
                    / PHASES as u16) as u8;
            }
            (even[0], even[n + 1]) = (even[1], even[n]);
            let odd = &mut phases[(PHASES + phase) * line..][..n + 2];
            for i in 0..n {
                odd[1 + i] = ((u16::from(row_odd[i]) * w0 + u16::from(row_even[i + 1]) * w1 + up)
                    / PHASES as u16) as u8;
            }
            (odd[0], odd[n + 1]) = (odd[1], odd[n]);
        }
        for q in 0..2 * PHASES {
            let begin = |eighths: isize| {
                let at = q as isize + eighths;
                let (pairs, q) = (
                    at.div_euclid(2 * PHASES as isize),
                    at.rem_euclid(2 * PHASES as isize) as usize,
                );
                q * line + (1 + pairs) as usize
            };
            let before = &phases[begin(-radius)..][..n];
            let here = &phases[begin(0)..][..n];
            let after = &phases[begin(radius)..][..n];
            let (low, high) = (&mut low[q * line..][..n], &mut high[q * line..][..n]);
            for i in 0..n {
                low[i] = before[i].min(here[i]).min(after[i]);
                high[i] = before[i].max(here[i]).max(after[i]);
            }
        }
    }
    // A sample between two pixels needs both.
    for i in 0..n {
        blockers[i] = blocker_even[i];
        blockers[line + i] = blocker_even[i].max(blocker_odd[i]);
        blockers[2 * line + i] = blocker_odd[i];
        blockers[3 * line + i] = blocker_odd[i].max(blocker_even[i + 1]);
    }
}

/// Even and odd pixels of a row; the one beyond its end is as its last.
#[inline(always)]
fn part(row: &[u8], even: &mut [u8], odd: &mut [u8]) {
    let (pairs, rest) = row.as_chunks::<2>();
    // As words, which compilers vectorise.
    for (even, pair) in even.iter_mut().zip(pairs) {
        *even = u16::from_le_bytes(*pair) as u8;
    }
    for (odd, pair) in odd.iter_mut().zip(pairs) {
        *odd = (u16::from_le_bytes(*pair) >> 8) as u8;
    }
    let last = row[row.len() - 1];
    even[pairs.len()] = last;
    if !rest.is_empty() {
        odd[pairs.len()] = last;
    }
}

/// Every label's row sampled by itself, where a hypothesis also shifts rows or scales.
fn fill_free(
    isa: Isa,
    side: &Side,
    motions: &[(f64, f64, f64)],
    y: usize,
    board: &Checkerboard,
    fine: bool,
    strip: &mut Strip,
) {
    let Strip {
        low,
        high,
        blocker,
        at,
        scratch,
        ..
    } = strip;
    let (scratch, samples) = scratch.split_at_mut(2 * (side.width + 2));
    let (values, blockers) = samples.split_at_mut(motions.len() * (board.width + 1));
    for ((low, high), quarters) in low.iter_mut().zip(high).zip(roundings(fine)) {
        let rows = values
            .chunks_exact_mut(board.width + 1)
            .zip(blockers.chunks_exact_mut(board.width + 1));
        for ((scale, x0, y0), (values, blockers)) in motions.iter().zip(rows) {
            // SAFETY: `isa` is available; the kernel is safe code.
            unsafe {
                sample_row(
                    isa,
                    side,
                    (*scale, *x0, *y0),
                    y,
                    4 * quarters,
                    scratch,
                    values,
                    blockers,
                )
            };
        }
        let row =
            |values: &[u8], half_label: usize, x: usize| values[half_label * (board.width + 1) + x];
        for (label, at) in at.iter().enumerate() {
            for (parity, at) in at.iter().enumerate() {
                for i in 0..(board.width - parity).div_ceil(2) {
                    let x = 2 * i + parity;
                    let of = |half_label: usize| row(values, half_label, x);
                    let (before, here, after) =
                        (of(2 * label), of(2 * label + 1), of(2 * label + 2));
                    low[at + i] = before.min(here).min(after);
                    high[at + i] = before.max(here).max(after);
                    blocker[at + i] = row(blockers, 2 * label + 1, x);
                }
            }
        }
    }
}

for_each_isa! {
    unsafe fn sample_row = sample_row_kernel(
        side: &Side, motion: (f64, f64, f64), y: usize, up: u16, scratch: &mut [u8], values: &mut [u8], blockers: &mut [u8],
    )
}

#[inline(always)]
fn sample_row_kernel<V: Lanes>(
    side: &Side,
    (scale, x0, y0): (f64, f64, f64),
    y: usize,
    up: u16,
    scratch: &mut [u8],
    values: &mut [u8],
    blockers: &mut [u8],
) {
    // Rows are one longer than the image.
    let width = values.len() - 1;
    let sixteenths = ((y as f64 * scale + y0 + side.margin_rows as f64) * 16.0).round() as i64;
    let rows = (side.luminance.len() / side.width) as i64;
    let (upper, weight) = (sixteenths.div_euclid(16), sixteenths.rem_euclid(16) as u16);
    if upper < 0 || upper + 1 >= rows {
        blockers.fill(OUTSIDE);
        values.fill(0);
        return;
    }
    let upper = upper as usize * side.width;
    let (blend, blocked) = scratch.split_at_mut(side.width + 2);
    let (a, b) = side.luminance[upper..upper + 2 * side.width].split_at(side.width);
    for ((to, a), b) in blend.iter_mut().zip(a).zip(b) {
        *to = ((u16::from(*a) * (16 - weight) + u16::from(*b) * weight + up) / 16) as u8;
    }
    let (a, b) = side.blocker[upper..upper + 2 * side.width].split_at(side.width);
    for ((to, a), b) in blocked.iter_mut().zip(a).zip(b) {
        *to = if weight == 0 { *a } else { *a.max(b) };
    }
    let last = side.width as i64 - 2;
    let first = x0 + side.margin as f64;
    if (scale - 1.0).abs() * width as f64 <= 1.0 / 16.0 {
        let sixteenths = (first * 16.0).round() as i64;
        let (pixel, weight) = (sixteenths.div_euclid(16), sixteenths.rem_euclid(16) as u16);
        let pixel = pixel.clamp(0, last + 1 - width as i64) as usize;
        let (blend, blocked) = (
            &blend[pixel..pixel + width + 1],
            &blocked[pixel..pixel + width + 1],
        );
        for ((to, a), b) in values[..width].iter_mut().zip(blend).zip(&blend[1..]) {
            *to = ((u16::from(*a) * (16 - weight) + u16::from(*b) * weight + up) / 16) as u8;
        }
        for ((to, a), b) in blockers[..width].iter_mut().zip(blocked).zip(&blocked[1..]) {
            *to = if weight == 0 { *a } else { *a.max(b) };
        }
        return;
    }
    // 16.16 fixed point along the row.
    let (mut position, step) = (
        (first * 65536.0).round() as i64,
        (scale * 65536.0).round() as i64,
    );
    for (value, blocker) in values[..width].iter_mut().zip(blockers.iter_mut()) {
        let pixel = position >> 16;
        let at = pixel.clamp(0, last) as usize;
        let weight = ((position >> 12) & 15) as u16;
        let (a, b) = (u16::from(blend[at]), u16::from(blend[at + 1]));
        *value = ((a * (16 - weight) + b * weight + up) / 16) as u8;
        *blocker = if pixel == at as i64 {
            blocked[at].max(blocked[at + 1])
        } else {
            OUTSIDE
        };
        position += step;
    }
}
