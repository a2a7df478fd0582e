//! How much each pixel's surroundings differ from pixel to pixel: where they hardly do, as on wood in the shade, small
//! differences between cameras are all there is to tell depth, and they count more.
//! In: luminance of the middle camera. Out: where it is so. Open in the paper: all of it.

/// Pixels to each side over which differences are averaged.
const REACH: usize = 3;
/// Grey levels; a silhouette counts no more than this for what is beside it.
const MOST: u8 = 24;

/// Buffers are kept for the next frame.
#[derive(Default)]
pub(super) struct Textures {
    /// To the right or down, whichever is greater.
    differences: Vec<u8>,
    /// Sums down columns, over the rows around one; `REACH` zeros at both ends.
    columns: Vec<u16>,
    weak: Vec<u8>,
    blank: Vec<u8>,
}

impl Textures {
    /// 255 where neighbours differ little, else 0.
    pub fn weak(&self) -> &[u8] {
        &self.weak
    }

    /// 255 where they hardly differ at all, else 0.
    pub fn blank(&self) -> &[u8] {
        &self.blank
    }

    /// Where neighbours differ on average by no more than so many half grey levels: [`Self::weak`] and [`Self::blank`].
    pub fn find(&mut self, luminance: &[u8], width: usize, most: [u8; 2]) {
        let height = luminance.len() / width;
        let Self {
            differences,
            columns,
            weak,
            blank,
        } = self;
        differences.clear();
        differences.resize(luminance.len(), 0);
        let (right, below) = (&luminance[1..], &luminance[width..]);
        for (to, (a, b)) in differences.iter_mut().zip(luminance.iter().zip(below)) {
            *to = a.abs_diff(*b).min(MOST);
        }
        for (row, to) in differences.chunks_exact_mut(width).enumerate() {
            let from = row * width..(row + 1) * width - 1;
            let pairs = luminance[from.clone()].iter().zip(&right[from]);
            for (to, (a, b)) in to.iter_mut().zip(pairs) {
                *to = (*to).max(a.abs_diff(*b).min(MOST));
            }
        }
        weak.resize(luminance.len(), 0);
        blank.resize(luminance.len(), 0);
        columns.clear();
        columns.resize(width + 2 * REACH, 0);
        let row = |y: usize| &differences[y * width..(y + 1) * width];
        for y in 0..REACH.min(height) {
            for (sum, difference) in columns[REACH..].iter_mut().zip(row(y)) {
                *sum += u16::from(*difference);
            }
        }
        let rows = weak
            .chunks_exact_mut(width)
            .zip(blank.chunks_exact_mut(width));
        for (y, (weak, blank)) in rows.enumerate() {
            if y + REACH < height {
                for (sum, difference) in columns[REACH..].iter_mut().zip(row(y + REACH)) {
                    *sum += u16::from(*difference);
                }
            }
            if let Some(y) = y.checked_sub(REACH + 1) {
                for (sum, difference) in columns[REACH..].iter_mut().zip(row(y)) {
                    *sum -= u16::from(*difference);
                }
            }
            let rows = (y + REACH + 1).min(height) - y.saturating_sub(REACH);
            let at_most = |most: u8, sum: u16, pixels: usize| {
                if 2 * usize::from(sum) <= usize::from(most) * pixels {
                    255
                } else {
                    0
                }
            };
            let whole = rows * (2 * REACH + 1);
            for x in 0..width {
                let sum = columns[x..x + 2 * REACH + 1].iter().sum();
                weak[x] = at_most(most[0], sum, whole);
                blank[x] = at_most(most[1], sum, whole);
            }
            // At both ends there are fewer columns.
            for x in (0..width.min(REACH)).chain(width.saturating_sub(REACH)..width) {
                let columns_there = (x + REACH + 1).min(width) - x.saturating_sub(REACH);
                let sum = columns[x..x + 2 * REACH + 1].iter().sum();
                weak[x] = at_most(most[0], sum, rows * columns_there);
                blank[x] = at_most(most[1], sum, rows * columns_there);
            }
        }
    }
}
