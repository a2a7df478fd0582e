//! A viewpoint: a stored pose with depth map, mesh and one belief a pixel (the paper's reference parameter image).

use crate::lanes::{LANES, greatest, least, load_or};

use super::{
    belief::{Belief, LEVEL_OFFSET, LEVEL_SCALE, Record, f32_from_f16},
    camera::Intrinsics,
    frame::Source,
    patch::{self, Patch},
    pose::Pose,
};

/// Viewpoints that are recalled together, as [`crate::config::Settings::views`] allows.
pub const VIEWS_MAX: usize = 16;

/// Bits of [`Mesh::cut`]: which of a quad's two triangles exist.
pub const UPPER_LEFT: u8 = 1;
pub const LOWER_RIGHT: u8 = 2;

/// Where a mesh is cut: between neighbours whose depths differ by more than both say.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct MeshCut {
    /// Of the nearer depth.
    pub share: f32,
    /// Of inverse depth, 1/m: how far two points of one surface may lie apart where depth is only known in steps of it.
    pub inverse_depth: f32,
}

impl From<f32> for MeshCut {
    /// For depth that is measured: the share alone.
    fn from(share: f32) -> Self {
        Self {
            share,
            inverse_depth: 0.0,
        }
    }
}

impl MeshCut {
    #[inline(always)]
    fn joins(self, z_min: f32, z_max: f32) -> bool {
        let allowed = self.share.max(self.inverse_depth * z_max);
        z_max - z_min <= allowed * z_min
    }
}

/// The surface seen from a viewpoint: vertices at pixel centres, two triangles a quad, split from its upper right to
/// its lower left corner.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Mesh {
    pub intrinsics: Intrinsics,
    /// Metres along the optical axis; 0 = none. `width * height`.
    pub depth_m: Vec<f32>,
    /// Where it was cut.
    pub joined: MeshCut,
    /// Triangles of the quad whose upper left vertex is this pixel; rows of `width - 1`.
    pub cut: Vec<u8>,
    /// Least and greatest depth of the vertices of sixteen quads of a row, rows of [`Self::blocks`]; `inf` and 0 without
    /// any.
    pub block_nearest_m: Vec<f32>,
    pub block_farthest_m: Vec<f32>,
    /// The flat parts; no two share a quad.
    pub patches: Vec<Patch>,
}

impl Mesh {
    /// A triangle exists where its three vertices have depth and `z_max - z_min <= cut * z_min`, or their inverse depths
    /// are as close as `cut` says.
    pub fn new(intrinsics: Intrinsics, depth_m: Vec<f32>, cut: impl Into<MeshCut>) -> Self {
        let mut mesh = Self {
            intrinsics,
            depth_m,
            ..Self::default()
        };
        mesh.join(cut.into());
        mesh
    }

    /// Makes everything that follows from intrinsics and depth; memory that is there is used again.
    #[inline(always)]
    pub fn join(&mut self, cut: MeshCut) {
        let Intrinsics { width, height, .. } = self.intrinsics;
        assert_eq!(self.depth_m.len(), width * height, "one depth a pixel");
        self.joined = cut;
        self.find_ranges();
        self.cut.clear();
        self.cut
            .resize(width.saturating_sub(1) * height.saturating_sub(1), 0);
        self.patches.clear();
        // Half of a camera one pixel wide has no column.
        if width < 2 {
            return;
        }
        let rows = || self.depth_m.chunks_exact(width);
        let masks = self.cut.chunks_exact_mut(width - 1);
        for ((upper, lower), mask) in rows().zip(rows().skip(1)).zip(masks) {
            for column in 0..width - 1 {
                let (a, b) = (upper[column], upper[column + 1]);
                let (c, d) = (lower[column], lower[column + 1]);
                // What both triangles share.
                let (near, far) = (b.min(c), b.max(c));
                let joined = |near: f32, far: f32| (near > 0.0) & cut.joins(near, far);
                let upper_left = joined(near.min(a), far.max(a));
                let lower_right = joined(near.min(d), far.max(d));
                mask[column] =
                    u8::from(upper_left) * UPPER_LEFT + u8::from(lower_right) * LOWER_RIGHT;
            }
        }
        patch::find(&self.depth_m, &self.cut, width, &mut self.patches);
    }

    /// Least and greatest depth of every block.
    #[inline(always)]
    fn find_ranges(&mut self) {
        let Intrinsics { width, height, .. } = self.intrinsics;
        let blocks = self.blocks();
        for plane in [&mut self.block_nearest_m, &mut self.block_farthest_m] {
            plane.clear();
            plane.resize(blocks * height, 0.0);
        }
        if blocks == 0 {
            return;
        }
        let ranges = self
            .block_nearest_m
            .chunks_exact_mut(blocks)
            .zip(self.block_farthest_m.chunks_exact_mut(blocks));
        for (row, (nearest_m, farthest_m)) in self.depth_m.chunks_exact(width).zip(ranges) {
            for block in 0..blocks {
                // Quads need the vertex to their right.
                let vertices = &row[block * LANES..];
                let beyond = vertices.get(LANES).copied().unwrap_or(0.0);
                let depth_m = load_or(0.0, vertices);
                let (mut near, mut far) = ([0.0; LANES], depth_m);
                for lane in 0..LANES {
                    near[lane] = given_or_infinite(depth_m[lane]);
                }
                for half in [8, 4, 2, 1] {
                    for lane in 0..half {
                        near[lane] = least(near[lane], near[lane + half]);
                        far[lane] = greatest(far[lane], far[lane + half]);
                    }
                }
                nearest_m[block] = least(near[0], given_or_infinite(beyond));
                farthest_m[block] = greatest(far[0], beyond);
            }
        }
    }

    /// Takes depth and triangles away from the vertices for which `gone` says so; the rest stays bit for bit.
    fn clear(&mut self, gone: &[bool]) {
        let Intrinsics { width, height, .. } = self.intrinsics;
        let quads = width.saturating_sub(1);
        for y in 0..height {
            for x in (0..width).filter(|&x| gone[y * width + x]) {
                self.depth_m[y * width + x] = 0.0;
                // The quad to the lower right has this vertex in its upper left corner, and so on.
                let corners = [
                    (Some(y), Some(x), !UPPER_LEFT),
                    (Some(y), x.checked_sub(1), 0),
                    (y.checked_sub(1), Some(x), 0),
                    (y.checked_sub(1), x.checked_sub(1), !LOWER_RIGHT),
                ];
                for (row, column, kept) in corners {
                    if let (Some(row), Some(column)) = (row, column)
                        && row + 1 < height
                        && column < quads
                    {
                        self.cut[row * quads + column] &= kept;
                    }
                }
            }
        }
        self.find_ranges();
        self.patches.clear();
        if width >= 2 {
            patch::find(&self.depth_m, &self.cut, width, &mut self.patches);
        }
    }

    /// Blocks of sixteen quads in a row.
    pub fn blocks(&self) -> usize {
        self.intrinsics.width.saturating_sub(1).div_ceil(LANES)
    }

    fn bytes(&self) -> usize {
        size_of_val(self.depth_m.as_slice())
            + size_of_val(self.cut.as_slice())
            + size_of_val(self.block_nearest_m.as_slice())
            + size_of_val(self.block_farthest_m.as_slice())
            + self.patches.capacity() * size_of::<Patch>()
    }
}

#[inline(always)]
fn given_or_infinite(depth_m: f32) -> f32 {
    if depth_m > 0.0 {
        depth_m
    } else {
        f32::INFINITY
    }
}

/// A viewpoint's luminance at half resolution: what poses are refined against. Follows from mesh and records.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Coarse {
    pub mesh: Mesh,
    /// Expected Y, a value a pixel of the mesh.
    pub luminance: Vec<f32>,
    /// Predictive variance of Y: beta/alpha * (1 + sigma), squared grey levels.
    pub variance: Vec<f32>,
}

/// How many pixels of 2x2 must have depth, on one surface, for their mean to have it.
const COARSE_DEPTHS_MIN: f32 = 3.0;

impl Coarse {
    /// Means over 2x2 pixels; `cut` as for [`Mesh::new`].
    pub fn new(mesh: &Mesh, records: &[Record], cut: impl Into<MeshCut>) -> Self {
        let mut coarse = Self::default();
        coarse.reduce(mesh, records, cut.into());
        coarse
    }

    /// The same, using again the memory that is there.
    fn reduce(&mut self, mesh: &Mesh, records: &[Record], cut: MeshCut) {
        self.mesh.halve(mesh, cut);
        let Self {
            luminance,
            variance,
            ..
        } = self;
        halve_luminance(records, &mesh.intrinsics, luminance, variance);
    }
}

impl Mesh {
    /// Becomes another one's at half resolution, as [`Coarse::mesh`] is; memory that is there is used again.
    #[inline(always)]
    pub fn halve(&mut self, mesh: &Mesh, cut: MeshCut) {
        let (fine, coarse) = (mesh.intrinsics, mesh.intrinsics.half());
        self.intrinsics = coarse;
        self.depth_m.resize(coarse.pixels(), 0.0);
        for y in 0..coarse.height {
            coarse_depth_row(
                &mesh.depth_m[2 * y * fine.width..(2 * y + 1) * fine.width],
                &mesh.depth_m[(2 * y + 1) * fine.width..(2 * y + 2) * fine.width],
                cut,
                &mut self.depth_m[y * coarse.width..(y + 1) * coarse.width],
            );
        }
        self.join(cut);
    }
}

/// [`Coarse::luminance`] and [`Coarse::variance`] of a full image's records; memory that is there is used again.
#[inline(always)]
pub fn halve_luminance(
    records: &[Record],
    fine: &Intrinsics,
    luminance: &mut Vec<f32>,
    variance: &mut Vec<f32>,
) {
    let coarse = fine.half();
    luminance.resize(coarse.pixels(), 0.0);
    variance.resize(coarse.pixels(), 0.0);
    for y in 0..coarse.height {
        let row = y * coarse.width..(y + 1) * coarse.width;
        coarse_luminance_row(
            &records[2 * y * fine.width..(2 * y + 1) * fine.width],
            &records[(2 * y + 1) * fine.width..(2 * y + 2) * fine.width],
            &mut luminance[row.clone()],
            &mut variance[row],
        );
    }
}

/// Means of the depths that are there; 0 where they are too few or not on one surface.
#[inline(always)]
fn coarse_depth_row(upper: &[f32], lower: &[f32], cut: MeshCut, coarse: &mut [f32]) {
    let pairs = upper.chunks_exact(2).zip(lower.chunks_exact(2));
    for (coarse, (upper, lower)) in coarse.iter_mut().zip(pairs) {
        let (mut count, mut sum, mut near, mut far) = (0.0, 0.0, f32::INFINITY, 0.0f32);
        for z in [upper[0], upper[1], lower[0], lower[1]] {
            count += if z > 0.0 { 1.0 } else { 0.0 };
            sum += z;
            near = near.min(given_or_infinite(z));
            far = far.max(z);
        }
        let joined = (count >= COARSE_DEPTHS_MIN) & cut.joins(near, far);
        *coarse = if joined { sum / count } else { 0.0 };
    }
}

#[inline(always)]
fn coarse_luminance_row(
    upper: &[Record],
    lower: &[Record],
    luminance: &mut [f32],
    variance: &mut [f32],
) {
    let pairs = upper.chunks_exact(2).zip(lower.chunks_exact(2));
    let coarse = luminance.iter_mut().zip(variance);
    for ((luminance, variance), (upper, lower)) in coarse.zip(pairs) {
        let (mut level, mut spread) = (0.0, 0.0);
        for record in [&upper[0], &upper[1], &lower[0], &lower[1]] {
            let [alpha, beta, _, _, sigma, ..] = record.spread.map(f32_from_f16);
            level += f32::from(record.level[0]);
            spread += beta / alpha * (1.0 + sigma);
        }
        *luminance = level * (0.25 / LEVEL_SCALE) + LEVEL_OFFSET[0];
        *variance = spread / 4.0;
    }
}

/// What is known about a viewpoint without its planes.
#[derive(Debug, Clone, PartialEq)]
pub struct Head {
    pub id: u64,
    pub world_from_camera: Pose,
    pub world_from_home: Pose,
    pub intrinsics: Intrinsics,
    pub source: Source,
    pub stamp_ns: i64,
    pub updates: u64,
}

#[derive(Debug, Clone, PartialEq)]
pub struct Viewpoint {
    pub id: u64,
    pub world_from_camera: Pose,
    /// Where the slot was made; replacement keeps a slot near its home, so that it is not dragged along.
    pub world_from_home: Pose,
    pub mesh: Mesh,
    /// One a pixel.
    pub records: Vec<Record>,
    pub coarse: Coarse,
    /// Who wrote it last, and when (capture time).
    pub source: Source,
    pub stamp_ns: i64,
    /// How many frames were written into it.
    pub updates: u64,
}

impl Viewpoint {
    /// From what is stored of it; the rest follows.
    pub fn from_stored(
        head: Head,
        depth_m: Vec<f32>,
        joined: MeshCut,
        records: Vec<Record>,
    ) -> Self {
        let unknown = Record::pack(&Belief::unknown());
        let forgotten: Vec<bool> = records
            .iter()
            .zip(&depth_m)
            .map(|(record, &z)| *record == unknown && z <= 0.0)
            .collect();
        let mesh = Mesh::new(head.intrinsics, depth_m, joined);
        let mut viewpoint = Self {
            id: head.id,
            world_from_camera: head.world_from_camera,
            world_from_home: head.world_from_home,
            coarse: Coarse::new(&mesh, &records, joined),
            mesh,
            records,
            source: head.source,
            stamp_ns: head.stamp_ns,
            updates: head.updates,
        };
        // The coarse picture has forgotten more than its planes tell.
        if forgotten.contains(&true) {
            viewpoint.clear(&forgotten);
        }
        viewpoint
    }

    pub fn head(&self) -> Head {
        Head {
            id: self.id,
            world_from_camera: self.world_from_camera,
            world_from_home: self.world_from_home,
            intrinsics: self.mesh.intrinsics,
            source: self.source.clone(),
            stamp_ns: self.stamp_ns,
            updates: self.updates,
        }
    }

    /// Forgets the pixels for which `gone` says so, one flag a pixel: they lie on no surface any more, and nothing is
    /// left of what they looked like. Everything else stays bit for bit.
    pub fn clear(&mut self, gone: &[bool]) {
        let width = self.mesh.intrinsics.width;
        assert_eq!(gone.len(), self.records.len(), "one flag a pixel");
        let unknown = Belief::unknown();
        let record = Record::pack(&unknown);
        for (held, _) in self.records.iter_mut().zip(gone).filter(|(_, gone)| **gone) {
            *held = record;
        }
        self.mesh.clear(gone);
        // A mean over four pixels is forgotten with any of them.
        let coarse = self.coarse.mesh.intrinsics;
        let gone_coarse: Vec<bool> = (0..coarse.pixels())
            .map(|pixel| {
                let upper = 2 * (pixel / coarse.width) * width + 2 * (pixel % coarse.width);
                [upper, upper + 1, upper + width, upper + width + 1]
                    .into_iter()
                    .any(|fine| gone[fine])
            })
            .collect();
        for pixel in (0..coarse.pixels()).filter(|&pixel| gone_coarse[pixel]) {
            self.coarse.luminance[pixel] = unknown.tau[0];
            self.coarse.variance[pixel] =
                unknown.beta[0] / unknown.alpha * (1.0 + unknown.sigma[0]);
        }
        self.coarse.mesh.clear(&gone_coarse);
    }

    /// Nothing of it lies on a surface: nobody will ever see it.
    pub fn is_empty(&self) -> bool {
        self.mesh.depth_m.iter().all(|&z| z <= 0.0)
    }

    /// What it takes of the memory's budget.
    pub fn bytes(&self) -> usize {
        size_of::<Self>()
            + size_of_val(self.records.as_slice())
            + self.mesh.bytes()
            + self.coarse.mesh.bytes()
            + size_of_val(self.coarse.luminance.as_slice())
            + size_of_val(self.coarse.variance.as_slice())
    }
}
