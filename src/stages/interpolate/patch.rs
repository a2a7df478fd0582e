//! Draws the flat parts of a mesh, each as one homography: sixteen pixels of a row a step, without a look at depth.
//!
//! A patch and poses -> the same samples as its triangles, to the flatness of the patch. The plane `1/z = w(column, row)`
//! turns `z * (H (column, row, 1)) + h` into `G (column, row, 1)` with `G = H + h w^T`; its inverse leads from a pixel to
//! where it comes from. In the target image inverse depth is linear too.

use nalgebra::{Matrix3, RowVector3, Vector3};

use crate::{
    lanes::{LANES, reciprocal},
    model::{camera::Intrinsics, patch::Patch},
};

use super::{
    quads::EDGE_SLACK,
    reach::NEAR_M,
    sample::{INTEGER, INTEGER_MASK, INVERSE_DEPTH_SHIFT, POSITION_BITS, STEPS, Sample},
};

/// What a patch reaches beyond its border, source pixels: its neighbours' vertices lie where they lie, not on the plane,
/// and no crack may open.
const OVERLAP: f64 = 1.0 / 64.0;
/// Patches that shrink to less than this share of their area are left to their triangles: edge on, these are not all seen
/// from the same side.
const AREA_MIN: f64 = 0.05;
/// Slopes of a border below this, pixels a pixel: it does not cross a row.
const LEVEL: f64 = 1e-9;

/// How a patch is to be drawn.
#[expect(clippy::large_enum_variant, reason = "it is taken apart at once")]
pub enum Drawable {
    /// It shows its back, whole.
    Hidden,
    /// As it passes the camera plane or is seen edge on.
    ByTriangles,
    /// With the first and the last row of the target that it can touch.
    Flat(FlatPatch, (f32, f32)),
}

/// A patch ready to be drawn.
pub struct FlatPatch {
    /// From `(x, y, 1)` to column and row within the patch and the divisor of both.
    source: Matrix3<f64>,
    /// From `(x, y, 1)` to 1/depth in the target.
    inverse_depth: RowVector3<f64>,
    /// In quads.
    columns: f32,
    rows: f32,
    /// In steps, plus [`INTEGER`].
    first_column: f32,
    first_row: f32,
    /// Borders to its left and to its right: `(x, slope)`, `x + slope * y` each.
    lefts: [(f64, f64); 4],
    rights: [(f64, f64); 4],
}

impl FlatPatch {
    /// Of a mesh whose vertices land at `z * (H * (column, row, 1)) + h`.
    pub fn of(
        patch: &Patch,
        view: &Intrinsics,
        h_matrix: &Matrix3<f64>,
        h_offset: &Vector3<f64>,
    ) -> Drawable {
        let [start, along, down] = patch.inverse_depth.map(f64::from);
        let plane = RowVector3::new(along, down, start);
        let (columns, rows) = (patch.columns as f64, patch.rows as f64);
        // H from the patch's own upper left vertex.
        let mut target = *h_matrix;
        let corner = Vector3::new(patch.column as f64, patch.row as f64, 1.0);
        target.set_column(2, &(h_matrix * corner));
        let target = target + h_offset * plane;
        let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
        let mut farthest = 0.0f64;
        for (column, row) in [(0.0, 0.0), (columns, 0.0), (0.0, rows), (columns, rows)] {
            let at = Vector3::new(column, row, 1.0);
            let image = target * at;
            // Homogeneous by 1/z of the view.
            if image.z < f64::from(NEAR_M) * (plane * at).x.max(f64::EPSILON) {
                return Drawable::ByTriangles;
            }
            farthest = farthest.max(image.z);
            low = low.min(image.y / image.z);
            high = high.max(image.y / image.z);
        }
        // What one square pixel of the view becomes where it is smallest; of a sign that tells the side.
        let area = target.determinant() / farthest.powi(3);
        if area < -AREA_MIN {
            return Drawable::Hidden;
        }
        let Some(source) = target.try_inverse().filter(|_| area > AREA_MIN) else {
            return Drawable::ByTriangles;
        };
        let [column, row, divisor] = [0, 1, 2].map(|index| source.row(index).into_owned());
        let overlap = |has_neighbour| {
            if has_neighbour {
                OVERLAP
            } else {
                f64::from(EDGE_SLACK)
            }
        };
        // `(x, y, 1)` lies inside where all four are not negative.
        let borders = [
            column + divisor * overlap(patch.column > 0),
            divisor * (columns + overlap(patch.column + patch.columns + 1 < view.width)) - column,
            row + divisor * overlap(patch.row > 0),
            divisor * (rows + overlap(patch.row + patch.rows + 1 < view.height)) - row,
        ];
        let (mut lefts, mut rights) = ([(0.0, 0.0); 4], [(f64::INFINITY, 0.0); 4]);
        (low, high) = (low - 0.5, high + 0.5);
        for (index, border) in borders.iter().enumerate() {
            let slope = border.x;
            let line = (-border.z / slope, -border.y / slope);
            if slope > LEVEL {
                lefts[index] = line;
            } else if slope < -LEVEL {
                rights[index] = line;
            } else if border.y > 0.0 {
                low = low.max(-border.z / border.y);
            } else {
                high = high.min(-border.z / border.y);
            }
        }
        let flat = Self {
            inverse_depth: plane * source,
            columns: columns as f32,
            rows: rows as f32,
            first_column: patch.column as f32 * STEPS + INTEGER,
            first_row: patch.row as f32 * STEPS + INTEGER,
            lefts,
            rights,
            source,
        };
        Drawable::Flat(flat, (low as f32, high as f32))
    }

    /// The pixels of row `y` that it covers, `first..end`.
    #[inline(always)]
    fn span(&self, y: f64, width: usize) -> (usize, usize) {
        let (mut first, mut last) = (0.0f64, width as f64 - 1.0);
        for ((left, left_slope), (right, right_slope)) in self.lefts.iter().zip(&self.rights) {
            let left = left + left_slope * y;
            let right = right + right_slope * y;
            first = if left > first { left } else { first };
            last = if right < last { right } else { last };
        }
        // Both are within the image, or there is nothing between them.
        let first = first.min(width as f64);
        let whole = first as usize;
        let first_x = whole + usize::from((whole as f64) < first);
        let end = if last < 0.0 { 0 } else { last as usize + 1 };
        (first_x, end)
    }

    /// Row `y` of the target, into what begins at that row of a map and holds [`LANES`] samples beyond it.
    #[inline(always)]
    pub fn draw_row(&self, y: usize, width: usize, map: &mut [Sample]) {
        let y = y as f64;
        let (first, end) = self.span(y, width);
        if first >= end {
            return;
        }
        // From the first pixel of the span, so that single precision is enough.
        let start = |row: [f64; 3]| (row[0] * first as f64 + row[1] * y + row[2]) as f32;
        let m = &self.source;
        let [column, row, divisor] =
            [0, 1, 2].map(|index| [m[(index, 0)], m[(index, 1)], m[(index, 2)]]);
        let d = &self.inverse_depth;
        let depth = [d.x, d.y, d.z];
        let starts = [start(column), start(row), start(divisor), start(depth)];
        let slopes = [column[0], row[0], divisor[0], depth[0]].map(|slope| slope as f32);
        // Read here, because what is read under a condition on lanes becomes a gather.
        let (columns, rows) = (self.columns, self.rows);
        let (first_column, first_row) = (self.first_column, self.first_row);
        for at in (first..end).step_by(LANES) {
            let slots: &mut [Sample; LANES] = (&mut map[at..at + LANES])
                .try_into()
                .expect("sixteen are sixteen");
            let count = (end - at) as u32;
            let along = (at - first) as f32;
            let (mut highs, mut lows) = ([0u32; LANES], [0u32; LANES]);
            for lane in 0..LANES {
                let x = along + lane as f32;
                let divisor = slopes[2] * x + starts[2];
                let r = reciprocal(divisor);
                let r = r * (2.0 - divisor * r);
                let within = |value: f32, most: f32| {
                    let value = if value > 0.0 { value } else { 0.0 };
                    if value < most { value } else { most }
                };
                let column = within((slopes[0] * x + starts[0]) * r, columns);
                let row = within((slopes[1] * x + starts[1]) * r, rows);
                let u = (column * STEPS + first_column).to_bits() & INTEGER_MASK;
                let v = (row * STEPS + first_row).to_bits() & INTEGER_MASK;
                let depth = (slopes[3] * x + starts[3]).to_bits() >> INVERSE_DEPTH_SHIFT;
                let high = (depth << (2 * POSITION_BITS - 32)) | (v >> (32 - POSITION_BITS));
                // Beyond the span nothing is shown.
                let within = (lane as u32) < count;
                highs[lane] = if within { high } else { 0 };
                lows[lane] = if within { (v << POSITION_BITS) | u } else { 0 };
            }
            for lane in 0..LANES {
                let sample = (u64::from(highs[lane]) << 32) | u64::from(lows[lane]);
                slots[lane] = slots[lane].max(sample);
            }
        }
    }
}
