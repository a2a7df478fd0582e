//! Where a robot will be in a moment, if it goes on as it went: what it will need there can be loaded before.

use nalgebra::{Translation3, UnitQuaternion, Vector3};

use crate::model::pose::Pose;

/// Poses that lie farther apart in time say nothing about speed.
const STEP_MAX_S: f64 = 2.0;
/// What a robot turns in one step of looking ahead; wrong speeds would turn it round and round.
const TURN_MAX_RAD: f64 = 1.5;

/// A stamp (nanoseconds) and a pose.
pub type Passed = (i64, Pose);

/// The pose `ahead_s` seconds after `now`, of what moves on with constant velocities.
pub fn ahead(before: &Passed, now: &Passed, ahead_s: f64) -> Pose {
    let step_s = (now.0 - before.0) as f64 * 1e-9;
    if step_s <= 0.0 || step_s > STEP_MAX_S {
        return now.1;
    }
    let steps = ahead_s / step_s;
    let moved = now.1.translation.vector - before.1.translation.vector;
    let turned = (now.1.rotation * before.1.rotation.inverse()).scaled_axis() * steps;
    let turned: Vector3<f64> = turned.cap_magnitude(TURN_MAX_RAD);
    Pose::from_parts(
        Translation3::from(now.1.translation.vector + moved * steps),
        UnitQuaternion::from_scaled_axis(turned) * now.1.rotation,
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_robot_that_goes_on_as_it_went_is_where_it_was_said_to_be() {
        let at = |seconds: f64| {
            let pose = Pose::from_parts(
                Translation3::new(0.2 * seconds, 0.0, -0.1 * seconds),
                UnitQuaternion::from_scaled_axis(Vector3::new(0.0, 0.3 * seconds, 0.0)),
            );
            ((seconds * 1e9) as i64, pose)
        };
        let expected = at(1.6).1;
        let guessed = ahead(&at(0.5), &at(0.6), 1.0);
        assert!((guessed.translation.vector - expected.translation.vector).norm() < 1e-9);
        assert!(guessed.rotation.angle_to(&expected.rotation) < 1e-9);
        // One pose, or poses from another day, say nothing.
        assert_eq!(ahead(&at(0.6), &at(0.6), 1.0), at(0.6).1);
        assert_eq!(ahead(&at(0.6), &at(60.0), 1.0), at(60.0).1);
    }
}
