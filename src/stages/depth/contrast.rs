//! Where the middle image differs from pixel to pixel, at every resolution that labels are propagated at: there depth
//! may jump, and at a coarse level too, or a narrow thing would take its surroundings along.
//! In: luminance of the middle camera. Out: one [`Contrast`] a level. Open in the paper: all of it.

use super::belief_propagation::Contrast;

/// Finest first; buffers are kept for the next frame.
#[derive(Default)]
pub(super) struct Contrasts {
    /// Mean luminance of 2x2 pixels of the level below; of the second level first.
    coarser: Vec<Vec<u8>>,
    levels: Vec<Contrast>,
}

impl Contrasts {
    /// Contrast are more than `threshold` grey levels between neighbours.
    pub fn find(
        &mut self,
        luminance: &[u8],
        width: usize,
        levels: usize,
        threshold: u8,
    ) -> &[Contrast] {
        self.levels.resize_with(levels, Contrast::default);
        self.coarser.resize_with(levels.saturating_sub(1), Vec::new);
        let mut width = width;
        let mut finer = luminance;
        for (contrast, coarser) in self.levels.iter_mut().zip(&mut self.coarser) {
            find(finer, width, threshold, contrast);
            halve(finer, width, coarser);
            (finer, width) = (coarser, width.div_ceil(2));
        }
        if let Some(contrast) = self.levels.last_mut() {
            find(finer, width, threshold, contrast);
        }
        &self.levels
    }
}

fn find(luminance: &[u8], width: usize, threshold: u8, contrast: &mut Contrast) {
    let Contrast { right, below } = contrast;
    right.resize(luminance.len(), 0);
    below.resize(luminance.len(), 0);
    for (to, (a, b)) in right.iter_mut().zip(luminance.iter().zip(&luminance[1..])) {
        *to = u8::from(a.abs_diff(*b) > threshold);
    }
    for (to, (a, b)) in below
        .iter_mut()
        .zip(luminance.iter().zip(&luminance[width..]))
    {
        *to = u8::from(a.abs_diff(*b) > threshold);
    }
}

/// Means of 2x2 pixels; what an odd last row or column lacks is as that row or column.
fn halve(luminance: &[u8], width: usize, half: &mut Vec<u8>) {
    let columns = width.div_ceil(2);
    let rows = (luminance.len() / width).div_ceil(2);
    half.resize(columns * rows, 0);
    for (pair, to) in luminance
        .chunks(2 * width)
        .zip(half.chunks_exact_mut(columns))
    {
        let (upper, lower) = pair.split_at(width);
        let lower = if lower.is_empty() { upper } else { lower };
        let pairs = upper.chunks(2).zip(lower.chunks(2));
        for (to, (upper, lower)) in to.iter_mut().zip(pairs) {
            let sum = |row: &[u8]| u16::from(row[0]) + u16::from(row[row.len() - 1]);
            *to = ((sum(upper) + sum(lower) + 2) / 4) as u8;
        }
    }
}
