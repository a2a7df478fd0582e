//! Where a mesh lands in another camera: which target rows each part of it can touch, so that a strip looks at little else.
//!
//! Mesh and poses -> bounds of each block of sixteen quads, and the flat patches ready to be drawn.

use nalgebra::{Matrix3, Vector3};

use crate::{
    isa::{Isa, for_each_isa},
    lanes::{LANES, greatest, least},
    model::{camera::Intrinsics, patch::PATCH_ROWS, pose::Pose, viewpoint::Mesh},
};

use super::patch::{Drawable, FlatPatch};

/// Surfaces nearer than this to the target camera are dropped, metres: their projection blows up.
pub const NEAR_M: f32 = 0.02;

/// Where a mesh lands, and which target rows its quads can reach: least and greatest y, a block of sixteen quads each.
/// Blocks without any have `(inf, -inf)`.
#[derive(Default)]
pub struct Reach {
    pub(super) h_matrix: Matrix3<f64>,
    pub(super) h_offset: Vector3<f64>,
    pub(super) low: Vec<f32>,
    pub(super) high: Vec<f32>,
    /// Of each row's blocks together.
    pub(super) rows: Vec<(f32, f32)>,
    /// The patches that are drawn as such, and apart from them, so that many are passed over quickly, the target rows
    /// that each can touch.
    pub(super) flat: Vec<FlatPatch>,
    pub(super) flat_rows: Vec<(f32, f32)>,
    /// Blocks of [`PATCH_ROWS`] rows that need no triangles.
    done: Vec<bool>,
}

/// Target from view, as [`super::project::Projector`] applies it.
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
                for column in [first, least(first + LANES as f32, (width - 1) as f32)] {
                    let ray_y = m[(1, 0)] * column + start.y;
                    let ray_z = m[(2, 0)] * column + start.z;
                    for z in [nearest[block], farthest[block]] {
                        let q_z = z * ray_z + offset.z;
                        let y = (z * ray_y + offset.y) / q_z;
                        low = least(low, y);
                        high = greatest(high, y);
                        least_z = least(least_z, q_z);
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
                let low = least(self.low[at], self.low[at + blocks]);
                let high = greatest(self.high[at], self.high[at + blocks]);
                self.low[at] = if done { f32::INFINITY } else { low };
                self.high[at] = if done { f32::NEG_INFINITY } else { high };
                hull = (least(hull.0, self.low[at]), greatest(hull.1, self.high[at]));
            }
            self.rows.push(hull);
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
