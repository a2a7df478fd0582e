//! Rigid poses in metres and radians, `f64`. Read right to left: `world_from_camera * point_in_camera`.
//! Camera axes: x right, y down, z forward (optical frame).

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion, Vector3};

pub type Pose = Isometry3<f64>;

/// How far a given quaternion may be from unit length: serialised `f32` poses stay well inside.
const UNIT_TOLERANCE: f64 = 1e-3;

/// How far a robot believes its pose may be off, standard deviation per axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseNoise {
    pub position_m: f64,
    pub rotation_rad: f64,
}

/// Pose from a position (metres) and a quaternion `[x, y, z, w]`; `None` if anything is not finite or the
/// quaternion's length is not 1 (to 0.001), in which case it carries no trustworthy rotation.
pub fn pose_from_parts(position: [f64; 3], quaternion_xyzw: [f64; 4]) -> Option<Pose> {
    if !position
        .iter()
        .chain(&quaternion_xyzw)
        .all(|value| value.is_finite())
    {
        return None;
    }
    let [x, y, z, w] = quaternion_xyzw;
    let quaternion = Quaternion::new(w, x, y, z);
    if (quaternion.norm() - 1.0).abs() > UNIT_TOLERANCE {
        return None;
    }
    let [x, y, z] = position;
    Some(Pose::from_parts(
        Translation3::new(x, y, z),
        UnitQuaternion::from_quaternion(quaternion),
    ))
}

/// Angle between the viewing directions (the optical axes) of two cameras, radians.
pub fn viewing_angle_rad(world_from_a: &Pose, world_from_b: &Pose) -> f64 {
    angle_rad(
        &viewing_direction(world_from_a),
        &viewing_direction(world_from_b),
    )
}

/// The optical axis of a camera, a unit vector in the world.
pub fn viewing_direction(world_from_camera: &Pose) -> Vector3<f64> {
    world_from_camera.rotation * Vector3::z()
}

/// Between two directions, radians.
pub fn angle_rad(a: &Vector3<f64>, b: &Vector3<f64>) -> f64 {
    // atan2 stays exact for small angles, where acos of the dot product does not.
    a.cross(b).norm().atan2(a.dot(b))
}

/// View distance D = |c_a - c_b| + `metres_per_radian` * angle of the viewing directions, metres.
pub fn view_distance_m(world_from_a: &Pose, world_from_b: &Pose, metres_per_radian: f64) -> f64 {
    (world_from_a.translation.vector - world_from_b.translation.vector).norm()
        + metres_per_radian * viewing_angle_rad(world_from_a, world_from_b)
}
