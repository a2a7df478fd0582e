//! A frame: what one camera saw at one instant.

use std::sync::Arc;

use super::{
    camera::Intrinsics,
    pose::{Pose, PoseNoise},
};

/// Which camera of which robot; ids are `[a-z0-9_-]+`.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Source {
    pub robot: Arc<str>,
    pub camera: Arc<str>,
}

/// Row by row, three bytes a pixel.
#[derive(Debug, Clone, PartialEq)]
pub struct RgbImage {
    pub width: usize,
    pub height: usize,
    pub data: Vec<u8>,
}

/// Decoded, checked and undistorted; image and depth have the size that `intrinsics` says.
#[derive(Debug, Clone)]
pub struct Frame {
    pub source: Source,
    /// Capture time, nanoseconds since the epoch.
    pub stamp_ns: i64,
    /// The robot's own count of its frames.
    pub sequence: u64,
    pub image: RgbImage,
    /// Metres along the optical axis; 0 = none.
    pub depth_m: Vec<f32>,
    pub intrinsics: Intrinsics,
    pub world_from_camera: Pose,
    /// `None`: as the settings say.
    pub pose_noise: Option<PoseNoise>,
}

/// Why a frame cannot be used although it could be decoded.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum FrameError {
    #[error(
        "the image has {image_width}x{image_height} pixels but the calibration says {width}x{height}: send the calibration of this stream"
    )]
    ImageSize {
        image_width: usize,
        image_height: usize,
        width: usize,
        height: usize,
    },
    #[error("the depth has {got} pixels but the image {expected}: register the depth to the image")]
    DepthSize { got: usize, expected: usize },
    #[error(
        "only {valid_percent:.2} % of the pixels have depth: nothing could be remembered; is the depth camera covered or off?"
    )]
    NoDepth { valid_percent: f64 },
    #[error(
        "only {valid_percent:.1} % of the depth is between {min_m} m and {max_m} m (median of what is there: {median_m:.4} m): is its unit right? 16UC1 counts millimetres, 32FC1 metres"
    )]
    DepthUnit {
        valid_percent: f64,
        min_m: f32,
        max_m: f32,
        median_m: f32,
    },
    #[error("the frame could not be computed: {0}")]
    Engine(String),
}

impl FrameError {
    /// One word for programs, as in `Rejection.code`.
    pub fn code(&self) -> &'static str {
        match self {
            Self::ImageSize { .. } => "image_size",
            Self::DepthSize { .. } => "depth_size",
            Self::NoDepth { .. } => "no_depth",
            Self::DepthUnit { .. } => "depth_unit",
            Self::Engine(_) => "engine",
        }
    }
}
