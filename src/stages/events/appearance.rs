//! What a region looked like, and whether it still does: a camera that learns may be surprised by a new thing in one
//! frame only, and so it is by a flicker. The next look tells them apart.

use nalgebra::Point3;

use super::{Look, in_image};
use crate::{
    config::Settings,
    model::report::Region,
    stages::{attend::BLOCK, interpolate::prior::Prior},
};

/// Blocks kept of a region.
const PATCHES_MAX: usize = 48;
/// Colours nearer than this tell nothing, grey levels.
const TELLING: f32 = 12.0;

/// A surprising block: where it is, how it was seen, and how it was expected.
#[derive(Debug, Clone)]
pub struct Patch {
    in_world: Point3<f64>,
    seen: [f32; 3],
    expected: [f32; 3],
}

/// The region's blocks with about as much evidence as made it one.
pub fn patches(look: &Look, prior: &Prior, region: &Region, settings: &Settings) -> Vec<Patch> {
    let (width, height) = (look.evidence.width, look.evidence.height);
    let blocks = |min: u32, max: u32, size: usize| {
        let end = (max as usize).div_ceil(BLOCK).min(size);
        (min as usize / BLOCK).min(end)..end
    };
    let pixels = region.pixel_box;
    let least = settings.region_fraction * region.peak_surprise;
    let found: Vec<Patch> = blocks(pixels.y_min, pixels.y_max, height)
        .flat_map(|y| blocks(pixels.x_min, pixels.x_max, width).map(move |x| (x, y)))
        .filter(|(x, y)| look.evidence.data[y * width + x] >= least)
        .filter_map(|(x, y)| {
            let (x, y) = (x * BLOCK, y * BLOCK);
            let (u, v) = (x + BLOCK / 2, y + BLOCK / 2);
            let z = look.scene.depth_m[v * look.scene.intrinsics.width + u];
            let in_camera = look
                .scene
                .intrinsics
                .unproject(u as f64, v as f64, z.into());
            let seen = mean(x, y, |x, y| look.rgb(x, y));
            let expected = mean(x, y, |x, y| prior.row(y).expected_rgb(x));
            (z > 0.0 && distance(seen, expected) > TELLING).then(|| Patch {
                in_world: look.scene.world_from_camera * in_camera,
                seen,
                expected,
            })
        })
        .collect();
    let stride = found.len().div_ceil(PATCHES_MAX).max(1);
    found.into_iter().step_by(stride).collect()
}

/// Whether most of what can be seen of it looks as it was seen rather than as it was expected; `None` if nothing can.
pub fn is_still_there(patches: &[Patch], look: &Look) -> Option<bool> {
    let votes: Vec<bool> = patches
        .iter()
        .filter_map(|patch| {
            let (u, v, _) = in_image(&patch.in_world, &look.scene, 0.0, BLOCK)?;
            let now = mean(u - BLOCK / 2, v - BLOCK / 2, |x, y| look.rgb(x, y));
            Some(distance(now, patch.seen) < distance(now, patch.expected))
        })
        .collect();
    let still = votes.iter().filter(|&&still| still).count();
    (!votes.is_empty()).then_some(2 * still > votes.len())
}

/// Over a block of pixels from here on.
fn mean(x: usize, y: usize, rgb: impl Fn(usize, usize) -> [u8; 3]) -> [f32; 3] {
    let mut sum = [0.0; 3];
    for index in 0..BLOCK * BLOCK {
        let pixel = rgb(x + index % BLOCK, y + index / BLOCK);
        for (sum, value) in sum.iter_mut().zip(pixel) {
            *sum += f32::from(value);
        }
    }
    sum.map(|sum| sum / (BLOCK * BLOCK) as f32)
}

fn distance(a: [f32; 3], b: [f32; 3]) -> f32 {
    let squares = a.iter().zip(b).map(|(a, b)| (a - b) * (a - b));
    squares.sum::<f32>().sqrt()
}
