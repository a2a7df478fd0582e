//! The cameras that depth is computed from, and the depths that are tried.

use crate::model::{camera::Intrinsics, pose::Pose};

/// A camera beside the middle one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SideCamera {
    pub intrinsics: Intrinsics,
    pub side_from_middle: Pose,
}

/// Rectified (undistorted) cameras; without one of its sides it is a stereo pair.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DepthRig {
    pub middle: Intrinsics,
    pub left: Option<SideCamera>,
    pub right: Option<SideCamera>,
}

/// Hypotheses: `labels` inverse depths at equal distances.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InverseDepthRange {
    /// Of label 0, 1/m; 0 is infinitely far.
    pub far: f64,
    /// Of the last label, 1/m.
    pub near: f64,
    pub labels: usize,
}

impl InverseDepthRange {
    /// `None` unless 0 <= far < near, both finite, and 2 <= labels <= 255.
    pub fn new(far: f64, near: f64, labels: usize) -> Option<Self> {
        let ordered = far >= 0.0 && near > far && near.is_finite();
        (ordered && (2..=255).contains(&labels)).then_some(Self { far, near, labels })
    }

    /// 1/m from one label to the next.
    pub fn step(&self) -> f64 {
        (self.near - self.far) / (self.labels - 1) as f64
    }

    /// 1/m
    pub fn inverse_depth(&self, label: f64) -> f64 {
        self.far + label * self.step()
    }

    /// Fractional, not limited to the labels there are.
    pub fn label_of_depth(&self, depth_m: f64) -> f64 {
        (1.0 / depth_m - self.far) / self.step()
    }
}
