//! A frame: what one camera saw at one instant.

use std::sync::Arc;

use nalgebra::Point3;

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

/// The luminance Y of JPEG 2000's and JPEG's colour transforms, rounded to whole grey levels.
pub fn luminance(rgb: [u8; 3]) -> u8 {
    let [r, g, b] = rgb.map(f32::from);
    // As `round` for all colours, without its call.
    (0.299 * r + 0.587 * g + 0.114 * b + 0.5) as u8
}

impl RgbImage {
    pub fn grey(&self) -> GreyImage {
        GreyImage {
            width: self.width,
            height: self.height,
            data: self
                .data
                .as_chunks()
                .0
                .iter()
                .map(|&rgb| luminance(rgb))
                .collect(),
        }
    }
}

/// Row by row, one byte a pixel: luminance.
#[derive(Debug, Clone, PartialEq)]
pub struct GreyImage {
    pub width: usize,
    pub height: usize,
    pub data: Vec<u8>,
}

/// Where a frame's depth comes from.
#[derive(Debug, Clone)]
pub enum DepthSource {
    /// Metres along the optical axis, as many as the image has pixels; 0 = none.
    Given(Vec<f32>),
    /// It is computed from what two more cameras saw.
    Sides(Box<Sides>),
}

impl DepthSource {
    /// `None` where it has yet to be computed.
    pub fn given_m(&self) -> Option<&[f32]> {
        match self {
            Self::Given(depth_m) => Some(depth_m),
            Self::Sides(_) => None,
        }
    }
}

/// What the cameras beside the middle one saw at the same instant.
#[derive(Debug, Clone)]
pub struct Sides {
    pub left: SideView,
    pub right: SideView,
}

/// Undistorted.
#[derive(Debug, Clone)]
pub struct SideView {
    pub image: GreyImage,
    pub intrinsics: Intrinsics,
    pub middle_from_side: Pose,
}

/// Where a tracker sees the markers of a plate, in its calibration's order: metres, world; `None` for what it does not
/// see.
pub type MarkersInWorld = Vec<Option<Point3<f64>>>;

/// What a rig of three cameras with a tracked plate sends: neither depth nor pose, but what both follow from.
#[derive(Debug, Clone)]
pub struct RigFrame {
    /// Capture time, nanoseconds since the epoch.
    pub stamp_ns: i64,
    pub sequence: u64,
    pub image: RgbImage,
    pub left: GreyImage,
    pub right: GreyImage,
    pub marker_in_world: MarkersInWorld,
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
    pub depth: DepthSource,
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
    #[error(
        "the {side} image has {got_width}x{got_height} pixels but its calibration says {width}x{height}: send the calibration of this rig"
    )]
    SideSize {
        side: &'static str,
        got_width: usize,
        got_height: usize,
        width: usize,
        height: usize,
    },
    #[error(
        "depth of {pixels} pixels with depth_labels = {labels} takes more memory than a place may use for it: send smaller images, or lower the setting until their product is at most {most}"
    )]
    DepthTooLarge {
        pixels: usize,
        labels: usize,
        most: usize,
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
            Self::SideSize { .. } => "side_size",
            Self::DepthTooLarge { .. } => "depth_too_large",
            Self::DepthSize { .. } => "depth_size",
            Self::NoDepth { .. } => "no_depth",
            Self::DepthUnit { .. } => "depth_unit",
            Self::Engine(_) => "engine",
        }
    }
}
