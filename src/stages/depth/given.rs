//! Whether a depth map can be used, measured or computed (section III-C).
//!
//! Depth in metres -> the same with everything outside the settings' range taken as none, or why it is of no use: a wrong
//! unit shows as a map that is nearly all out of range.

use crate::{config::Settings, model::frame::FrameError};

/// Less depth than this share of the image is none: such a viewpoint could never be recalled.
const SHARE_MIN: f64 = 0.01;
/// When less of the depth than this lies in the settings' range, its unit must be wrong.
const IN_RANGE_MIN: f64 = 0.1;

/// Fills `checked`, metres, 0 = none.
///
/// # Errors
/// Depth of another size than the image, hardly any depth, and depth in another unit.
pub fn check(
    depth_m: &[f32],
    pixels: usize,
    settings: &Settings,
    checked: &mut Vec<f32>,
) -> Result<(), FrameError> {
    if depth_m.len() != pixels {
        return Err(FrameError::DepthSize {
            got: depth_m.len(),
            expected: pixels,
        });
    }
    let (min_m, max_m) = (settings.depth_min_m, settings.depth_max_m);
    let is_given = |z: f32| z.is_finite() & (z > 0.0);
    checked.resize(pixels, 0.0);
    let (mut given, mut valid) = (0u32, 0u32);
    for (checked, &z) in checked.iter_mut().zip(depth_m) {
        // NaN is in no range.
        let in_range = (z >= min_m) & (z <= max_m);
        given += u32::from(is_given(z));
        valid += u32::from(in_range);
        *checked = if in_range { z } else { 0.0 };
    }
    let share = f64::from(given) / pixels as f64;
    if share < SHARE_MIN {
        return Err(FrameError::NoDepth {
            valid_percent: 100.0 * share,
        });
    }
    let valid = f64::from(valid) / f64::from(given);
    if valid < IN_RANGE_MIN {
        let mut given: Vec<f32> = depth_m.iter().copied().filter(|&z| is_given(z)).collect();
        let middle = given.len() / 2;
        let (_, &mut median_m, _) = given.select_nth_unstable_by(middle, f32::total_cmp);
        return Err(FrameError::DepthUnit {
            valid_percent: 100.0 * valid,
            min_m,
            max_m,
            median_m,
        });
    }
    Ok(())
}
