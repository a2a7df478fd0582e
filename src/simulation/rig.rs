//! The robot's camera head (paper Fig. 3) and its drive along a circular arc around the table (paper Fig. 4).

use nalgebra::{Point3, Rotation3, Translation3, UnitQuaternion, Vector3};

use super::random::wander;
use crate::model::{
    camera::{Calibration, Intrinsics, Plate, RigCalibration, SideCalibration, SideCalibrations},
    pose::Pose,
};

/// Three cameras in a row and the marker plate above them; everything that a calibration tells.
#[derive(Debug, Clone, PartialEq)]
pub struct Rig {
    /// The same for left, middle and right; rectified.
    pub intrinsics: Intrinsics,
    pub middle_from_left: Pose,
    pub middle_from_right: Pose,
    /// Metres in the plate's frame: x right, y forward, z up, origin at the front-left LED. Order: front left, front
    /// right, rear right, rear left.
    pub marker_in_plate: Vec<Point3<f64>>,
    pub camera_from_plate: Pose,
}

impl Default for Rig {
    fn default() -> Self {
        let baseline = 0.06;
        let beside =
            |x: f64| Pose::from_parts(Translation3::new(x, 0.0, 0.0), UnitQuaternion::identity());
        let (width, depth) = (0.22, 0.16);
        Self {
            intrinsics: Intrinsics {
                width: 320,
                height: 240,
                fx: 262.5,
                fy: 262.5,
                cx: 159.5,
                cy: 119.5,
            },
            middle_from_left: beside(-baseline),
            middle_from_right: beside(baseline),
            marker_in_plate: vec![
                Point3::new(0.0, 0.0, 0.0),
                Point3::new(width, 0.0, 0.0),
                Point3::new(width, -depth, 0.0),
                Point3::new(0.0, -depth, 0.0),
            ],
            // The plate is level when the camera looks straight ahead: plate y is the optical axis, plate z is up.
            camera_from_plate: Pose::from_parts(
                Translation3::new(-0.11, -0.13, 0.03),
                UnitQuaternion::from_rotation_matrix(&Rotation3::from_axis_angle(
                    &Vector3::x_axis(),
                    std::f64::consts::FRAC_PI_2,
                )),
            ),
        }
    }
}

impl Rig {
    /// As the robot sends it.
    pub fn calibration(&self) -> RigCalibration {
        let camera = Calibration {
            intrinsics: self.intrinsics,
            distortion: None,
        };
        let side = |middle_from_side: Pose| SideCalibration {
            camera: camera.clone(),
            middle_from_side,
        };
        RigCalibration {
            sides: Some(SideCalibrations {
                left: side(self.middle_from_left),
                right: side(self.middle_from_right),
            }),
            plate: Some(Plate {
                marker_in_plate: self.marker_in_plate.clone(),
                camera_from_plate: self.camera_from_plate,
            }),
            middle: camera,
        }
    }
}

/// An arc around a point, looked at all the way.
#[derive(Debug, Clone, PartialEq)]
pub struct Arc {
    pub looked_at: Point3<f64>,
    pub radius_m: f64,
    /// Of the middle camera over what it looks at.
    pub height_m: f64,
    /// Angles of Q1 and Q2 about z, 0 in front (-y), positive to the right.
    pub from_rad: f64,
    pub to_rad: f64,
    /// How far the path strays from the circle, metres, and the gaze from the centre, radians.
    pub stray_m: f64,
    pub stray_rad: f64,
}

impl Arc {
    /// Pose of the middle camera after `odometer` passes (1.5: half way back). No two passes take the same path.
    pub fn world_from_camera(&self, odometer: f64, seed: u64, robot: u64) -> Pose {
        let pass = odometer.floor();
        let share = odometer - pass;
        let share = if pass.rem_euclid(2.0) == 0.0 {
            share
        } else {
            1.0 - share
        };
        let stray = |what: u64| {
            let key = robot * 16 + what;
            0.85 * wander(seed, key, odometer * 2.7) + 0.15 * wander(seed, key + 8, odometer * 17.0)
        };
        let angle = self.from_rad + (self.to_rad - self.from_rad) * share;
        let radius = self.radius_m + self.stray_m * stray(0);
        let height = self.height_m + self.stray_m * 0.6 * stray(1);
        let (sin, cos) = angle.sin_cos();
        let position = self.looked_at + Vector3::new(radius * sin, -radius * cos, height);
        let gaze = UnitQuaternion::from_scaled_axis(Vector3::new(
            self.stray_rad * stray(2),
            self.stray_rad * stray(3),
            self.stray_rad * 0.4 * stray(4),
        ));
        looking(position, self.looked_at) * gaze
    }
}

/// Pose of an upright camera at `position` that looks at `target`.
pub fn looking(position: Point3<f64>, target: Point3<f64>) -> Pose {
    let forward = (target - position).normalize();
    let right = forward.cross(&Vector3::z()).normalize();
    let down = forward.cross(&right);
    let rotation = Rotation3::from_basis_unchecked(&[right, down, forward]);
    Pose::from_parts(
        Translation3::from(position.coords),
        UnitQuaternion::from_rotation_matrix(&rotation),
    )
}

/// When the base drives and when it stands, in frames counted from 1 as in the paper.
#[derive(Debug, Clone, PartialEq)]
pub enum Drive {
    /// From when to when each pass is driven.
    Legs(Vec<(f64, f64)>),
    /// For ever to and fro.
    Endless { driving: f64, standing: f64 },
}

impl Drive {
    /// Passes driven until `frame`; its whole part counts finished ones.
    pub fn odometer(&self, frame: f64) -> f64 {
        match self {
            Self::Legs(legs) => legs
                .iter()
                .map(|&(start, end)| eased((frame - start) / (end - start)))
                .sum(),
            Self::Endless { driving, standing } => {
                let turn = ((frame - 1.0) / (driving + standing)).floor();
                let inside = frame - 1.0 - turn * (driving + standing);
                turn + eased(inside / driving)
            }
        }
    }

    /// Number of the pass that a frame belongs to; standing counts to the pass that follows.
    pub fn pass(&self, frame: f64) -> u64 {
        match self {
            Self::Legs(legs) => legs
                .iter()
                .position(|&(_, end)| frame < end)
                .unwrap_or(legs.len().saturating_sub(1)) as u64,
            Self::Endless { driving, standing } => {
                let turn = ((frame - 1.0) / (driving + standing)).floor();
                let inside = frame - 1.0 - turn * (driving + standing);
                turn as u64 + u64::from(inside >= *driving)
            }
        }
    }
}

/// From 0 to 1 at constant speed, but for the ramps at both ends.
fn eased(time: f64) -> f64 {
    const RAMP: f64 = 0.07;
    let time = time.clamp(0.0, 1.0);
    let speed = 1.0 / (1.0 - RAMP);
    if time < RAMP {
        speed * time * time / (2.0 * RAMP)
    } else if time > 1.0 - RAMP {
        1.0 - speed * (1.0 - time).powi(2) / (2.0 * RAMP)
    } else {
        speed * (time - RAMP * 0.5)
    }
}
