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
        for (upper, lower) in depth_m
            .chunks_exact(width)
            .zip(depth_m.chunks_exact(width).skip(1))
        {
            for (upper, lower) in upper.windows(2).zip(lower.windows(2)) {
                let upper_left = joined(upper[0], upper[1], lower[0]);
                let lower_right = joined(lower[1], lower[0], upper[1]);
                mask.push(u8::from(upper_left) * UPPER_LEFT + u8::from(lower_right) * LOWER_RIGHT);
            }
        }
        let row_depth_m = depth_m
            .chunks_exact(width)
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
            + size_of_val(self.mesh.depth_m.as_slice())
            + size_of_val(self.mesh.cut.as_slice())
            + size_of_val(self.mesh.row_depth_m.as_slice())
    }
}
