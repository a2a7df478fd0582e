//! Projects the mesh of a viewpoint into another camera: where in the viewpoint does each pixel come from?
//!
//! Mesh and poses -> one packed sample a pixel, nearest surface first: inverse depth above source position, so that
//! the z-test is an integer maximum. Back faces are dropped. Perspective-correct inside every triangle.

use std::ops::Range;

use nalgebra::{Matrix3, Vector3};

use crate::isa::{Isa, for_each_isa};
use crate::lanes::{LANES, Lanes, prefetch, reciprocal};
use crate::model::{
    camera::Intrinsics,
    patch::PATCH_ROWS,
    pose::Pose,
    viewpoint::{LOWER_RIGHT, Mesh, UPPER_LEFT},
};

use super::patch::{Drawable, FlatPatch};

/// A pixel of the map: `inverse depth (24 bit) | v (20 bit) | u (20 bit)`; 0 = the viewpoint does not see it.
pub type Sample = u64;

/// Steps of u and v per source pixel: half a step times the steepest edge stays below a grey level.
pub const STEPS: f32 = 128.0;
pub const POSITION_BITS: u32 = 20;
pub const POSITION_MASK: u64 = (1 << POSITION_BITS) - 1;
/// The largest width and height that u and v can address.
pub const SIDE_MAX: usize = 1 << (POSITION_BITS - 7);
/// Of a positive `f32` the sign is 0 and 7 bits of the mantissa are left out: depth to 1.5e-5 of itself.
pub const INVERSE_DEPTH_SHIFT: u32 = 7;
/// Surfaces nearer than this to the target camera are dropped, metres: their projection blows up.
pub const NEAR_M: f32 = 0.02;

/// 2^23: adding it leaves a non-negative number's nearest integer in the mantissa.
pub const INTEGER: f32 = 8_388_608.0;
pub const INTEGER_MASK: u32 = (1 << 23) - 1;

/// Samples of the map of a strip of so many pixels: steps of sixteen may reach beyond the last.
pub fn map_size(pixels: usize) -> usize {
    pixels + LANES
}

#[inline(always)]
fn pack(inverse_depth: f32, u: f32, v: f32) -> Sample {
    let steps =
        |position: f32| u64::from((position.max(0.0) * STEPS + INTEGER).to_bits() & INTEGER_MASK);
    (u64::from(inverse_depth.to_bits() >> INVERSE_DEPTH_SHIFT) << (2 * POSITION_BITS))
        | (steps(v) << POSITION_BITS)
        | steps(u)
}

/// The lower and the upper half of a sample -> u and v in steps, 1/depth.
#[inline(always)]
pub fn split(low: u32, high: u32) -> (u32, u32, f32) {
    const OF_V: u32 = 2 * POSITION_BITS - 32;
    let u = low & POSITION_MASK as u32;
    let v = (low >> POSITION_BITS) | ((high << (32 - OF_V)) >> (POSITION_BITS - OF_V));
    let inverse_depth = f32::from_bits((high >> OF_V) << INVERSE_DEPTH_SHIFT);
    (u, v, inverse_depth)
}

/// 1/depth in the target camera, 1/metres.
#[inline(always)]
pub fn sample_inverse_depth(sample: Sample) -> f32 {
    f32::from_bits(((sample >> (2 * POSITION_BITS)) as u32) << INVERSE_DEPTH_SHIFT)
}

/// Depth in the target camera, metres.
#[inline(always)]
pub fn sample_depth_m(sample: Sample) -> f32 {
    1.0 / sample_inverse_depth(sample)
}

/// Whole and fractional source position: `(column, row, right, down)`.
#[inline(always)]
pub fn sample_position(sample: Sample) -> (usize, usize, f32, f32) {
    let split = |steps: u64| {
        let steps = steps as u32;
        let whole = steps / STEPS as u32;
        (
            whole as usize,
            (steps % STEPS as u32) as f32 * (1.0 / STEPS),
        )
    };
    let (column, right) = split(sample & POSITION_MASK);
    let (row, down) = split((sample >> POSITION_BITS) & POSITION_MASK);
    (column, row, right, down)
}

/// A mesh ready to be drawn: a vertex `(column, row)` with depth z lands at `z * (H * (column, row, 1)) + h`,
/// homogeneous target pixels.
pub struct Projector<'a> {
    mesh: &'a Mesh,
    reach: &'a Reach,
}

/// Where a mesh lands, and which target rows its quads can reach: least and greatest y, a block of sixteen quads each.
/// Blocks without any have `(inf, -inf)`.
#[derive(Default)]
pub struct Reach {
    h_matrix: Matrix3<f64>,
    h_offset: Vector3<f64>,
    low: Vec<f32>,
    high: Vec<f32>,
    /// Of each row's blocks together.
    rows: Vec<(f32, f32)>,
    /// The patches that are drawn as such, and apart from them, so that many are passed over quickly, the target rows
    /// that each can touch.
    flat: Vec<FlatPatch>,
    flat_rows: Vec<(f32, f32)>,
    /// Blocks of [`PATCH_ROWS`] rows that need no triangles.
    done: Vec<bool>,
}

/// One row of projected vertices.
#[derive(Default, Clone)]
struct VertexRow {
    x: Vec<f32>,
    y: Vec<f32>,
    /// 1/depth in the target camera; 0 where the vertex cannot be drawn.
    inverse_depth: Vec<f32>,
}

/// Working memory of one thread.
#[derive(Default)]
pub struct ProjectScratch {
    upper: VertexRow,
    lower: VertexRow,
}

/// Target from view, as [`Projector`] applies it.
pub fn homography(
    mesh: &Mesh,
    world_from_view: &Pose,
    target: &Intrinsics,
    world_from_target: &Pose,
) -> (Matrix3<f64>, Vector3<f64>) {
    let target_from_view = world_from_target.inverse() * world_from_view;
    let k = target.matrix();
    let k_inverse = mesh
        .intrinsics
        .matrix()
        .try_inverse()
        .expect("focal lengths are checked to be positive");
    (
        k * target_from_view.rotation.to_rotation_matrix().matrix() * k_inverse,
        k * target_from_view.translation.vector,
    )
}

impl Reach {
    /// For a mesh and a camera; memory that is there is used again.
    pub fn aim(
        &mut self,
        isa: Isa,
        mesh: &Mesh,
        world_from_view: &Pose,
        target: &Intrinsics,
        world_from_target: &Pose,
    ) {
        let (h_matrix, h_offset) = homography(mesh, world_from_view, target, world_from_target);
        (self.h_matrix, self.h_offset) = (h_matrix, h_offset);
        reach(isa, self, mesh, &h_matrix, &h_offset);
    }

    /// Finds which patches are drawn as such.
    #[inline(always)]
    fn flatten(&mut self, mesh: &Mesh, h_matrix: &Matrix3<f64>, h_offset: &Vector3<f64>) {
        let blocks = mesh.blocks();
        self.flat.clear();
        self.flat.reserve(mesh.patches.capacity());
        self.flat_rows.clear();
        self.flat_rows.reserve(mesh.patches.capacity());
        self.done.clear();
        self.done
            .resize(blocks * mesh.intrinsics.height.div_ceil(PATCH_ROWS), false);
        for patch in &mesh.patches {
            match FlatPatch::of(patch, &mesh.intrinsics, h_matrix, h_offset) {
                Drawable::ByTriangles => continue,
                Drawable::Hidden => {}
                Drawable::Flat(flat, rows) => {
                    self.flat.push(flat);
                    self.flat_rows.push(rows);
                }
            }
            let first = patch.row / PATCH_ROWS * blocks + patch.column / LANES;
            self.done[first..first + patch.columns.div_ceil(LANES)].fill(true);
        }
    }

    /// Target y is monotonous in column and in depth, so the corners of a block's ranges bound it.
    #[inline(always)]
    fn compute(&mut self, mesh: &Mesh, h_matrix: &Matrix3<f64>, h_offset: &Vector3<f64>) {
        let Intrinsics { width, height, .. } = mesh.intrinsics;
        let blocks = mesh.blocks();
        self.low.clear();
        self.low.resize(blocks * height, 0.0);
        self.high.clear();
        self.high.resize(blocks * height, 0.0);
        self.rows.clear();
        let m = h_matrix.cast::<f32>();
        let offset = h_offset.cast::<f32>();
        for row in 0..height {
            let start = (h_matrix * Vector3::new(0.0, row as f64, 1.0)).cast::<f32>();
            let range = row * blocks..(row + 1) * blocks;
            let nearest = &mesh.block_nearest_m[range.clone()];
            let farthest = &mesh.block_farthest_m[range.clone()];
            let lows = &mut self.low[range.clone()];
            let highs = &mut self.high[range];
            let [above, below] = [row.saturating_sub(1), row.min(height.saturating_sub(2))]
                .map(|quads| &self.done[quads / PATCH_ROWS * blocks..][..blocks]);
            for block in 0..blocks {
                if above[block] & below[block] {
                    continue;
                }
                let (mut low, mut high, mut least_z) =
                    (f32::INFINITY, f32::NEG_INFINITY, f32::INFINITY);
                let first = (block * LANES) as f32;
                for column in [first, min(first + LANES as f32, (width - 1) as f32)] {
                    let ray_y = m[(1, 0)] * column + start.y;
                    let ray_z = m[(2, 0)] * column + start.z;
                    for z in [nearest[block], farthest[block]] {
                        let q_z = z * ray_z + offset.z;
                        let y = (z * ray_y + offset.y) / q_z;
                        low = min(low, y);
                        high = max(high, y);
                        least_z = min(least_z, q_z);
                    }
                }
                let empty = farthest[block] <= 0.0;
                // What passes the camera plane has no bound. Slack for the rounding of single precision.
                let unbounded = least_z < NEAR_M;
                lows[block] = if empty {
                    f32::INFINITY
                } else if unbounded {
                    f32::NEG_INFINITY
                } else {
                    low - 0.5
                };
                highs[block] = if empty {
                    f32::NEG_INFINITY
                } else if unbounded {
                    f32::INFINITY
                } else {
                    high + 0.5
                };
            }
        }
        // A quad lies between two rows of vertices.
        for row in 0..height.saturating_sub(1) {
            let mut hull = (f32::INFINITY, f32::NEG_INFINITY);
            let done = &self.done[row / PATCH_ROWS * blocks..][..blocks];
            for (at, &done) in (row * blocks..(row + 1) * blocks).zip(done) {
                let low = min(self.low[at], self.low[at + blocks]);
                let high = max(self.high[at], self.high[at + blocks]);
                self.low[at] = if done { f32::INFINITY } else { low };
                self.high[at] = if done { f32::NEG_INFINITY } else { high };
                hull = (min(hull.0, self.low[at]), max(hull.1, self.high[at]));
            }
            self.rows.push(hull);
        }
    }
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
            let is_needed = |block: usize| min(above[block], below[block]) < f32::INFINITY;
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
    fn reach(
        reach: &mut Reach,
        mesh: &Mesh,
        h_matrix: &Matrix3<f64>,
        h_offset: &Vector3<f64>,
    ) = reach_kernel;
}

#[inline(always)]
fn reach_kernel(reach: &mut Reach, mesh: &Mesh, h_matrix: &Matrix3<f64>, h_offset: &Vector3<f64>) {
    reach.flatten(mesh, h_matrix, h_offset);
    reach.compute(mesh, h_matrix, h_offset);
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

/// Far outside any image, and small enough for [`floor`].
const FAR_PX: f32 = 1e6;

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
struct Target<'a> {
    width: usize,
    strip: Range<usize>,
    map: &'a mut [Sample],
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

struct QuadRow<'a> {
    row: f32,
    upper: &'a VertexRow,
    lower: &'a VertexRow,
    cut: &'a [u8],
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
    fn draw_block(&self, column: usize, target: &mut Target, block: &mut Block, batch: &mut Batch) {
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

#[inline(always)]
fn min(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

#[inline(always)]
fn max(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
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
struct Block {
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
struct Batch {
    sample: [Sample; BATCH * LANES],
    /// Of the strip's map.
    pixel: [u32; BATCH * LANES],
}

impl Batch {
    const NONE: Self = Self {
        sample: [0; BATCH * LANES],
        pixel: [0; BATCH * LANES],
    };
}

impl Block {
    const NONE: Self = Self {
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
            let x_low = min(min(x0[lane], x1[lane]), min(x2[lane], x3[lane]));
            let x_high = max(max(x0[lane], x1[lane]), max(x2[lane], x3[lane]));
            let y_low = min(min(y0[lane], y1[lane]), min(y2[lane], y3[lane]));
            let y_high = max(max(y0[lane], y1[lane]), max(y2[lane], y3[lane]));
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
            let behind = min(right, left) <= 0.0;
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
            let u = (max(right, 0.0) * STEPS + self.u_steps[lane]).to_bits() & INTEGER_MASK;
            let v = (max(down, 0.0) * STEPS + self.v_steps).to_bits() & INTEGER_MASK;
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
    let nearest_behind = min(min(a.inverse_depth, b.inverse_depth), c.inverse_depth);
    let inside = (area > 0.0)
        & (nearest_behind > 0.0)
        & (min(min(weight_a, weight_b), weight_c) >= -EDGE_SLACK);
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
    let x_first = ceil(min(min(a.x, b.x), c.x) - EDGE_SLACK).max(0.0);
    let x_last = floor(max(max(a.x, b.x), c.x) + EDGE_SLACK).min(target.width as f32 - 1.0);
    let y_first = ceil(min(min(a.y, b.y), c.y) - EDGE_SLACK).max(target.strip.start as f32);
    let y_last = floor(max(max(a.y, b.y), c.y) + EDGE_SLACK).min(target.strip.end as f32 - 1.0);
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

/// Of a triangle's weights and, in pixels, of its bounds: rounding in single precision must not open a crack between
/// neighbours. A view drawn from its own pose has every pixel exactly on a vertex, those of the border too.
pub const EDGE_SLACK: f32 = 1e-3;
