//! Where the middle image differs from pixel to pixel, at every resolution that labels are propagated at: there depth
//! may jump, and at a coarse level too, or a narrow thing would take its surroundings along. Brown before brown or red
//! before green may be alike in luminance: any of the three colours tells.
//! In: the middle image, RGB. Out: one [`Contrast`] a level. Open in the paper: all of it.

use super::belief_propagation::Contrast;

/// Finest first; buffers are kept for the next frame.
#[derive(Default)]
pub(super) struct Contrasts {
    /// Red, green and blue at each level; means of 2x2 pixels of the level below.
    planes: Vec<[Vec<u8>; 3]>,
    levels: Vec<Contrast>,
}

impl Contrasts {
    /// Contrast are more than `threshold` levels of any colour between neighbours.
    pub fn find(&mut self, rgb: &[[u8; 3]], width: usize, levels: usize, threshold: u8) {
        self.levels.resize_with(levels, Contrast::default);
        self.planes.resize_with(levels, Default::default);
        for (channel, plane) in self.planes[0].iter_mut().enumerate() {
            plane.clear();
            plane.extend(rgb.iter().map(|rgb| rgb[channel]));
        }
        let mut width = width;
        for level in 0..levels {
            let (finer, coarser) = self.planes.split_at_mut(level + 1);
            let planes = &finer[level];
            find(planes, width, threshold, &mut self.levels[level]);
            if let Some(coarser) = coarser.first_mut() {
                for (plane, half) in planes.iter().zip(coarser) {
                    halve(plane, width, half);
                }
            }
            width = width.div_ceil(2);
        }
    }

    /// Finest first.
    pub fn levels(&self) -> &[Contrast] {
        &self.levels
    }

    /// Red, green and blue of the image that was looked at last.
    pub fn colours(&self) -> [&[u8]; 3] {
        self.planes[0].each_ref().map(|plane| &plane[..])
    }
}

fn find(planes: &[Vec<u8>; 3], width: usize, threshold: u8, contrast: &mut Contrast) {
    let Contrast { right, below } = contrast;
    for (to, distance) in [(right, 1), (below, width)] {
        let pixels = planes[0].len();
        let pairs = pixels - distance;
        to.resize(pixels, 0);
        let [(r, r_next), (g, g_next), (b, b_next)] = planes
            .each_ref()
            .map(|plane| (&plane[..pairs], &plane[distance..]));
        for (x, to) in to[..pairs].iter_mut().enumerate() {
            let difference = r[x]
                .abs_diff(r_next[x])
                .max(g[x].abs_diff(g_next[x]))
                .max(b[x].abs_diff(b_next[x]));
            *to = u8::from(difference > threshold);
        }
    }
}

/// Means of 2x2 pixels; what an odd last row or column lacks is as that row or column.
fn halve(plane: &[u8], width: usize, half: &mut Vec<u8>) {
    let columns = width.div_ceil(2);
    let rows = (plane.len() / width).div_ceil(2);
    half.resize(columns * rows, 0);
    for (pair, to) in plane.chunks(2 * width).zip(half.chunks_exact_mut(columns)) {
        let (upper, lower) = pair.split_at(width);
        let lower = if lower.is_empty() { upper } else { lower };
        let pairs = upper.chunks(2).zip(lower.chunks(2));
        for (to, (upper, lower)) in to.iter_mut().zip(pairs) {
            let sum = |row: &[u8]| u16::from(row[0]) + u16::from(row[row.len() - 1]);
            *to = ((sum(upper) + sum(lower) + 2) / 4) as u8;
        }
    }
}
