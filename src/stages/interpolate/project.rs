//! Projects the mesh of a viewpoint into another camera: where in the viewpoint does each pixel come from?
//!
//! Mesh and poses -> one packed sample a pixel, nearest surface first: inverse depth above source position, so that
//! the z-test is an integer maximum. Back faces are dropped. Perspective-correct inside every triangle.

use std::ops::Range;

use nalgebra::Vector3;

use crate::{
    isa::for_each_isa,
    lanes::{LANES, least, prefetch, reciprocal},
    model::viewpoint::Mesh,
};

use super::{
    quads::{Batch, Block, QuadRow, Target, VertexRow},
    reach::{NEAR_M, Reach},
    sample::{Sample, map_size},
};

/// Far outside any image, and small enough for what the quads round.
const FAR_PX: f32 = 1e6;

/// A mesh ready to be drawn: a vertex `(column, row)` with depth z lands at `z * (H * (column, row, 1)) + h`,
/// homogeneous target pixels.
pub struct Projector<'a> {
    mesh: &'a Mesh,
    reach: &'a Reach,
}

/// Working memory of one thread.
#[derive(Default)]
pub struct ProjectScratch {
    upper: VertexRow,
    lower: VertexRow,
}

impl<'a> Projector<'a> {
    /// `reach` was aimed with this mesh.
    pub fn new(mesh: &'a Mesh, reach: &'a Reach) -> Self {
        Self { mesh, reach }
    }

    /// Draws what falls into rows `strip` of the target. `map` is that strip, as large as [`map_size`] says, and keeps
    /// the nearer of what it holds and what is drawn.
    #[inline(always)]
    pub fn draw(
        &self,
        width: usize,
        strip: Range<usize>,
        map: &mut [Sample],
        scratch: &mut ProjectScratch,
    ) {
        let pixels = width * strip.len();
        assert_eq!(map.len(), map_size(pixels), "the map is the strip");
        for (flat, (low, high)) in self.reach.flat.iter().zip(&self.reach.flat_rows) {
            // As floats, because both may lie far outside.
            let first = low.max(strip.start as f32).ceil();
            let last = high.min(strip.end as f32 - 1.0);
            if first <= last {
                for y in first as usize..=last as usize {
                    let map = &mut map[(y - strip.start) * width..];
                    flat.draw_row(y, width, map);
                }
            }
        }
        let columns = self.mesh.intrinsics.width;
        let mut target = Target { width, strip, map };
        // The row and columns that `lower` holds.
        let mut held = (usize::MAX, 0..0);
        let mut next = None;
        let (mut block, mut batch) = (Block::NONE, Batch::NONE);
        for row in 0..self.reach.rows.len() {
            let touched = match next.take() {
                Some(touched) => touched,
                None => self.touched(row, &target.strip),
            };
            if touched.is_empty() {
                continue;
            }
            let below = if row + 1 < self.reach.rows.len() {
                self.touched(row + 1, &target.strip)
            } else {
                0..0
            };
            if held.0 == row && held.1.start <= touched.start && touched.end <= held.1.end {
                std::mem::swap(&mut scratch.upper, &mut scratch.lower);
            } else {
                self.transform_needed(row, row, touched.clone(), &mut scratch.upper);
            }
            let mut both = touched.clone();
            if !below.is_empty() {
                both = both.start.min(below.start)..both.end.max(below.end);
            }
            self.transform_needed(row, row + 1, both.clone(), &mut scratch.lower);
            held = (row + 1, both);
            next = Some(below);
            let cut = &self.mesh.cut[row * (columns - 1)..][..columns - 1];
            let quads = QuadRow {
                row: row as f32,
                upper: &scratch.upper,
                lower: &scratch.lower,
                cut,
            };
            let low = &self.reach.low[row * self.mesh.blocks()..];
            for column in touched.step_by(LANES) {
                if low[column / LANES] < f32::INFINITY {
                    quads.draw_block(column, &mut target, &mut block, &mut batch);
                }
            }
        }
    }

    /// The columns, whole blocks, from the first to the last whose quads below `row` can reach the strip.
    #[inline(always)]
    fn touched(&self, row: usize, strip: &Range<usize>) -> Range<usize> {
        let (start, end) = (strip.start as f32, strip.end as f32);
        let touches = |low: f32, high: f32| (low < end) & (high >= start);
        let (low, high) = self.reach.rows[row];
        if !touches(low, high) {
            return 0..0;
        }
        let blocks = self.mesh.blocks();
        let low = &self.reach.low[row * blocks..][..blocks];
        let high = &self.reach.high[row * blocks..][..blocks];
        let touches = |block: &usize| touches(low[*block], high[*block]);
        let first = (0..blocks).find(touches).unwrap_or(blocks);
        let end = (first..blocks)
            .rev()
            .find(touches)
            .map_or(first, |last| last + 1);
        first * LANES..end * LANES
    }

    /// Vertices of `row`, of what was touched, as far as the quads above and below it are drawn by triangles; the quads
    /// above are those of row `above`, and where they are the same, only these count.
    #[inline(always)]
    fn transform_needed(
        &self,
        above: usize,
        row: usize,
        touched: Range<usize>,
        vertices: &mut VertexRow,
    ) {
        let columns = self.mesh.intrinsics.width;
        // A block of quads reads one vertex beyond its last.
        let padded = columns.next_multiple_of(LANES) + 1;
        for plane in [
            &mut vertices.x,
            &mut vertices.y,
            &mut vertices.inverse_depth,
        ] {
            plane.resize(padded, 0.0);
        }
        let blocks = self.mesh.blocks();
        let below = row.min(self.reach.rows.len() - 1);
        let above = &self.reach.low[above * blocks..][..blocks];
        let below = &self.reach.low[below * blocks..][..blocks];
        let end = touched.end / LANES;
        let mut block = touched.start / LANES;
        while block < end {
            let is_needed = |block: usize| least(above[block], below[block]) < f32::INFINITY;
            let first = block;
            while block < end && is_needed(block) {
                block += 1;
            }
            if first < block {
                self.transform(row, first * LANES..block * LANES, vertices);
            }
            block += 1;
        }
    }

    #[inline(always)]
    fn transform(&self, row: usize, touched: Range<usize>, vertices: &mut VertexRow) {
        let columns = self.mesh.intrinsics.width;
        let m = self.reach.h_matrix.cast::<f32>();
        let start = (self.reach.h_matrix * Vector3::new(0.0, row as f64, 1.0)).cast::<f32>();
        let offset = self.reach.h_offset.cast::<f32>();
        // Quads need the vertex to their right.
        let touched = touched.start..(touched.end + 1).min(columns);
        let depth_m = &self.mesh.depth_m[row * columns..][touched.clone()];
        let xs = &mut vertices.x[touched.clone()];
        let ys = &mut vertices.y[touched.clone()];
        let inverse_depths = &mut vertices.inverse_depth[touched.clone()];
        let first = touched.start as i32;
        for block in (touched.clone()).step_by(LANES) {
            // The row below is next.
            prefetch(&self.mesh.depth_m, (row + 1) * columns + block);
        }
        for column in 0..depth_m.len() {
            let z = depth_m[column];
            let at = (first + column as i32) as f32;
            let q_x = z * (m[(0, 0)] * at + start.x) + offset.x;
            let q_y = z * (m[(1, 0)] * at + start.y) + offset.y;
            let q_z = z * (m[(2, 0)] * at + start.z) + offset.z;
            let drawable = z > 0.0 && q_z >= NEAR_M;
            let inverse = if drawable { inverted(q_z) } else { 0.0 };
            xs[column] = (q_x * inverse).clamp(-FAR_PX, FAR_PX);
            ys[column] = (q_y * inverse).clamp(-FAR_PX, FAR_PX);
            inverse_depths[column] = inverse;
        }
    }
}

for_each_isa! {
    /// [`Projector::draw`].
    pub fn draw(
        projector: &Projector<'_>,
        width: usize,
        rows: Range<usize>,
        map: &mut [Sample],
        scratch: &mut ProjectScratch,
    ) = draw_kernel;
}

#[inline(always)]
fn draw_kernel(
    projector: &Projector<'_>,
    width: usize,
    rows: Range<usize>,
    map: &mut [Sample],
    scratch: &mut ProjectScratch,
) {
    projector.draw(width, rows, map, scratch);
}

/// 1/x of a positive normal number, to 2e-7 of itself, in less time than a division.
#[inline(always)]
fn inverted(x: f32) -> f32 {
    let r = reciprocal(x);
    r * (2.0 - x * r)
}
