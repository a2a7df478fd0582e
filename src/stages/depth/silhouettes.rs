//! Silhouettes follow colour: each pixel beside a jump of depth takes the weighted median label of those around it, those
//! of like colour and those believed firmly counting most. Messages jump at any pixel of a contrast that spans two or
//! three; this tells on which side of it a pixel is.
//! In: a belief a pixel, the middle image. Out: the beliefs, some replaced by what was believed beside them. Open in the paper: all of it. Chosen: the
//! weighted median, as it invents no depth between two surfaces (Ma et al. 2013), of bytes, so that it is the same on
//! every processor.

use super::messages::Belief;
use crate::isa::{Isa, for_each_isa};
use rayon::prelude::*;

/// Pixels to each side that are asked.
const REACH: usize = 2;
const SIDE: usize = 2 * REACH + 1;
const AROUND: usize = SIDE * SIDE;
/// Levels of the most different colour from which a pixel has no vote.
const UNLIKE: u8 = 32;
/// Votes of a belief grow with its margin, up to this many: 25 of the heaviest still sum up in 16 bits.
const MOST_VOTES: u8 = 25;

/// Buffers are kept for the next frame.
#[derive(Default)]
pub(super) struct Silhouettes {
    labels: Vec<u8>,
    votes: Vec<u8>,
}

/// One byte a pixel each.
#[derive(Clone, Copy)]
struct Planes<'a> {
    labels: &'a [u8],
    votes: &'a [u8],
    colours: [&'a [u8]; 3],
    width: usize,
}

impl Silhouettes {
    /// `colours` are red, green and blue of the image that is believed about.
    pub fn follow(&mut self, isa: Isa, colours: [&[u8]; 3], width: usize, beliefs: &mut [Belief]) {
        self.labels.clear();
        self.labels
            .extend(beliefs.iter().map(|belief| belief.label));
        self.votes.clear();
        self.votes.extend(
            beliefs
                .iter()
                .map(|belief| belief.margin().min(MOST_VOTES - 1) + 1),
        );
        let planes = Planes {
            labels: &self.labels,
            votes: &self.votes,
            colours,
            width,
        };
        beliefs
            .par_chunks_exact_mut(width)
            .enumerate()
            .with_min_len(8)
            .for_each_init(
                || vec![0; width],
                |jumps, (y, beliefs)| follow_row(isa, &planes, y, jumps, beliefs),
            );
    }
}

for_each_isa! {
    fn follow_row(planes: &Planes<'_>, y: usize, jumps: &mut [u8], beliefs: &mut [Belief]) = follow_row_kernel;
}

#[inline(always)]
fn follow_row_kernel(planes: &Planes<'_>, y: usize, jumps: &mut [u8], beliefs: &mut [Belief]) {
    let Planes { labels, width, .. } = *planes;
    let height = labels.len() / width;
    let row = |y: usize| &labels[y * width..][..width];
    let own = row(y);
    find_jumps(
        own,
        row(y.saturating_sub(1)),
        row((y + 1).min(height - 1)),
        jumps,
    );
    let rows: [usize; SIDE] =
        std::array::from_fn(|i| (y + i).saturating_sub(REACH).min(height - 1) * width);
    for (x, jumps) in jumps.iter().enumerate() {
        if *jumps == 0 {
            continue;
        }
        let (label, margin) = median(planes, &rows, y * width + x, x);
        let belief = &mut beliefs[x];
        if label != belief.label {
            *belief = Belief {
                label,
                cost: 0,
                rival_cost: margin,
            };
        }
    }
}

/// 1 where a label is more than one from that to the left, right, above or below, else 0.
#[inline(always)]
fn find_jumps(own: &[u8], above: &[u8], below: &[u8], jumps: &mut [u8]) {
    let n = own.len();
    let (above, below, jumps) = (&above[..n], &below[..n], &mut jumps[..n]);
    for x in 0..n {
        let apart = own[x].abs_diff(above[x]).max(own[x].abs_diff(below[x]));
        jumps[x] = u8::from(apart > 1);
    }
    for x in 1..n {
        jumps[x] |= u8::from(own[x].abs_diff(own[x - 1]) > 1);
    }
    for x in 1..n {
        jumps[x - 1] |= u8::from(own[x].abs_diff(own[x - 1]) > 1);
    }
}

/// And the margin of the pixel that spoke for it most. `rows` are where the rows around begin; beyond the image they
/// repeat its border.
#[inline(always)]
fn median(planes: &Planes<'_>, rows: &[usize; SIDE], pixel: usize, x: usize) -> (u8, u8) {
    let Planes {
        labels,
        votes,
        colours,
        width,
    } = planes;
    let around = |plane: &[u8]| -> [u8; AROUND] {
        let mut to = [0; AROUND];
        for (to, row) in to.chunks_exact_mut(SIDE).zip(rows) {
            if x >= REACH && x + REACH < *width {
                to.copy_from_slice(&plane[row + x - REACH..][..SIDE]);
            } else {
                for (i, to) in to.iter_mut().enumerate() {
                    *to = plane[row + (x + i).saturating_sub(REACH).min(width - 1)];
                }
            }
        }
        to
    };
    let mut unlike = [0; AROUND];
    for plane in colours {
        let (own, others) = (plane[pixel], around(plane));
        for (unlike, other) in unlike.iter_mut().zip(others) {
            *unlike = other.abs_diff(own).max(*unlike);
        }
    }
    let (labels, votes) = (around(labels), around(votes));
    let mut weights = [0_u16; AROUND];
    let mut all = 0;
    for i in 0..AROUND {
        weights[i] = u16::from(UNLIKE.saturating_sub(unlike[i])) * u16::from(votes[i]);
        all += weights[i];
    }
    // The least label that has half of the votes at or below it.
    let (mut low, mut high) = (255, 0);
    for label in labels {
        low = label.min(low);
        high = label.max(high);
    }
    while low < high {
        let middle = low + (high - low) / 2;
        let mut up_to = 0;
        for i in 0..AROUND {
            up_to += if labels[i] <= middle { weights[i] } else { 0 };
        }
        if 2 * u32::from(up_to) >= u32::from(all) {
            high = middle;
        } else {
            low = middle + 1;
        }
    }
    let (mut most, mut margin) = (0, 0);
    for i in 0..AROUND {
        if labels[i] == low && weights[i] > most {
            (most, margin) = (weights[i], votes[i] - 1);
        }
    }
    (low, margin)
}
