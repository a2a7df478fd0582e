//! The flat parts of a mesh: where inverse depth is linear in column and row, a whole run of quads is drawn as one
//! homography.
//!
//! Depth and which triangles exist -> patches. What is not flat, as with noisy depth, stays with its triangles.

use crate::lanes::LANES;

use super::viewpoint::{LOWER_RIGHT, UPPER_LEFT};

/// Quads that a patch is high, at most.
pub const PATCH_ROWS: usize = 4;
/// How far inverse depth may lie from the plane, 1/m: seen from 0.2 m beside, with a focal length of 500 pixels, a point
/// moves by a fiftieth of a pixel.
const FLATNESS: f32 = 2e-4;
const WHOLE_QUAD: u8 = UPPER_LEFT | LOWER_RIGHT;

/// Quads without a cut whose vertices lie on one plane.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Patch {
    /// Of the upper left vertex; the column is the first of a block.
    pub column: usize,
    pub row: usize,
    /// In quads; only the last block of an image is not whole.
    pub columns: usize,
    pub rows: usize,
    /// 1/m: at the upper left vertex, and how it grows with column and row.
    pub inverse_depth: [f32; 3],
}

/// Appends the patches of a mesh, `width` vertices wide, to `patches`; `cut` as in [`super::viewpoint::Mesh`].
#[inline(always)]
pub fn find(depth_m: &[f32], cut: &[u8], width: usize, patches: &mut Vec<Patch>) {
    let height = depth_m.len() / width;
    let blocks = (width - 1).div_ceil(LANES);
    // As many as there can be, so that no frame allocates.
    patches.reserve(blocks * height.div_ceil(PATCH_ROWS));
    for row in (0..height.saturating_sub(1)).step_by(PATCH_ROWS) {
        let rows = PATCH_ROWS.min(height - 1 - row);
        let vertices = &depth_m[row * width..(row + rows + 1) * width];
        let quads = &cut[row * (width - 1)..(row + rows) * (width - 1)];
        let mut run: Option<Patch> = None;
        for column in (0..width - 1).step_by(LANES) {
            let columns = LANES.min(width - 1 - column);
            if rows < 2 || column + LANES > width || !is_whole(quads, width - 1, column, columns) {
                patches.extend(run.take());
                continue;
            }
            if let Some(run) = &mut run
                && run.holds(vertices, width, column, columns)
            {
                run.columns += columns;
                continue;
            }
            patches.extend(run.take());
            let patch = Patch {
                column,
                row,
                columns,
                rows,
                inverse_depth: fit(vertices, width, column),
            };
            run = patch
                .holds(vertices, width, column, columns)
                .then_some(patch);
        }
        patches.extend(run);
    }
}

/// Whether every triangle exists.
#[inline(always)]
fn is_whole(quads: &[u8], stride: usize, column: usize, columns: usize) -> bool {
    let mut both = WHOLE_QUAD;
    for row in quads.chunks_exact(stride) {
        both &= match row[column..].first_chunk::<LANES>() {
            Some(row) => row.iter().fold(WHOLE_QUAD, |both, quad| both & quad),
            None => row[column..column + columns]
                .iter()
                .fold(WHOLE_QUAD, |both, quad| both & quad),
        };
    }
    both == WHOLE_QUAD
}

/// The plane of least squares through sixteen columns of vertices.
#[inline(always)]
fn fit(vertices: &[f32], width: usize, column: usize) -> [f32; 3] {
    let rows = vertices.len() / width;
    let middle_row = 0.5 * (rows - 1) as f32;
    let middle_column = 0.5 * (LANES - 1) as f32;
    let mut sum = [0.0f32; LANES];
    let mut moment = [0.0f32; LANES];
    let mut square = 0.0;
    for (index, row) in vertices.chunks_exact(width).enumerate() {
        let down = index as f32 - middle_row;
        square += down * down;
        let z = &row[column..column + LANES];
        for lane in 0..LANES {
            let inverse = 1.0 / z[lane];
            sum[lane] += inverse;
            moment[lane] += down * inverse;
        }
    }
    let (mut mean, mut along, mut down, mut square_column) = (0.0, 0.0, 0.0, 0.0);
    for lane in 0..LANES {
        let right = lane as f32 - middle_column;
        mean += sum[lane];
        along += right * sum[lane];
        down += moment[lane];
        square_column += right * right;
    }
    let mean = mean / (LANES * rows) as f32;
    let along = along / (square_column * rows as f32);
    let down = down / (square * LANES as f32);
    [
        mean - along * middle_column - down * middle_row,
        along,
        down,
    ]
}

impl Patch {
    /// Whether the vertices of the quads from `column` on, in the rows of the patch, lie on its plane.
    #[inline(always)]
    fn holds(&self, vertices: &[f32], width: usize, column: usize, columns: usize) -> bool {
        let [start, along, down] = self.inverse_depth;
        // |1/z - plane| without the division.
        let distance = |z: f32, plane: f32| (1.0 - plane * z).abs() - FLATNESS * z;
        let mut farthest = [f32::NEG_INFINITY; LANES];
        let first = (column - self.column) as f32;
        for (index, row) in vertices.chunks_exact(width).enumerate() {
            let left = start + along * first + down * index as f32;
            let z = &row[column..column + LANES];
            for lane in 0..LANES {
                let d = distance(z[lane], left + along * lane as f32);
                farthest[lane] = if d > farthest[lane] {
                    d
                } else {
                    farthest[lane]
                };
            }
            if columns == LANES {
                let d = distance(row[column + LANES], left + along * LANES as f32);
                farthest[0] = farthest[0].max(d);
            }
        }
        farthest.iter().all(|&d| d <= 0.0)
    }
}
