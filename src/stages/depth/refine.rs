//! From labels to depth: below one label, and only where something can be said.
//! In: a belief a pixel, the sides as turned for the sweep. Out: metres, confidence, which sides see the pixel.
//! Open in the paper: all of it. Chosen: a surface does not jump where labels differ by one, so a pixel's inverse depth
//! is the mean label of the pixels around it that differ by at most one; a pixel is hidden from a side where its
//! ray passes one that the side sees nearer by more than a label and a pixel; no depth where no side sees it or
//! where a label elsewhere is believed as much.

use super::messages::Belief;
use rayon::prelude::*;

/// Pixels to each side over which labels are averaged.
const REACH: usize = 3;

/// Mean label around each pixel: along rows into `along_rows`, then along columns into `refined`.
pub(super) fn refine(
    beliefs: &[Belief],
    width: usize,
    along_rows: &mut [f32],
    refined: &mut [f32],
) {
    let height = beliefs.len() / width;
    along_rows
        .par_chunks_exact_mut(width)
        .zip(beliefs.par_chunks_exact(width))
        .for_each(|(to, row)| {
            for (x, to) in to.iter_mut().enumerate() {
                let own = row[x].label;
                let (mut sum, mut count) = (0_u32, 0_u32);
                let around = &row[x.saturating_sub(REACH)..(x + REACH + 1).min(width)];
                for other in around {
                    let alike = u32::from(other.label.abs_diff(own) <= 1);
                    sum += alike * u32::from(other.label);
                    count += alike;
                }
                *to = sum as f32 / count as f32;
            }
        });
    let along_rows = &*along_rows;
    refined
        .par_chunks_exact_mut(width)
        .enumerate()
        .for_each(|(y, to)| {
            let rows = y.saturating_sub(REACH)..(y + REACH + 1).min(height);
            for (x, to) in to.iter_mut().enumerate() {
                let own = beliefs[y * width + x].label;
                let (mut sum, mut count) = (0.0, 0.0);
                for other in rows.clone().map(|row| row * width + x) {
                    let alike = f32::from(u8::from(beliefs[other].label.abs_diff(own) <= 1));
                    sum += alike * along_rows[other];
                    count += alike;
                }
                *to = sum / count;
            }
        });
}
