//! A viewpoint: a stored pose with depth map, mesh and one belief a pixel (the paper's reference parameter image).

use super::{belief::Record, camera::Intrinsics, frame::Source, pose::Pose};

/// Bits of [`Mesh::cut`]: which of a quad's two triangles exist.
pub const UPPER_LEFT: u8 = 1;
pub const LOWER_RIGHT: u8 = 2;

/// The surface seen from a viewpoint: vertices at pixel centres, two triangles a quad, split from its upper right to
/// its lower left corner.
#[derive(Debug, Clone, PartialEq)]
pub struct Mesh {
    pub intrinsics: Intrinsics,
    /// Metres along the optical axis; 0 = none. `width * height`.
    pub depth_m: Vec<f32>,
    /// Triangles of the quad whose upper left vertex is this pixel; rows of `width - 1`.
    pub cut: Vec<u8>,
    /// Least and greatest depth of each row's vertices; `(inf, 0)` for a row without any.
    pub row_depth_m: Vec<(f32, f32)>,
}

impl Mesh {
    /// A triangle exists where its three vertices have depth and `z_max - z_min <= cut * z_min`.
    pub fn new(intrinsics: Intrinsics, depth_m: Vec<f32>, cut: f32) -> Self {
        let Intrinsics { width, height, .. } = intrinsics;
        assert_eq!(depth_m.len(), width * height, "one depth a pixel");
        let joined = |a: f32, b: f32, c: f32| {
            let z_min = a.min(b).min(c);
            let z_max = a.max(b).max(c);
            z_min > 0.0 && z_max - z_min <= cut * z_min
        };
        let mut mask = Vec::with_capacity(width.saturating_sub(1) * height.saturating_sub(1));
        // Half of a camera one pixel wide has no column, and no row then.
        let rows = || depth_m.chunks_exact(width.max(1));
        for (upper, lower) in rows().zip(rows().skip(1)) {
            for (upper, lower) in upper.windows(2).zip(lower.windows(2)) {
                let upper_left = joined(upper[0], upper[1], lower[0]);
                let lower_right = joined(lower[1], lower[0], upper[1]);
                mask.push(u8::from(upper_left) * UPPER_LEFT + u8::from(lower_right) * LOWER_RIGHT);
            }
        }
        let row_depth_m = rows()
            .map(|row| {
                row.iter()
                    .filter(|&&z| z > 0.0)
                    .fold((f32::INFINITY, 0.0f32), |(low, high), &z| {
                        (low.min(z), high.max(z))
                    })
            })
            .collect();
        Self {
            intrinsics,
            depth_m,
            cut: mask,
            row_depth_m,
        }
    }

    fn bytes(&self) -> usize {
        size_of_val(self.depth_m.as_slice())
            + size_of_val(self.cut.as_slice())
            + size_of_val(self.row_depth_m.as_slice())
    }
}

/// A viewpoint's luminance at half resolution: what poses are refined against. Follows from mesh and records.
#[derive(Debug, Clone, PartialEq)]
pub struct Coarse {
    pub mesh: Mesh,
    /// Expected Y, a value a pixel of the mesh.
    pub luminance: Vec<f32>,
    /// Predictive variance of Y: beta/alpha * (1 + sigma), squared grey levels.
    pub variance: Vec<f32>,
}

/// How many pixels of 2x2 must have depth, on one surface, for their mean to have it.
const COARSE_DEPTHS_MIN: usize = 3;

impl Coarse {
    /// Means over 2x2 pixels; `cut` as for [`Mesh::new`].
    pub fn new(mesh: &Mesh, records: &[Record], cut: f32) -> Self {
        let fine = mesh.intrinsics;
        let coarse = fine.half();
        let mut depth_m = Vec::with_capacity(coarse.pixels());
        let mut luminance = Vec::with_capacity(coarse.pixels());
        let mut variance = Vec::with_capacity(coarse.pixels());
        for y in 0..coarse.height {
            for x in 0..coarse.width {
                let first = 2 * y * fine.width + 2 * x;
                let four = [first, first + 1, first + fine.width, first + fine.width + 1];
                depth_m.push(coarse_depth_m(four.map(|pixel| mesh.depth_m[pixel]), cut));
                let mut sums = (0.0, 0.0);
                for pixel in four {
                    let belief = records[pixel].unpack();
                    sums.0 += belief.tau[0];
                    sums.1 += belief.beta[0] / belief.alpha * (1.0 + belief.sigma[0]);
                }
                luminance.push(sums.0 / 4.0);
                variance.push(sums.1 / 4.0);
            }
        }
        Self {
            mesh: Mesh::new(coarse, depth_m, cut),
            luminance,
            variance,
        }
    }
}

/// Mean of the depths that are there; 0 where they are too few or not on one surface.
fn coarse_depth_m(four: [f32; 4], cut: f32) -> f32 {
    let (mut count, mut sum, mut low, mut high) = (0, 0.0, f32::INFINITY, 0.0f32);
    for z in four.into_iter().filter(|z| *z > 0.0) {
        count += 1;
        sum += z;
        (low, high) = (low.min(z), high.max(z));
    }
    if count >= COARSE_DEPTHS_MIN && high - low <= cut * low {
        sum / count as f32
    } else {
        0.0
    }
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
