//! The pinhole camera. Pixel centres at integers (OpenCV, ROS).

use nalgebra::{Matrix3, Point3};

use super::pose::Pose;

/// Of a rectified image: `u = fx * x/z + cx`, pixels.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Intrinsics {
    pub width: usize,
    pub height: usize,
    pub fx: f64,
    pub fy: f64,
    pub cx: f64,
    pub cy: f64,
}

impl Intrinsics {
    pub fn pixels(&self) -> usize {
        self.width * self.height
    }

    /// Projection matrix K.
    pub fn matrix(&self) -> Matrix3<f64> {
        Matrix3::new(self.fx, 0.0, self.cx, 0.0, self.fy, self.cy, 0.0, 0.0, 1.0)
    }

    /// Point in the camera's frame, metres, of pixel `(u, v)` at depth `z_m`.
    pub fn unproject(&self, u: f64, v: f64, z_m: f64) -> Point3<f64> {
        Point3::new(
            (u - self.cx) / self.fx * z_m,
            (v - self.cy) / self.fy * z_m,
            z_m,
        )
    }

    /// Pixel of a point in the camera's frame; `None` behind the camera.
    pub fn project(&self, point_in_camera: &Point3<f64>) -> Option<(f64, f64)> {
        (point_in_camera.z > 0.0).then(|| {
            (
                self.fx * point_in_camera.x / point_in_camera.z + self.cx,
                self.fy * point_in_camera.y / point_in_camera.z + self.cy,
            )
        })
    }

    /// The camera whose pixels are means of 2x2 of this one's; an odd last row or column is left out.
    pub fn half(&self) -> Self {
        Self {
            width: self.width / 2,
            height: self.height / 2,
            fx: self.fx / 2.0,
            fy: self.fy / 2.0,
            // The centre of the first 2x2 block lies at 0.5.
            cx: (self.cx - 0.5) / 2.0,
            cy: (self.cy - 0.5) / 2.0,
        }
    }
}

/// Radial and tangential lens distortion, OpenCV's and ROS's `plumb_bob`.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PlumbBob {
    pub k1: f64,
    pub k2: f64,
    pub p1: f64,
    pub p2: f64,
    pub k3: f64,
}

/// What is fixed about one camera.
#[derive(Debug, Clone, PartialEq)]
pub struct Calibration {
    pub intrinsics: Intrinsics,
    /// `None`: the images are rectified.
    pub distortion: Option<PlumbBob>,
}

/// What is fixed about a camera of a robot: alone, or in the middle of a rig (the paper's Fig. 3).
#[derive(Debug, Clone, PartialEq)]
pub struct RigCalibration {
    /// Of the camera whose images are remembered.
    pub middle: Calibration,
    /// The cameras beside it, for depth.
    pub sides: Option<SideCalibrations>,
    /// The tracked plate above them, for poses.
    pub plate: Option<Plate>,
}

#[derive(Debug, Clone, PartialEq)]
pub struct SideCalibrations {
    pub left: SideCalibration,
    pub right: SideCalibration,
}

#[derive(Debug, Clone, PartialEq)]
pub struct SideCalibration {
    pub camera: Calibration,
    pub middle_from_side: Pose,
}

/// Markers that an optical tracker follows.
#[derive(Debug, Clone, PartialEq)]
pub struct Plate {
    /// Metres.
    pub marker_in_plate: Vec<Point3<f64>>,
    pub camera_from_plate: Pose,
}

impl From<Calibration> for RigCalibration {
    /// A camera alone.
    fn from(middle: Calibration) -> Self {
        Self {
            middle,
            sides: None,
            plate: None,
        }
    }
}
