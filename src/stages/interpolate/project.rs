//! Projects the mesh of a viewpoint into another camera: where in the viewpoint does each pixel come from?
//!
//! Mesh and poses -> one packed sample a pixel, nearest surface first: inverse depth above source position, so that
//! the z-test is an integer maximum. Back faces are dropped. Perspective-correct inside every triangle.

use std::ops::Range;

use nalgebra::{Matrix3, Vector3};

use crate::model::{
    camera::Intrinsics,
    pose::Pose,
    viewpoint::{LOWER_RIGHT, Mesh, UPPER_LEFT},
};
use crate::stages::lanes::{LANES, Lanes};

/// A pixel of the map: `inverse depth (24 bit) | v (20 bit) | u (20 bit)`; 0 = the viewpoint does not see it.
pub type Sample = u64;

/// Steps of u and v per source pixel: half a step times the steepest edge stays below a grey level.
const STEPS: f32 = 128.0;
const POSITION_BITS: u32 = 20;
const POSITION_MASK: u64 = (1 << POSITION_BITS) - 1;
/// The largest width and height that u and v can address.
pub const SIDE_MAX: usize = 1 << (POSITION_BITS - 7);
/// Of a positive `f32` the sign is 0 and 7 bits of the mantissa are left out: depth to 1.5e-5 of itself.
const INVERSE_DEPTH_SHIFT: u32 = 7;
/// Surfaces nearer than this to the target camera are dropped, metres: their projection blows up.
const NEAR_M: f32 = 0.02;

/// 2^23: adding it leaves a non-negative number's nearest integer in the mantissa.
const INTEGER: f32 = 8_388_608.0;
const INTEGER_MASK: u32 = (1 << 23) - 1;

#[inline(always)]
fn pack(inverse_depth: f32, u: f32, v: f32) -> Sample {
    let steps =
        |position: f32| u64::from((position.max(0.0) * STEPS + INTEGER).to_bits() & INTEGER_MASK);
    (u64::from(inverse_depth.to_bits() >> INVERSE_DEPTH_SHIFT) << (2 * POSITION_BITS))
        | (steps(v) << POSITION_BITS)
        | steps(u)
}

/// Depth in the target camera, metres.
#[inline(always)]
pub fn sample_depth_m(sample: Sample) -> f32 {
    1.0 / f32::from_bits(((sample >> (2 * POSITION_BITS)) as u32) << INVERSE_DEPTH_SHIFT)
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
    h_matrix: Matrix3<f64>,
    h_offset: Vector3<f64>,
}

/// H and h of [`Projector`].
pub fn homography(
    source: &Intrinsics,
    world_from_view: &Pose,
    target: &Intrinsics,
    world_from_target: &Pose,
) -> (Matrix3<f64>, Vector3<f64>) {
    let target_from_view = world_from_target.inverse() * world_from_view;
    let k = target.matrix();
    let k_inverse = source
        .matrix()
        .try_inverse()
        .expect("focal lengths are checked to be positive");
    (
        k * target_from_view.rotation.to_rotation_matrix().matrix() * k_inverse,
        k * target_from_view.translation.vector,
    )
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

impl<'a> Projector<'a> {
    pub fn new(
        mesh: &'a Mesh,
        world_from_view: &Pose,
        target: &Intrinsics,
        world_from_target: &Pose,
    ) -> Self {
        let (h_matrix, h_offset) =
            homography(&mesh.intrinsics, world_from_view, target, world_from_target);
        Self {
            mesh,
            h_matrix,
            h_offset,
        }
    }

    /// Draws what falls into rows `strip` of the target. `map` is that strip, `strip.len() * width` samples, and keeps
    /// the nearer of what it holds and what is drawn.
    #[inline(always)]
    pub fn draw(
        &self,
        width: usize,
        strip: Range<usize>,
        map: &mut [Sample],
        scratch: &mut ProjectScratch,
    ) {
        let rows = self.mesh.intrinsics.height;
        let mut target = Target { width, strip, map };
        let columns = self.mesh.intrinsics.width;
        let mut lower_is = None;
        for row in 0..rows.saturating_sub(1) {
            let cut = &self.mesh.cut[row * (columns - 1)..][..columns - 1];
            if !self.may_touch(row, &target.strip) {
                continue;
            }
            if lower_is == Some(row) {
                std::mem::swap(&mut scratch.upper, &mut scratch.lower);
            } else {
                self.transform(row, &mut scratch.upper);
            }
            self.transform(row + 1, &mut scratch.lower);
            lower_is = Some(row + 1);
            let quads = QuadRow {
                row: row as f32,
                upper: &scratch.upper,
                lower: &scratch.lower,
                cut,
            };
            for column in (0..cut.len()).step_by(LANES) {
                quads.draw_block(column, &mut target);
            }
        }
    }

    /// Whether any quad between `row` and `row + 1` can reach the strip. Target y is monotonous in column and in depth,
    /// so the corners of their ranges bound it.
    fn may_touch(&self, row: usize, strip: &Range<usize>) -> bool {
        let mut low = f64::INFINITY;
        let mut high = f64::NEG_INFINITY;
        for row in [row, row + 1] {
            let (z_min, z_max) = self.mesh.row_depth_m[row];
            if z_max <= 0.0 {
                continue;
            }
            for column in [0, self.mesh.intrinsics.width - 1] {
                let ray = self.h_matrix * Vector3::new(column as f64, row as f64, 1.0);
                for z in [z_min, z_max] {
                    let q = ray * f64::from(z) + self.h_offset;
                    if q.z < f64::from(NEAR_M) {
                        // It passes the camera plane: no bound.
                        return true;
                    }
                    low = low.min(q.y / q.z);
                    high = high.max(q.y / q.z);
                }
            }
        }
        // One pixel of slack for the rounding of single precision.
        low - 1.0 <= strip.end as f64 && high + 1.0 >= strip.start as f64
    }

    #[inline(always)]
    fn transform(&self, row: usize, vertices: &mut VertexRow) {
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
        let m = self.h_matrix.cast::<f32>();
        let start = (self.h_matrix * Vector3::new(0.0, row as f64, 1.0)).cast::<f32>();
        let offset = self.h_offset.cast::<f32>();
        let depth_m = &self.mesh.depth_m[row * columns..][..columns];
        let xs = &mut vertices.x[..columns];
        let ys = &mut vertices.y[..columns];
        let inverse_depths = &mut vertices.inverse_depth[..columns];
        for column in 0..columns {
            let z = depth_m[column];
            let at = column as f32;
            let q_x = z * (m[(0, 0)] * at + start.x) + offset.x;
            let q_y = z * (m[(1, 0)] * at + start.y) + offset.y;
            let q_z = z * (m[(2, 0)] * at + start.z) + offset.z;
            let drawable = z > 0.0 && q_z >= NEAR_M;
            let inverse = if drawable { 1.0 / q_z } else { 0.0 };
            xs[column] = (q_x * inverse).clamp(-FAR_PX, FAR_PX);
            ys[column] = (q_y * inverse).clamp(-FAR_PX, FAR_PX);
            inverse_depths[column] = inverse;
        }
    }
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

    #[inline(always)]
    fn contains(&self, x: f32, y: f32) -> bool {
        (x >= 0.0)
            & (y >= self.strip.start as f32)
            & (x < self.width as f32)
            & (y < self.strip.end as f32)
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
const LANE_CANDIDATES: f32 = 4.0;

impl QuadRow<'_> {
    /// The sixteen quads from `column` on, side by side: every candidate pixel of every quad's bounding box is tested
    /// against the triangle on its side of the diagonal.
    #[inline(always)]
    fn draw_block(&self, column: usize, target: &mut Target) {
        let mut triangles = [0u8; LANES];
        let quads = &self.cut[column..self.cut.len().min(column + LANES)];
        triangles[..quads.len()].copy_from_slice(quads);
        if u128::from_ne_bytes(triangles) == 0 {
            return;
        }
        let corners = Corners {
            x: self.corner_lanes(column, |vertices| &vertices.x),
            y: self.corner_lanes(column, |vertices| &vertices.y),
            inverse_depth: self.corner_lanes(column, |vertices| &vertices.inverse_depth),
        };
        // First candidate and number of candidates; none where nothing can be drawn.
        let mut x_first = [0.0; LANES];
        let mut y_first = [0.0; LANES];
        let mut x_count = [0.0; LANES];
        let mut y_count = [0.0; LANES];
        for lane in 0..LANES {
            let corner = |plane: &[Lanes; 4], pick: fn(f32, f32) -> f32| {
                pick(
                    pick(plane[0][lane], plane[1][lane]),
                    pick(plane[2][lane], plane[3][lane]),
                )
            };
            let x_low = ceil(corner(&corners.x, min) - EDGE_SLACK);
            let y_low = ceil(corner(&corners.y, min) - EDGE_SLACK);
            let x_high = floor(corner(&corners.x, max) + EDGE_SLACK);
            let y_high = floor(corner(&corners.y, max) + EDGE_SLACK);
            let touches = (triangles[lane] != 0)
                & (x_high >= 0.0)
                & (x_low < target.width as f32)
                & (y_high >= target.strip.start as f32)
                & (y_low < target.strip.end as f32);
            x_first[lane] = x_low;
            y_first[lane] = y_low;
            x_count[lane] = if touches { x_high - x_low + 1.0 } else { 0.0 };
            y_count[lane] = if touches { y_high - y_low + 1.0 } else { 0.0 };
        }
        let mut x_steps = 0.0f32;
        let mut y_steps = 0.0f32;
        let mut oversized = false;
        for lane in 0..LANES {
            let fits = (x_count[lane] <= LANE_CANDIDATES) & (y_count[lane] <= LANE_CANDIDATES);
            oversized |= !fits;
            x_steps = max(x_steps, if fits { x_count[lane] } else { 0.0 });
            y_steps = max(y_steps, if fits { y_count[lane] } else { 0.0 });
        }
        if oversized {
            for lane in 0..LANES {
                if (x_count[lane] > LANE_CANDIDATES) | (y_count[lane] > LANE_CANDIDATES) {
                    self.draw_quad(column + lane, triangles[lane], target);
                    triangles[lane] = 0;
                }
            }
        }
        for y_step in 0..y_steps as usize {
            for x_step in 0..x_steps as usize {
                let mut samples = [0; LANES];
                let mut xs = [0.0; LANES];
                let mut ys = [0.0; LANES];
                for lane in 0..LANES {
                    let x = x_first[lane] + x_step as f32;
                    let y = y_first[lane] + y_step as f32;
                    let sample = corners.sample(
                        lane,
                        triangles[lane],
                        (column + lane) as f32,
                        self.row,
                        (x, y),
                    );
                    xs[lane] = x;
                    ys[lane] = y;
                    samples[lane] = if target.contains(x, y) { sample } else { 0 };
                }
                for lane in 0..LANES {
                    if samples[lane] != 0 {
                        target.put(xs[lane], ys[lane], samples[lane]);
                    }
                }
            }
        }
    }

    /// Upper left, upper right, lower left, lower right of sixteen quads.
    #[inline(always)]
    fn corner_lanes(&self, column: usize, plane: fn(&VertexRow) -> &[f32]) -> [Lanes; 4] {
        let lanes = |vertices: &VertexRow, column: usize| -> Lanes {
            *plane(vertices)[column..]
                .first_chunk()
                .expect("rows are padded to whole blocks")
        };
        [
            lanes(self.upper, column),
            lanes(self.upper, column + 1),
            lanes(self.lower, column),
            lanes(self.lower, column + 1),
        ]
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
struct Corners {
    x: [Lanes; 4],
    y: [Lanes; 4],
    inverse_depth: [Lanes; 4],
}

impl Corners {
    /// What the quad of a lane shows at a pixel; 0 = nothing.
    #[inline(always)]
    fn sample(
        &self,
        lane: usize,
        triangles: u8,
        column: f32,
        row: f32,
        (x, y): (f32, f32),
    ) -> Sample {
        let at = |corner: usize| (self.x[corner][lane], self.y[corner][lane]);
        let (upper_right, lower_left) = (at(1), at(2));
        // Each triangle lies on its side of the diagonal, if it shows its front.
        let side = (lower_left.0 - upper_right.0) * (y - upper_right.1)
            - (lower_left.1 - upper_right.1) * (x - upper_right.0);
        let has_upper_left = triangles & UPPER_LEFT != 0;
        let has_lower_right = triangles & LOWER_RIGHT != 0;
        let upper_left = has_upper_left & ((side >= 0.0) | !has_lower_right);
        let pick = |a: f32, b: f32| if upper_left { a } else { b };
        let vertex = |one: usize, other: usize, (right, down): (f32, f32)| Vertex {
            x: pick(self.x[one][lane], self.x[other][lane]),
            y: pick(self.y[one][lane], self.y[other][lane]),
            inverse_depth: pick(
                self.inverse_depth[one][lane],
                self.inverse_depth[other][lane],
            ),
            column: column + pick(right, 1.0 - right),
            row: row + pick(down, 1.0 - down),
        };
        let triangle = [
            vertex(0, 3, (0.0, 0.0)),
            vertex(1, 2, (1.0, 0.0)),
            vertex(2, 1, (0.0, 1.0)),
        ];
        let (sample, inside) = sample_triangle(triangle, x, y);
        if inside & (triangles != 0) { sample } else { 0 }
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
const EDGE_SLACK: f32 = 1e-3;
