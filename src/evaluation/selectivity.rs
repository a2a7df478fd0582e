//! Attentional selectivity AS (24) and its peak PAS (25) of a block map against a mask.
//!
//! Mean and maximum inside over the maximum outside, in dB. The strip along the border is left out. A block is inside
//! if at least half of it is in the mask; outside if neither the mask nor what is ignored comes within one block of it;
//! what lies between counts nowhere.

use crate::{
    model::report::PixelBox,
    stages::attend::{BLOCK, BlockMap},
};

/// Scores are never below this in a ratio, so that AS stays finite where nothing was seen. Far below a block's noise.
const SCORE_FLOOR: f64 = 1e-6;

/// 10 log10.
pub fn decibel(ratio: f64) -> f64 {
    10.0 * ratio.log10()
}

/// The ratio of two scores in dB.
pub fn score_ratio_db(score: f64, reference: f64) -> f64 {
    decibel(score.max(SCORE_FLOOR) / reference.max(SCORE_FLOOR))
}

/// A block map's scores sorted out by a mask.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Sides {
    pub inside: Vec<f32>,
    pub outside: Vec<f32>,
}

impl Sides {
    /// `mask` and `ignored` hold a value a pixel, in rows of `width`.
    pub fn new(
        blocks: &BlockMap,
        mask: &[bool],
        ignored: &[bool],
        width: usize,
        border_px: usize,
    ) -> Self {
        let covered = covered_pixels(blocks, mask, width);
        let either: Vec<bool> = mask.iter().zip(ignored).map(|(a, b)| a | b).collect();
        let unjudged = covered_pixels(blocks, &either, width);
        let near = |x: usize, y: usize| {
            (y.saturating_sub(1)..(y + 2).min(blocks.height)).any(|y| {
                let row = &unjudged[y * blocks.width..][..blocks.width];
                row[x.saturating_sub(1)..(x + 2).min(blocks.width)]
                    .iter()
                    .any(|&pixels| pixels > 0)
            })
        };
        let mut sides = Self::default();
        for (x, y, score) in blocks.inside(border_px) {
            if 2 * covered[y * blocks.width + x] >= BLOCK * BLOCK {
                sides.inside.push(score);
            } else if !near(x, y) {
                sides.outside.push(score);
            }
        }
        sides
    }

    pub fn mean_inside(&self) -> f64 {
        self.inside.iter().map(|&s| f64::from(s)).sum::<f64>() / self.inside.len().max(1) as f64
    }

    pub fn max_inside(&self) -> f64 {
        maximum(&self.inside)
    }

    pub fn max_outside(&self) -> f64 {
        maximum(&self.outside)
    }

    /// AS, dB.
    pub fn selectivity_db(&self) -> f64 {
        score_ratio_db(self.mean_inside(), self.max_outside())
    }

    /// PAS, dB.
    pub fn peak_selectivity_db(&self) -> f64 {
        score_ratio_db(self.max_inside(), self.max_outside())
    }
}

fn maximum(scores: &[f32]) -> f64 {
    f64::from(scores.iter().copied().fold(0.0, f32::max))
}

/// How many pixels of each block are in the mask.
fn covered_pixels(blocks: &BlockMap, mask: &[bool], width: usize) -> Vec<usize> {
    let mut covered = vec![0; blocks.width * blocks.height];
    for (y, row) in mask.chunks_exact(width).enumerate() {
        for (x, &inside) in row.iter().enumerate() {
            let (block_x, block_y) = (x / BLOCK, y / BLOCK);
            if inside && block_x < blocks.width && block_y < blocks.height {
                covered[block_y * blocks.width + block_x] += 1;
            }
        }
    }
    covered
}

/// The smallest box around a mask; `None` around nothing.
pub fn mask_box(mask: &[bool], width: usize) -> Option<PixelBox> {
    let mut found: Option<PixelBox> = None;
    for (index, _) in mask.iter().enumerate().filter(|(_, inside)| **inside) {
        let (x, y) = ((index % width) as u32, (index / width) as u32);
        let pixel = PixelBox {
            x_min: x,
            y_min: y,
            x_max: x + 1,
            y_max: y + 1,
        };
        found = Some(found.map_or(pixel, |others| PixelBox {
            x_min: others.x_min.min(pixel.x_min),
            y_min: others.y_min.min(pixel.y_min),
            x_max: others.x_max.max(pixel.x_max),
            y_max: others.y_max.max(pixel.y_max),
        }));
    }
    found
}
