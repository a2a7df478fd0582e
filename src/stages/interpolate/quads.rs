//! Draws the quads of a mesh, two triangles each: sixteen side by side, every candidate pixel of all of them at once.
//!
//! Two rows of projected vertices -> samples in a strip's map, the nearest kept. Exact to the triangle's edge; back faces
//! are dropped.

use std::ops::Range;

use crate::{
    lanes::{LANES, Lanes, greatest, least, reciprocal},
    model::viewpoint::{LOWER_RIGHT, UPPER_LEFT},
};

use super::sample::{
    INTEGER, INTEGER_MASK, INVERSE_DEPTH_SHIFT, POSITION_BITS, STEPS, Sample, pack,
};

/// Of a triangle's weights and, in pixels, of its bounds: rounding in single precision must not open a crack between
/// neighbours. A view drawn from its own pose has every pixel exactly on a vertex, those of the border too.
pub const EDGE_SLACK: f32 = 1e-3;

/// One row of projected vertices.
#[derive(Default, Clone)]
pub struct VertexRow {
    pub x: Vec<f32>,
    pub y: Vec<f32>,
    /// 1/depth in the target camera; 0 where the vertex cannot be drawn.
    pub inverse_depth: Vec<f32>,
}

/// Largest integer not above `x`, |x| < 2^22: without the call that it is where rounding instructions are missing.
#[inline(always)]
fn floor(x: f32) -> f32 {
    // 1.5 * 2^23: adding it rounds to the nearest integer.
    const ROUND: f32 = 12_582_912.0;
    let nearest = (x + ROUND) - ROUND;
    if nearest > x { nearest - 1.0 } else { nearest }
}

#[inline(always)]
fn ceil(x: f32) -> f32 {
    -floor(-x)
}

/// A whole number of magnitude below 2^22.
#[inline(always)]
fn integer(x: f32) -> i32 {
    const ROUND: f32 = 12_582_912.0;
    (x + ROUND).to_bits() as i32 - ROUND.to_bits() as i32
}

/// A strip of the target image.
pub struct Target<'a> {
    pub width: usize,
    pub strip: Range<usize>,
    pub map: &'a mut [Sample],
}

impl Target<'_> {
    /// Keeps the nearer surface.
    #[inline(always)]
    fn put(&mut self, x: f32, y: f32, sample: Sample) {
        let slot = &mut self.map[(y as usize - self.strip.start) * self.width + x as usize];
        *slot = (*slot).max(sample);
    }
}

/// A projected vertex with its source position.
#[derive(Clone, Copy)]
struct Vertex {
    x: f32,
    y: f32,
    inverse_depth: f32,
    column: f32,
    row: f32,
}

/// The quads between two rows of vertices.
pub struct QuadRow<'a> {
    /// Of the upper vertices, in the view.
    pub row: f32,
    pub upper: &'a VertexRow,
    pub lower: &'a VertexRow,
    /// As [`crate::model::viewpoint::Mesh::cut`].
    pub cut: &'a [u8],
}

/// Candidate pixels a quad may have in x and in y and still be drawn in lanes: twice magnified ones do. Larger quads are
/// drawn one by one.
const LANE_CANDIDATES: i32 = 4;
/// Candidates whose hits fit into one word.
const BATCH: usize = u64::BITS as usize / LANES;

impl QuadRow<'_> {
    /// The sixteen quads from `column` on, side by side: every candidate pixel of every quad's bounding box is tested
    /// against the triangle on its side of the diagonal.
    #[inline(always)]
    pub fn draw_block(
        &self,
        column: usize,
        target: &mut Target,
        block: &mut Block,
        batch: &mut Batch,
    ) {
        let mut triangles = [0u8; LANES];
        match self.cut[column..].first_chunk::<LANES>() {
            Some(quads) => triangles = *quads,
            None => {
                for (triangles, quad) in triangles.iter_mut().zip(&self.cut[column..]) {
                    *triangles = *quad;
                }
            }
        }
        if u128::from_ne_bytes(triangles) == 0 {
            return;
        }
        let (upper, lower) = (self.upper, self.lower);
        let corners = Corners {
            x: four_corners(&upper.x, &lower.x, column),
            y: four_corners(&upper.y, &lower.y, column),
            inverse_depth: four_corners(&upper.inverse_depth, &lower.inverse_depth, column),
        };
        block.bound(&corners, &triangles, target);
        let mut x_steps = 0;
        let mut y_steps = 0;
        for lane in 0..LANES {
            x_steps = x_steps.max(block.x_count[lane]);
            y_steps = y_steps.max(block.y_count[lane]);
        }
        if x_steps == 0 {
            return;
        }
        if x_steps > LANE_CANDIDATES || y_steps > LANE_CANDIDATES {
            (x_steps, y_steps) = (0, 0);
            for lane in 0..LANES {
                let (x_count, y_count) = (block.x_count[lane], block.y_count[lane]);
                if x_count > LANE_CANDIDATES || y_count > LANE_CANDIDATES {
                    self.draw_quad(column + lane, triangles[lane], target);
                    triangles[lane] = 0;
                } else {
                    x_steps = x_steps.max(x_count);
                    y_steps = y_steps.max(y_count);
                }
            }
        }
        block.prepare(&corners, &triangles, column, self.row);
        let steps = x_steps * y_steps;
        let (mut x_step, mut y_step) = (0, 0);
        for first in (0..steps).step_by(BATCH) {
            // The hits of up to four candidates are written together: the end of the loop over them is hard to foresee.
            let mut hits = 0u64;
            for slot in 0..BATCH.min((steps - first) as usize) {
                let found = block.sample(x_step, y_step, target, batch, slot);
                hits |= u64::from(found) << (slot * LANES);
                x_step += 1;
                if x_step == x_steps {
                    (x_step, y_step) = (0, y_step + 1);
                }
            }
            while hits != 0 {
                let hit = hits.trailing_zeros() as usize;
                hits &= hits - 1;
                let slot = &mut target.map[batch.pixel[hit] as usize];
                *slot = (*slot).max(batch.sample[hit]);
            }
        }
    }

    /// One quad of any size.
    #[cold]
    fn draw_quad(&self, column: usize, triangles: u8, target: &mut Target) {
        let vertex = |vertices: &VertexRow, column: usize, row: f32| Vertex {
            x: vertices.x[column],
            y: vertices.y[column],
            inverse_depth: vertices.inverse_depth[column],
            column: column as f32,
            row,
        };
        let right_upper = vertex(self.upper, column + 1, self.row);
        let left_lower = vertex(self.lower, column, self.row + 1.0);
        if triangles & UPPER_LEFT != 0 {
            let left_upper = vertex(self.upper, column, self.row);
            draw_triangle([left_upper, right_upper, left_lower], target);
        }
        if triangles & LOWER_RIGHT != 0 {
            let right_lower = vertex(self.lower, column + 1, self.row + 1.0);
            draw_triangle([right_lower, left_lower, right_upper], target);
        }
    }
}

/// The corners of sixteen quads: upper left, upper right, lower left, lower right.
#[repr(align(64))]
struct Corners {
    x: [Lanes; 4],
    y: [Lanes; 4],
    inverse_depth: [Lanes; 4],
}

/// Upper left, upper right, lower left, lower right of sixteen quads.
#[inline(always)]
fn four_corners(upper: &[f32], lower: &[f32], column: usize) -> [Lanes; 4] {
    let upper = &upper[column..column + LANES + 1];
    let lower = &lower[column..column + LANES + 1];
    let mut corners = [[0.0; LANES]; 4];
    corners[0].copy_from_slice(&upper[..LANES]);
    corners[1].copy_from_slice(&upper[1..=LANES]);
    corners[2].copy_from_slice(&lower[..LANES]);
    corners[3].copy_from_slice(&lower[1..=LANES]);
    corners
}

/// Sixteen quads ready to be sampled. Offsets are from the upper right vertex, which both triangles share; `a` is the
/// vertex that is particular to a triangle: the upper left (index 0) or the lower right one (1). Aligned as all that is
/// written and read sixteen at a time, so that no step crosses a cache line.
#[repr(align(64))]
pub struct Block {
    /// Bounding boxes, pixels; no candidates where nothing can be drawn.
    x_first: [i32; LANES],
    y_first: [i32; LANES],
    x_count: [i32; LANES],
    y_count: [i32; LANES],
    /// Of the first candidate.
    dx: Lanes,
    dy: Lanes,
    /// The diagonal, upper right to lower left.
    diagonal_x: Lanes,
    diagonal_y: Lanes,
    /// Infinite where one of the triangles covers nothing: which one to look at is then decided.
    side_bias: Lanes,
    /// Towards `a`, divided by the triangle's area (of a sign for each side).
    edge_x: [Lanes; 2],
    edge_y: [Lanes; 2],
    inverse_area: [Lanes; 2],
    inverse_depth_a: [Lanes; 2],
    inverse_depth_right: Lanes,
    inverse_depth_left: Lanes,
    /// Source position of the upper left vertex in steps, plus [`INTEGER`].
    u_steps: Lanes,
    v_steps: f32,
}

/// What up to four candidates of sixteen quads show.
#[repr(align(64))]
pub struct Batch {
    sample: [Sample; BATCH * LANES],
    /// Of the strip's map.
    pixel: [u32; BATCH * LANES],
}

impl Batch {
    pub const NONE: Self = Self {
        sample: [0; BATCH * LANES],
        pixel: [0; BATCH * LANES],
    };
}

impl Block {
    pub const NONE: Self = Self {
        x_first: [0; LANES],
        y_first: [0; LANES],
        x_count: [0; LANES],
        y_count: [0; LANES],
        dx: [0.0; LANES],
        dy: [0.0; LANES],
        diagonal_x: [0.0; LANES],
        diagonal_y: [0.0; LANES],
        side_bias: [0.0; LANES],
        edge_x: [[0.0; LANES]; 2],
        edge_y: [[0.0; LANES]; 2],
        inverse_area: [[0.0; LANES]; 2],
        inverse_depth_a: [[0.0; LANES]; 2],
        inverse_depth_right: [0.0; LANES],
        inverse_depth_left: [0.0; LANES],
        u_steps: [0.0; LANES],
        v_steps: 0.0,
    };

    /// Bounding boxes on the target.
    #[inline(always)]
    fn bound(&mut self, corners: &Corners, triangles: &[u8; LANES], target: &Target) {
        let [x0, x1, x2, x3] = &corners.x;
        let [y0, y1, y2, y3] = &corners.y;
        let (width, end) = (target.width as f32, target.strip.end as f32);
        let start = target.strip.start as f32;
        for lane in 0..LANES {
            let x_low = least(least(x0[lane], x1[lane]), least(x2[lane], x3[lane]));
            let x_high = greatest(greatest(x0[lane], x1[lane]), greatest(x2[lane], x3[lane]));
            let y_low = least(least(y0[lane], y1[lane]), least(y2[lane], y3[lane]));
            let y_high = greatest(greatest(y0[lane], y1[lane]), greatest(y2[lane], y3[lane]));
            let (x_low, x_high) = (ceil(x_low - EDGE_SLACK), floor(x_high + EDGE_SLACK));
            let (y_low, y_high) = (ceil(y_low - EDGE_SLACK), floor(y_high + EDGE_SLACK));
            let touches = (triangles[lane] != 0)
                & (x_high >= 0.0)
                & (x_low < width)
                & (y_high >= start)
                & (y_low < end)
                & (x_high >= x_low)
                & (y_high >= y_low);
            self.x_first[lane] = integer(x_low);
            self.y_first[lane] = integer(y_low);
            self.x_count[lane] = if touches {
                integer(x_high - x_low) + 1
            } else {
                0
            };
            self.y_count[lane] = if touches {
                integer(y_high - y_low) + 1
            } else {
                0
            };
            self.dx[lane] = x_low - x1[lane];
            self.dy[lane] = y_low - y1[lane];
        }
    }

    #[inline(always)]
    fn prepare(&mut self, corners: &Corners, triangles: &[u8; LANES], column: usize, row: f32) {
        let [x0, x1, x2, x3] = &corners.x;
        let [y0, y1, y2, y3] = &corners.y;
        let [i0, i1, i2, i3] = &corners.inverse_depth;
        for lane in 0..LANES {
            let has_upper_left = triangles[lane] & UPPER_LEFT != 0;
            let has_lower_right = triangles[lane] & LOWER_RIGHT != 0;
            let (right, left) = (i1[lane], i2[lane]);
            let behind = least(right, left) <= 0.0;
            let diagonal_x = x2[lane] - x1[lane];
            let diagonal_y = y2[lane] - y1[lane];
            let edge_x = (x0[lane] - x1[lane], x3[lane] - x1[lane]);
            let edge_y = (y0[lane] - y1[lane], y3[lane] - y1[lane]);
            // Vertices clockwise as seen (y down); the other way round is a back face and covers nothing.
            let area = (
                diagonal_x * edge_y.0 - diagonal_y * edge_x.0,
                diagonal_x * edge_y.1 - diagonal_y * edge_x.1,
            );
            let shows = (
                has_upper_left & (area.0 > 0.0) & (i0[lane] > 0.0) & !behind,
                has_lower_right & (area.1 < 0.0) & (i3[lane] > 0.0) & !behind,
            );
            // Weights of what does not show are NaN, which no comparison accepts.
            let inverse_area = (
                if shows.0 {
                    reciprocal(area.0)
                } else {
                    f32::NAN
                },
                if shows.1 {
                    -reciprocal(-area.1)
                } else {
                    f32::NAN
                },
            );
            self.diagonal_x[lane] = diagonal_x;
            self.diagonal_y[lane] = diagonal_y;
            let bias = if shows.1 { 0.0 } else { f32::INFINITY };
            self.side_bias[lane] = if shows.0 { bias } else { f32::NEG_INFINITY };
            self.edge_x[0][lane] = edge_x.0 * inverse_area.0;
            self.edge_x[1][lane] = edge_x.1 * inverse_area.1;
            self.edge_y[0][lane] = edge_y.0 * inverse_area.0;
            self.edge_y[1][lane] = edge_y.1 * inverse_area.1;
            self.inverse_area[0][lane] = inverse_area.0;
            self.inverse_area[1][lane] = inverse_area.1;
            self.inverse_depth_a[0][lane] = i0[lane];
            self.inverse_depth_a[1][lane] = i3[lane];
            self.inverse_depth_right[lane] = right;
            self.inverse_depth_left[lane] = left;
            self.u_steps[lane] = (column + lane) as f32 * STEPS + INTEGER;
        }
        self.v_steps = row * STEPS + INTEGER;
    }

    /// What every quad shows at one of its candidates, into `slot` of the batch; returns the lanes that show anything, a
    /// bit mask.
    #[inline(always)]
    fn sample(
        &self,
        x_step: i32,
        y_step: i32,
        target: &Target,
        batch: &mut Batch,
        slot: usize,
    ) -> u16 {
        let lanes = slot * LANES..(slot + 1) * LANES;
        let samples = &mut batch.sample[lanes.clone()];
        let pixels = &mut batch.pixel[lanes];
        let (mut highs, mut lows) = ([0; LANES], [0; LANES]);
        let (width, start) = (target.width as i32, target.strip.start as i32);
        let rows = target.strip.len() as u32;
        let mut hits = [0u16; LANES];
        for lane in 0..LANES {
            let dx = self.dx[lane] + x_step as f32;
            let dy = self.dy[lane] + y_step as f32;
            // Each triangle lies on its side of the diagonal.
            let side = self.diagonal_x[lane] * dy - self.diagonal_y[lane] * dx;
            let upper_left = side + self.side_bias[lane] >= 0.0;
            let one = if upper_left { u32::MAX } else { 0 };
            // By bits, because a choice between two places in memory would become a gather.
            let pick = |of: &[Lanes; 2]| {
                f32::from_bits((of[0][lane].to_bits() & one) | (of[1][lane].to_bits() & !one))
            };
            // Barycentric weights on the target image. An edge belongs to both its triangles: no cracks.
            let weight_a = side * pick(&self.inverse_area);
            let weight_left = dx * pick(&self.edge_y) - dy * pick(&self.edge_x);
            let weight_right = 1.0 - weight_a - weight_left;
            let (x, y) = (
                self.x_first[lane] + x_step,
                self.y_first[lane] + y_step - start,
            );
            let hit = (weight_a >= -EDGE_SLACK)
                & (weight_left >= -EDGE_SLACK)
                & (weight_right >= -EDGE_SLACK)
                & ((x as u32) < width as u32)
                & ((y as u32) < rows);
            // On the surface: weights divided by depth.
            let right = weight_right * self.inverse_depth_right[lane];
            let left = weight_left * self.inverse_depth_left[lane];
            let inverse_depth = weight_a * pick(&self.inverse_depth_a) + right + left;
            let depth = reciprocal(inverse_depth);
            let (right, left) = (right * depth, left * depth);
            let (right, down) = if upper_left {
                (right, left)
            } else {
                (1.0 - left, 1.0 - right)
            };
            let u = (greatest(right, 0.0) * STEPS + self.u_steps[lane]).to_bits() & INTEGER_MASK;
            let v = (greatest(down, 0.0) * STEPS + self.v_steps).to_bits() & INTEGER_MASK;
            let depth_bits = inverse_depth.to_bits() >> INVERSE_DEPTH_SHIFT;
            highs[lane] = (depth_bits << (2 * POSITION_BITS - 32)) | (v >> (32 - POSITION_BITS));
            lows[lane] = (v << POSITION_BITS) | u;
            pixels[lane] = (y * width + x) as u32;
            hits[lane] = u16::from(hit) << lane;
        }
        for lane in 0..LANES {
            samples[lane] = (u64::from(highs[lane]) << 32) | u64::from(lows[lane]);
        }
        hits.iter().fold(0, |mask, hit| mask | hit)
    }
}

/// What a triangle shows at a pixel, and whether it covers it. Vertices clockwise as seen (y down); the other way round
/// is a back face and covers nothing.
#[inline(always)]
fn sample_triangle([a, b, c]: [Vertex; 3], x: f32, y: f32) -> (Sample, bool) {
    let area = (b.x - a.x) * (c.y - a.y) - (b.y - a.y) * (c.x - a.x);
    let inverse_area = 1.0 / area;
    // Barycentric weights on the target image. An edge belongs to both its triangles: no cracks.
    let weight_b = ((x - a.x) * (c.y - a.y) - (y - a.y) * (c.x - a.x)) * inverse_area;
    let weight_c = ((b.x - a.x) * (y - a.y) - (b.y - a.y) * (x - a.x)) * inverse_area;
    let weight_a = 1.0 - weight_b - weight_c;
    let nearest_behind = least(least(a.inverse_depth, b.inverse_depth), c.inverse_depth);
    let inside = (area > 0.0)
        & (nearest_behind > 0.0)
        & (least(least(weight_a, weight_b), weight_c) >= -EDGE_SLACK);
    // On the surface: weights divided by depth.
    let (weight_a, weight_b, weight_c) = (
        weight_a * a.inverse_depth,
        weight_b * b.inverse_depth,
        weight_c * c.inverse_depth,
    );
    let inverse_depth = weight_a + weight_b + weight_c;
    let depth = 1.0 / inverse_depth;
    let u = (weight_a * a.column + weight_b * b.column + weight_c * c.column) * depth;
    let v = (weight_a * a.row + weight_b * b.row + weight_c * c.row) * depth;
    (pack(inverse_depth, u, v), inside)
}

fn draw_triangle(triangle: [Vertex; 3], target: &mut Target) {
    let [a, b, c] = triangle;
    let x_first = ceil(least(least(a.x, b.x), c.x) - EDGE_SLACK).max(0.0);
    let x_last =
        floor(greatest(greatest(a.x, b.x), c.x) + EDGE_SLACK).min(target.width as f32 - 1.0);
    let y_first = ceil(least(least(a.y, b.y), c.y) - EDGE_SLACK).max(target.strip.start as f32);
    let y_last =
        floor(greatest(greatest(a.y, b.y), c.y) + EDGE_SLACK).min(target.strip.end as f32 - 1.0);
    if x_first > x_last || y_first > y_last {
        return;
    }
    for y in y_first as usize..=y_last as usize {
        for x in x_first as usize..=x_last as usize {
            let (x, y) = (x as f32, y as f32);
            let (sample, inside) = sample_triangle(triangle, x, y);
            if inside {
                target.put(x, y, sample);
            }
        }
    }
}
