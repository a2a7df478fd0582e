//! How good the depth of a rectified rig is: the share of pixels whose disparity is wrong, as Scharstein and Szeliski
//! (2002) count it.

use crate::{
    model::{camera::Intrinsics, frame::luminance, pose::Pose},
    stages::depth::{
        DepthEstimator, DepthMap, DepthRig, DepthSettings, InverseDepthRange, SideCamera,
    },
};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Three images of a rectified rig with equal distances, and what is true.
pub struct StereoScene {
    pub width: usize,
    pub height: usize,
    pub left_y: Vec<u8>,
    pub middle_rgb: Vec<[u8; 3]>,
    pub right_y: Vec<u8>,
    /// Pixels between neighbouring cameras, of the middle image; 0 = not known.
    pub disparity: Vec<f32>,
}

#[derive(Debug, thiserror::Error)]
pub enum StereoError {
    #[error("cannot read {path}: {source}")]
    Read {
        path: PathBuf,
        source: image::ImageError,
    },
    #[error(
        "{path} has {got:?} pixels but middle.png {expected:?}: all images of a scene have one size"
    )]
    Size {
        path: PathBuf,
        got: (u32, u32),
        expected: (u32, u32),
    },
    #[error("{path} knows no disparity: all its pixels are 0")]
    NoTruth { path: PathBuf },
}

impl StereoScene {
    /// Reads `left.png`, `middle.png`, `right.png` and `disparity.png` (8 or 16 bit, value / 16 = pixels between
    /// neighbouring cameras with `x_left = x_middle + d` and `x_right = x_middle - d`, 0 = ignore).
    pub fn open(folder: &Path) -> Result<Self, StereoError> {
        let read = |name: &str| {
            let path = folder.join(name);
            match image::open(&path) {
                Ok(image) => Ok((path, image)),
                Err(source) => Err(StereoError::Read { path, source }),
            }
        };
        let (_, middle) = read("middle.png")?;
        let expected = (middle.width(), middle.height());
        let check = |(path, image): (PathBuf, image::DynamicImage)| {
            let got = (image.width(), image.height());
            if got == expected {
                Ok((path, image))
            } else {
                Err(StereoError::Size {
                    path,
                    got,
                    expected,
                })
            }
        };
        let (_, left) = check(read("left.png")?)?;
        let (_, right) = check(read("right.png")?)?;
        let (path, truth) = check(read("disparity.png")?)?;
        let disparity: Vec<f32> = match truth {
            image::DynamicImage::ImageLuma16(truth) => {
                truth.iter().map(|value| f32::from(*value) / 16.0).collect()
            }
            truth => truth
                .to_luma8()
                .iter()
                .map(|value| f32::from(*value) / 16.0)
                .collect(),
        };
        if disparity.iter().all(|disparity| *disparity == 0.0) {
            return Err(StereoError::NoTruth { path });
        }
        Ok(Self {
            width: expected.0 as usize,
            height: expected.1 as usize,
            left_y: grey(&left),
            middle_rgb: middle.to_rgb8().pixels().map(|pixel| pixel.0).collect(),
            right_y: grey(&right),
            disparity,
        })
    }

    /// From infinitely far, half a pixel a label: so many labels, or as many more as the nearest point takes.
    pub fn disparities(&self, labels: usize) -> InverseDepthRange {
        let most = self.disparity.iter().copied().fold(0.0, f32::max).ceil() as usize;
        let labels = labels.max(2 * most + 1).clamp(2, 255);
        InverseDepthRange::new(0.0, (labels - 1) as f64 / 2.0, labels)
            .expect("two labels or more, half a pixel apart")
    }

    /// A rig whose inverse depth in 1/m *is* the disparity in pixels: baseline 1 m, focal length 1 pixel.
    pub fn rig(&self, cameras: Cameras) -> DepthRig {
        let intrinsics = Intrinsics {
            width: self.width,
            height: self.height,
            fx: 1.0,
            fy: 1.0,
            cx: self.width as f64 / 2.0,
            cy: self.height as f64 / 2.0,
        };
        let side = |x: f64| SideCamera {
            intrinsics,
            side_from_middle: Pose::translation(x, 0.0, 0.0),
        };
        DepthRig {
            middle: intrinsics,
            left: (cameras == Cameras::Three).then(|| side(1.0)),
            right: Some(side(-1.0)),
        }
    }

    /// Depth as the pipeline computes it; its inverse depth is the disparity in pixels.
    pub fn estimate(
        &self,
        estimator: &mut DepthEstimator,
        cameras: Cameras,
        range: &InverseDepthRange,
    ) -> DepthMap {
        estimator
            .estimate(
                &self.rig(cameras),
                &self.middle_rgb,
                &self.left_y,
                &self.right_y,
                range,
                None,
            )
            .clone()
    }
}

fn grey(image: &image::DynamicImage) -> Vec<u8> {
    image
        .to_rgb8()
        .pixels()
        .map(|pixel| luminance(pixel.0))
        .collect()
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Cameras {
    /// Middle and right.
    Two,
    Three,
}

/// Shares of pixels, percent. All are over the dense labelling: a pixel without depth counts by its best guess, but
/// for `invalid`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct BadPixels {
    /// Wrong by more than one pixel between neighbouring cameras.
    pub bad_over_1px: f64,
    pub bad_over_half_px: f64,
    /// By more than one pixel, where the truth jumps within 4 pixels.
    pub near_discontinuities: f64,
    /// By more than one pixel, where the truth hides the pixel from one side or puts it outside that image.
    pub half_occluded: f64,
    /// By more than one pixel, of those that are given a depth.
    pub bad_of_valid: f64,
    /// Given no depth.
    pub invalid: f64,
    /// Mean error of pixels that are not wrong by more than one, pixels.
    pub mean_error_px: f64,
}

/// `disparity` is the dense guess, pixels, `valid` whether it is stood by.
pub fn bad_pixels(scene: &StereoScene, disparity: &[f32], valid: &[bool]) -> BadPixels {
    let StereoScene {
        width,
        height,
        disparity: truth,
        ..
    } = scene;
    let discontinuous = near_discontinuities(truth, *width, *height);
    let occluded = half_occluded(truth, *width);
    let known: Vec<usize> = (0..truth.len()).filter(|i| truth[*i] > 0.0).collect();
    let error = |i: &usize| (disparity[*i] - truth[*i]).abs();
    let share = |of: &dyn Fn(&usize) -> bool, bad: &dyn Fn(&usize) -> bool| {
        let of: Vec<&usize> = known.iter().filter(|i| of(i)).collect();
        100.0 * of.iter().filter(|i| bad(i)).count() as f64 / of.len().max(1) as f64
    };
    let bad = |i: &usize| error(i) > 1.0;
    let good: Vec<f64> = known
        .iter()
        .filter(|i| !bad(i))
        .map(|i| f64::from(error(i)))
        .collect();
    BadPixels {
        bad_over_1px: share(&|_| true, &bad),
        bad_over_half_px: share(&|_| true, &|i| error(i) > 0.5),
        near_discontinuities: share(&|i| discontinuous[*i], &bad),
        half_occluded: share(&|i| occluded[*i], &bad),
        bad_of_valid: share(&|i| valid[*i], &bad),
        invalid: share(&|_| true, &|i| !valid[*i]),
        mean_error_px: good.iter().sum::<f64>() / good.len().max(1) as f64,
    }
}

/// Pixels with a jump of more than one pixel of disparity within 4 pixels.
fn near_discontinuities(truth: &[f32], width: usize, height: usize) -> Vec<bool> {
    const REACH: usize = 4;
    let jump = |a: f32, b: f32| a > 0.0 && b > 0.0 && (a - b).abs() > 1.0;
    let mut near = vec![false; truth.len()];
    for y in 0..height {
        for x in 0..width {
            let at = y * width + x;
            let right = x + 1 < width && jump(truth[at], truth[at + 1]);
            let below = y + 1 < height && jump(truth[at], truth[at + width]);
            if right || below {
                for y in y.saturating_sub(REACH)..(y + REACH + 1).min(height) {
                    let row = y * width;
                    near[row + x.saturating_sub(REACH)..row + (x + REACH + 1).min(width)]
                        .fill(true);
                }
            }
        }
    }
    near
}

/// Pixels that the truth hides from the left or the right camera, or puts beyond its image.
fn half_occluded(truth: &[f32], width: usize) -> Vec<bool> {
    let mut hidden = vec![false; truth.len()];
    for (truth, hidden) in truth
        .chunks_exact(width)
        .zip(hidden.chunks_exact_mut(width))
    {
        for sign in [1.0, -1.0] {
            let place = |x: usize| {
                let place = (x as f32 + sign * truth[x]).round();
                (place >= 0.0 && place < width as f32).then_some(place as usize)
            };
            let mut nearest = vec![0.0_f32; width];
            for (x, truth) in truth.iter().enumerate() {
                if let Some(place) = place(x) {
                    nearest[place] = nearest[place].max(*truth);
                }
            }
            for x in (0..width).filter(|x| truth[*x] > 0.0) {
                hidden[x] |= place(x).is_none_or(|place| nearest[place] > truth[x] + 1.0);
            }
        }
    }
    hidden
}

/// Estimates the scene's depth and counts what is wrong. `range` is in pixels of disparity.
pub fn evaluate(
    scene: &StereoScene,
    settings: DepthSettings,
    cameras: Cameras,
    range: &InverseDepthRange,
) -> BadPixels {
    let map = scene.estimate(&mut DepthEstimator::new(settings), cameras, range);
    let valid: Vec<bool> = map.depth_m.iter().map(|depth_m| *depth_m > 0.0).collect();
    bad_pixels(scene, &map.inverse_depth, &valid)
}
