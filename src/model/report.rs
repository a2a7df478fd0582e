//! What the service says about a frame.

use arrayvec::ArrayVec;
use nalgebra::Point3;

use super::{event::Event, frame::Source, pose::Pose, viewpoint::VIEWS_MAX};

/// Half-open: `x_min <= x < x_max`, pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PixelBox {
    pub x_min: u32,
    pub y_min: u32,
    pub x_max: u32,
    pub y_max: u32,
}

impl PixelBox {
    pub fn area(&self) -> u64 {
        u64::from(self.x_max.saturating_sub(self.x_min))
            * u64::from(self.y_max.saturating_sub(self.y_min))
    }

    /// Intersection over union; 0 for two empty boxes.
    pub fn iou(&self, other: &Self) -> f64 {
        let intersection = Self {
            x_min: self.x_min.max(other.x_min),
            y_min: self.y_min.max(other.y_min),
            x_max: self.x_max.min(other.x_max),
            y_max: self.y_max.min(other.y_max),
        }
        .area();
        let union = self.area() + other.area() - intersection;
        if union == 0 {
            0.0
        } else {
            intersection as f64 / union as f64
        }
    }
}

/// Connected surprising pixels.
#[derive(Debug, Clone, PartialEq)]
pub struct Region {
    /// Stays the same while the region is followed from frame to frame.
    pub id: u64,
    pub pixel_box: PixelBox,
    pub peak_x: u32,
    pub peak_y: u32,
    /// Of the evidence map, nats.
    pub peak_surprise: f32,
    /// Of the surprise map over the region's pixels, nats.
    pub mean_surprise: f32,
    /// Pixels.
    pub area: u32,
    /// Metres; `None` where the region has no depth.
    pub center_in_world: Option<Point3<f64>>,
    pub touches_border: bool,
    /// The event that it belongs to; 0 = none yet.
    pub event_id: u64,
}

/// One for every processed frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Report {
    pub source: Source,
    pub stamp_ns: i64,
    pub sequence: u64,
    pub width: usize,
    pub height: usize,
    /// As refined.
    pub world_from_camera: Pose,
    pub regions: Vec<Region>,
    /// Of the evidence map without its border strip, nats.
    pub max_surprise: f32,
    pub mean_surprise: f32,
    /// Share of the pixels that some viewpoint saw, 0..1.
    pub coverage: f32,
    /// What has changed about the place's events with this frame.
    pub events: Vec<Event>,
    pub learned: bool,
    /// The viewpoint that the frame became; `None` if it was not learnt.
    pub viewpoint_id: Option<u64>,
    pub viewpoints_used: ArrayVec<u64, VIEWS_MAX>,
    /// How far refinement moved the given pose.
    pub pose_correction_m: f64,
    pub pose_correction_rad: f64,
}
