//! What a rig adds to a camera: the cameras beside it, the plate of markers above it, and where a tracker saw them.

use nalgebra::Point3;

use super::{POSITION_MAX_M, intrinsics, message, pose, required_stamp_ns};
use crate::{
    model::{
        camera::{Plate, RigCalibration, SideCalibration, SideCalibrations},
        frame::{MarkersInWorld, Source},
        pose::Pose,
        refusal::Refusal,
    },
    stages::localise::MIN_MARKERS,
    wire::{keys, proto},
};

/// The paper's plate has four.
const MARKERS_MAX: usize = 64;
/// Markers of one robot lie within this distance of their plate's origin.
const PLATE_MAX_M: f64 = 10.0;
/// Between the middle camera and one beside it: enough to see depth, and still one robot.
const BASELINE_M: (f64, f64) = (1e-4, 10.0);
/// Cameras turned farther apart see nothing in common.
const SIDE_TURN_MAX_RAD: f64 = 1.0;

/// # Errors
/// `calibration` without a middle camera, what [`intrinsics`] refuses, `side_calibration` and `plate` for senseless
/// or incomplete rigs.
pub fn calibration(calibration: &proto::Calibration) -> Result<RigCalibration, Refusal> {
    let middle = calibration.middle.as_ref().ok_or_else(|| {
        Refusal::new(
            "calibration",
            "the calibration has no `middle`: that is the camera whose images come as `image`",
        )
    })?;
    Ok(RigCalibration {
        middle: intrinsics(middle)?,
        sides: sides(calibration)?,
        plate: plate(calibration)?,
    })
}

/// What [`crate::wire::encode::camera_calibration`] made.
///
/// # Errors
/// As [`calibration`], and bytes that are no such message, or of nobody.
pub fn camera_calibration(bytes: &[u8]) -> Result<(Source, RigCalibration), Refusal> {
    let kept: proto::CameraCalibration = message(bytes)?;
    if !(keys::is_id(&kept.robot) && keys::is_id(&kept.camera)) {
        return Err(Refusal::new("calibration", "it is of no camera"));
    }
    let source = Source {
        robot: kept.robot.into(),
        camera: kept.camera.into(),
    };
    let calibration = calibration(&kept.calibration.unwrap_or_default())?;
    Ok((source, calibration))
}

fn sides(calibration: &proto::Calibration) -> Result<Option<SideCalibrations>, Refusal> {
    let proto::Calibration {
        left,
        right,
        middle_from_left,
        middle_from_right,
        ..
    } = calibration;
    match (left, right, middle_from_left, middle_from_right) {
        (None, None, None, None) => Ok(None),
        (Some(left), Some(right), Some(middle_from_left), Some(middle_from_right)) => {
            Ok(Some(SideCalibrations {
                left: side("left", left, middle_from_left)?,
                right: side("right", right, middle_from_right)?,
            }))
        }
        _ => Err(Refusal::new(
            "side_calibration",
            "the calibration has only some of `left`, `right`, `middle_from_left` and `middle_from_right`: give all four, or none",
        )),
    }
}

fn side(
    name: &str,
    camera: &proto::Intrinsics,
    middle_from_side: &proto::Pose,
) -> Result<SideCalibration, Refusal> {
    let middle_from_side = pose(middle_from_side)?;
    let baseline_m = middle_from_side.translation.vector.norm();
    let turn_rad = middle_from_side.rotation.angle();
    if !(BASELINE_M.0..=BASELINE_M.1).contains(&baseline_m) || turn_rad > SIDE_TURN_MAX_RAD {
        return Err(Refusal::new(
            "side_calibration",
            format!(
                "the {name} camera is {baseline_m:.4} m beside the middle one and turned by {turn_rad:.2} rad: depth can be had between {} and {} m and up to {SIDE_TURN_MAX_RAD} rad; positions count metres",
                BASELINE_M.0, BASELINE_M.1
            ),
        ));
    }
    Ok(SideCalibration {
        camera: intrinsics(camera)?,
        middle_from_side,
    })
}

fn plate(calibration: &proto::Calibration) -> Result<Option<Plate>, Refusal> {
    let markers = &calibration.marker_in_plate;
    let refusal = |detail: String| Err(Refusal::new("plate", detail));
    let camera_from_plate: Pose = match (&calibration.camera_from_plate, markers.len()) {
        (None, 0) => return Ok(None),
        (None, _) | (Some(_), 0) => {
            return refusal(
                "the calibration has only one of `marker_in_plate` and `camera_from_plate`: give both, or none".to_owned(),
            );
        }
        (Some(camera_from_plate), MIN_MARKERS..=MARKERS_MAX) => pose(camera_from_plate)?,
        (Some(_), count) => {
            return refusal(format!(
                "`marker_in_plate` has {count} markers: a plate has {MIN_MARKERS} to {MARKERS_MAX}"
            ));
        }
    };
    let marker_in_plate: Vec<Point3<f64>> = markers.iter().map(point).collect();
    // NaN is within no distance.
    if !marker_in_plate
        .iter()
        .all(|marker| marker.coords.norm() <= PLATE_MAX_M)
    {
        return refusal(format!(
            "a marker lies more than {PLATE_MAX_M} m from its plate's origin, or is not finite: positions count metres"
        ));
    }
    Ok(Some(Plate {
        marker_in_plate,
        camera_from_plate,
    }))
}

fn point(vector: &proto::Vector3) -> Point3<f64> {
    Point3::new(vector.x, vector.y, vector.z)
}

/// In the world, metres; `None` for what is not visible.
pub fn markers(markers: &proto::Markers) -> Result<MarkersInWorld, Refusal> {
    let refusal = |detail: String| Err(Refusal::new("markers", detail));
    if markers.markers.len() > MARKERS_MAX {
        return refusal(format!(
            "{} markers came, more than the {MARKERS_MAX} of any plate: send those of marker_in_plate, in its order",
            markers.markers.len()
        ));
    }
    let tracked: MarkersInWorld = markers
        .markers
        .iter()
        .filter(|marker| !marker.visible || marker.position.is_some())
        .map(|marker| {
            marker
                .position
                .as_ref()
                .filter(|_| marker.visible)
                .map(point)
        })
        .collect();
    // NaN is within no distance.
    let sane = tracked
        .iter()
        .flatten()
        .all(|marker| marker.coords.norm() <= POSITION_MAX_M);
    if !sane || tracked.len() < markers.markers.len() {
        return refusal(
            "a visible marker has no position, or one that is not finite or 10,000 km away: positions count metres; what is not seen is not visible".to_owned(),
        );
    }
    Ok(tracked)
}

/// In the calibration's order, metres; `None` where the tracker does not see the marker.
pub type MarkerPositions = Vec<Option<Point3<f64>>>;

/// Time and markers from the `markers` key.
///
/// # Errors
/// Undecodable bytes, no stamp, senseless markers.
pub fn markers_sample(bytes: &[u8]) -> Result<(i64, MarkerPositions), Refusal> {
    let sample: proto::Markers = message(bytes)?;
    let stamp_ns = required_stamp_ns(sample.stamp.as_ref())?;
    Ok((stamp_ns, markers(&sample)?))
}
