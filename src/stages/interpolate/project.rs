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

#[inline(always)]
fn pack(inverse_depth: f32, u: f32, v: f32) -> Sample {
    let steps = |position: f32| u64::from((position * STEPS + 0.5) as u32);
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
        let target_from_view = world_from_target.inverse() * world_from_view;
        let k = target.matrix();
        let k_inverse = mesh
            .intrinsics
            .matrix()
            .try_inverse()
            .expect("focal lengths are checked to be positive");
        Self {
            mesh,
            h_matrix: k * target_from_view.rotation.to_rotation_matrix().matrix() * k_inverse,
            h_offset: k * target_from_view.translation.vector,
        }
    }

    /// Draws what falls into rows `strip` of the target. `map` is that strip, `strip.len() * width` samples, and keeps
    /// the nearer of what it holds and what is drawn.
    pub fn draw(
        &self,
        width: usize,
        strip: Range<usize>,
        map: &mut [Sample],
        scratch: &mut ProjectScratch,
    ) {
        let rows = self.mesh.intrinsics.height;
        let columns = self.mesh.intrinsics.width;
        let mut lower_is = None;
        for row in 0..rows.saturating_sub(1) {
            let cut = &self.mesh.cut[row * (columns - 1)..][..columns - 1];
            if !self.may_touch(row, &strip) {
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
            };
            for (column, &triangles) in cut.iter().enumerate() {
                if triangles != 0 {
                    quads.draw(column, triangles, width, &strip, map);
                }
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

    fn transform(&self, row: usize, vertices: &mut VertexRow) {
        let columns = self.mesh.intrinsics.width;
        for plane in [
            &mut vertices.x,
            &mut vertices.y,
            &mut vertices.inverse_depth,
        ] {
            plane.resize(columns, 0.0);
        }
        let m = self.h_matrix.cast::<f32>();
        let start = (self.h_matrix * Vector3::new(0.0, row as f64, 1.0)).cast::<f32>();
        let offset = self.h_offset.cast::<f32>();
        let depth_m = &self.mesh.depth_m[row * columns..][..columns];
        let planes = vertices
            .x
            .iter_mut()
            .zip(&mut vertices.y)
            .zip(&mut vertices.inverse_depth);
        for (column, (&z, ((x, y), inverse_depth))) in depth_m.iter().zip(planes).enumerate() {
            let column = column as f32;
            let q_x = z * (m[(0, 0)] * column + start.x) + offset.x;
            let q_y = z * (m[(1, 0)] * column + start.y) + offset.y;
            let q_z = z * (m[(2, 0)] * column + start.z) + offset.z;
            let inverse = 1.0 / q_z;
            *x = q_x * inverse;
            *y = q_y * inverse;
            *inverse_depth = if z > 0.0 && q_z >= NEAR_M {
                inverse
            } else {
                0.0
            };
        }
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
}

impl QuadRow<'_> {
    #[inline(always)]
    fn draw(
        &self,
        column: usize,
        triangles: u8,
        width: usize,
        strip: &Range<usize>,
        map: &mut [Sample],
    ) {
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
            draw_triangle([left_upper, right_upper, left_lower], width, strip, map);
        }
        if triangles & LOWER_RIGHT != 0 {
            let right_lower = vertex(self.lower, column + 1, self.row + 1.0);
            draw_triangle([right_lower, left_lower, right_upper], width, strip, map);
        }
    }
}

/// Vertices clockwise as seen (y down); the other way round is a back face.
#[inline(always)]
fn draw_triangle(vertices: [Vertex; 3], width: usize, strip: &Range<usize>, map: &mut [Sample]) {
    let [a, b, c] = vertices;
    if a.inverse_depth <= 0.0 || b.inverse_depth <= 0.0 || c.inverse_depth <= 0.0 {
        return;
    }
    let area = (b.x - a.x) * (c.y - a.y) - (b.y - a.y) * (c.x - a.x);
    if area <= 0.0 {
        return;
    }
    let first = |low: f32, start: usize| (low - EDGE_SLACK).ceil().max(start as f32);
    let last = |high: f32, end: usize| (high + EDGE_SLACK).floor().min(end as f32 - 1.0);
    let x_min = first(a.x.min(b.x).min(c.x), 0);
    let x_max = last(a.x.max(b.x).max(c.x), width);
    let y_min = first(a.y.min(b.y).min(c.y), strip.start);
    let y_max = last(a.y.max(b.y).max(c.y), strip.end);
    if x_min > x_max || y_min > y_max {
        return;
    }
    let inverse_area = 1.0 / area;
    for y in y_min as usize..=y_max as usize {
        let row = (y - strip.start) * width;
        let py = y as f32;
        for x in x_min as usize..=x_max as usize {
            let px = x as f32;
            // Barycentric weights on the target image. An edge belongs to both its triangles: no cracks.
            let weight_b = ((px - a.x) * (c.y - a.y) - (py - a.y) * (c.x - a.x)) * inverse_area;
            let weight_c = ((b.x - a.x) * (py - a.y) - (b.y - a.y) * (px - a.x)) * inverse_area;
            let weight_a = 1.0 - weight_b - weight_c;
            if weight_a < -EDGE_SLACK || weight_b < -EDGE_SLACK || weight_c < -EDGE_SLACK {
                continue;
            }
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
            let sample = pack(inverse_depth, u, v);
            let slot = &mut map[row + x];
            *slot = (*slot).max(sample);
        }
    }
}

/// Of a triangle's weights and, in pixels, of its bounds: rounding in single precision must not open a crack between
/// neighbours. A view drawn from its own pose has every pixel exactly on a vertex, those of the border too.
const EDGE_SLACK: f32 = 1e-3;
