//! From labels to depth: below one label, and only where something can be said.
//! In: a belief a pixel, the sides as turned for the sweep. Out: metres, confidence, which sides see the pixel.
//! Open in the paper: all of it. Chosen: a surface does not jump where labels differ by one, so a pixel's inverse depth
//! is the mean label of the pixels around it that differ by at most one; a pixel is hidden from a side where its
//! ray passes one that the side sees nearer by more than a label and a pixel; no depth where no side sees it or
//! where a label elsewhere is believed as much.

use super::messages::Belief;
use crate::isa::{Isa, for_each_isa};
use rayon::prelude::*;

/// Pixels to each side over which labels are averaged.
const REACH: usize = 3;
/// In place of a label beyond the image: unlike every one.
const BEYOND: u16 = u16::MAX;

/// What is computed on the way, kept for the next frame.
#[derive(Default)]
pub(super) struct Refiner {
    labels: Vec<u8>,
    /// Mean label along each row.
    along_rows: Vec<f32>,
}

impl Refiner {
    /// Mean label around each pixel: along rows, then along columns into `refined`.
    pub fn refine(&mut self, isa: Isa, beliefs: &[Belief], width: usize, refined: &mut [f32]) {
        let height = beliefs.len() / width;
        self.labels.clear();
        self.labels
            .extend(beliefs.iter().map(|belief| belief.label));
        self.along_rows.resize(beliefs.len(), 0.0);
        let labels = &*self.labels;
        self.along_rows
            .par_chunks_exact_mut(width)
            .zip(labels.par_chunks_exact(width))
            .for_each_init(
                || vec![BEYOND; width + 2 * REACH],
                |padded, (means, row)| average_along(isa, row, padded, means),
            );
        let along_rows = &*self.along_rows;
        refined
            .par_chunks_exact_mut(width)
            .enumerate()
            .for_each_init(
                || vec![0.0; width],
                |counts, (y, sums)| {
                    let row = |y: usize| y * width..(y + 1) * width;
                    counts.fill(0.0);
                    sums.fill(0.0);
                    for other in y.saturating_sub(REACH)..(y + REACH + 1).min(height) {
                        let (own, labels) = (&labels[row(y)], &labels[row(other)]);
                        add_alike(isa, own, labels, &along_rows[row(other)], sums, counts);
                    }
                    for (sum, count) in sums.iter_mut().zip(counts) {
                        *sum /= *count;
                    }
                },
            );
    }
}

for_each_isa! {
    fn average_along(row: &[u8], padded: &mut [u16], means: &mut [f32]) = average_along_kernel;
}

/// `padded` is [`BEYOND`] at both ends.
#[inline(always)]
fn average_along_kernel(row: &[u8], padded: &mut [u16], means: &mut [f32]) {
    for (padded, label) in padded[REACH..].iter_mut().zip(row) {
        *padded = u16::from(*label);
    }
    let padded = &padded[..means.len() + 2 * REACH];
    for x in 0..means.len() {
        let own = padded[x + REACH];
        let (mut sum, mut count) = (0_u16, 0_u16);
        for around in 0..=2 * REACH {
            let other = padded[x + around];
            let alike = other.abs_diff(own) <= 1;
            sum += if alike { other } else { 0 };
            count += u16::from(alike);
        }
        means[x] = f32::from(sum) / f32::from(count);
    }
}

for_each_isa! {
    fn add_alike(own: &[u8], other: &[u8], means: &[f32], sums: &mut [f32], counts: &mut [f32]) = add_alike_kernel;
}

#[inline(always)]
fn add_alike_kernel(own: &[u8], other: &[u8], means: &[f32], sums: &mut [f32], counts: &mut [f32]) {
    let n = own.len();
    let (other, means) = (&other[..n], &means[..n]);
    let (sums, counts) = (&mut sums[..n], &mut counts[..n]);
    for x in 0..n {
        let alike = other[x].abs_diff(own[x]) <= 1;
        sums[x] += if alike { means[x] } else { 0.0 };
        counts[x] += if alike { 1.0 } else { 0.0 };
    }
}
