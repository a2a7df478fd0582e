//! Where was the camera when the frame was taken?
//!
//! Samples of `world_from_camera` with stamps (nanoseconds) -> the pose at a frame's stamp: linear in position, slerp in
//! rotation, between the samples on both sides. Never extrapolated: a pose that was guessed ahead misses by what
//! surprise is measured in.

use std::collections::VecDeque;

use super::stamp_order::{Order, StampOrder};
use crate::model::{pose::Pose, refusal::Refusal};

/// Two seconds of a 500 Hz tracker; frames are not older.
const SAMPLES_MAX: usize = 1024;
/// Between samples farther apart the camera may have been anywhere.
const GAP_MAX_NS: i64 = 1_000_000_000;
/// Between rotations farther apart than this there is no telling which way the camera turned.
const TURN_MAX_RAD: f64 = 170.0 * std::f64::consts::PI / 180.0;

/// The latest poses of one camera.
#[derive(Debug, Clone, Default)]
pub struct PoseTrack {
    order: StampOrder,
    samples: VecDeque<(i64, Pose)>,
}

/// What a track says about a stamp.
#[derive(Debug, Clone, PartialEq)]
pub enum TrackedPose {
    At(Pose),
    /// The sample after the stamp has not come yet.
    Later,
    /// No sample that is still to come can help.
    Never(Refusal),
}

impl PoseTrack {
    pub fn is_empty(&self) -> bool {
        self.samples.is_empty()
    }

    /// # Errors
    /// `stamp_order`: the sample goes back in time.
    pub fn push(&mut self, stamp_ns: i64, world_from_camera: Pose) -> Result<(), Refusal> {
        match self.order.judge(stamp_ns) {
            Order::Follows => {}
            Order::FollowsBeforeLeap(wild_ns) => {
                while self.samples.back().is_some_and(|last| last.0 >= wild_ns) {
                    self.samples.pop_back();
                }
            }
            Order::FollowsReset => self.samples.clear(),
            Order::GoesBack { last_ns } => return Err(goes_back("pose", stamp_ns, last_ns)),
        }
        self.order.accept(stamp_ns);
        if self.samples.len() == SAMPLES_MAX {
            self.samples.pop_front();
        }
        self.samples.push_back((stamp_ns, world_from_camera));
        Ok(())
    }

    pub fn at(&self, stamp_ns: i64) -> TrackedPose {
        let after = self.samples.partition_point(|sample| sample.0 < stamp_ns);
        let Some(&(after_ns, world_from_after)) = self.samples.get(after) else {
            return TrackedPose::Later;
        };
        if after_ns == stamp_ns {
            return TrackedPose::At(world_from_after);
        }
        let Some(&(before_ns, world_from_before)) = after
            .checked_sub(1)
            .and_then(|before| self.samples.get(before))
        else {
            return TrackedPose::Never(Refusal::new(
                "no_pose",
                format!(
                    "the frame was taken {:.3} s before the oldest pose sample: publish poses before frames",
                    seconds(after_ns.saturating_sub(stamp_ns))
                ),
            ));
        };
        let gap_ns = after_ns.saturating_sub(before_ns);
        if gap_ns > GAP_MAX_NS {
            return TrackedPose::Never(Refusal::new(
                "pose_gap",
                format!(
                    "the pose samples around the frame are {:.3} s apart, too far to interpolate: publish poses more often than once a second",
                    seconds(gap_ns)
                ),
            ));
        }
        if world_from_before
            .rotation
            .angle_to(&world_from_after.rotation)
            > TURN_MAX_RAD
        {
            return TrackedPose::Never(Refusal::new(
                "pose_gap",
                "the camera turned by half a circle between two pose samples: publish poses more often",
            ));
        }
        let share = (stamp_ns - before_ns) as f64 / gap_ns as f64;
        TrackedPose::At(Pose::from_parts(
            world_from_before
                .translation
                .vector
                .lerp(&world_from_after.translation.vector, share)
                .into(),
            world_from_before
                .rotation
                .slerp(&world_from_after.rotation, share),
        ))
    }
}

/// The refusal of a stamp that goes back.
pub fn goes_back(what: &str, stamp_ns: i64, last_ns: i64) -> Refusal {
    Refusal::new(
        "stamp_order",
        format!(
            "the {what}'s stamp is {:.6} s behind the last one: send in order of capture; a clock that was set back is followed from its third message",
            seconds(last_ns.saturating_sub(stamp_ns))
        ),
    )
}

fn seconds(ns: i64) -> f64 {
    ns as f64 * 1e-9
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use nalgebra::{Translation3, UnitQuaternion, Vector3};

    use super::*;

    const SECOND: i64 = 1_000_000_000;

    fn pose(x: f64, yaw: f64) -> Pose {
        Pose::from_parts(
            Translation3::new(x, 0.0, 0.0),
            UnitQuaternion::from_axis_angle(&Vector3::y_axis(), yaw),
        )
    }

    fn track(samples: &[(i64, f64, f64)]) -> PoseTrack {
        let mut track = PoseTrack::default();
        for &(stamp_ns, x, yaw) in samples {
            track.push(stamp_ns, pose(x, yaw)).expect("in order");
        }
        track
    }

    #[test]
    fn a_quarter_of_the_way_is_a_quarter_of_the_motion() {
        let track = track(&[(SECOND, 1.0, 0.0), (2 * SECOND, 3.0, 0.8)]);
        let TrackedPose::At(found) = track.at(SECOND + SECOND / 4) else {
            panic!("between two samples there is a pose");
        };
        assert!((found.translation.x - 1.5).abs() < 1e-12);
        assert!(found.rotation.angle_to(&pose(0.0, 0.2).rotation) < 1e-12);
    }

    #[test]
    fn beyond_the_newest_sample_it_waits_and_never_extrapolates() {
        let track = track(&[(SECOND, 1.0, 0.0), (2 * SECOND, 3.0, 0.0)]);
        assert_eq!(track.at(2 * SECOND + 1), TrackedPose::Later);
        assert_eq!(track.at(2 * SECOND), TrackedPose::At(pose(3.0, 0.0)));
    }

    #[test]
    fn before_the_oldest_sample_no_waiting_helps() {
        let track = track(&[(SECOND, 1.0, 0.0), (2 * SECOND, 3.0, 0.0)]);
        assert!(matches!(track.at(SECOND - 1), TrackedPose::Never(_)));
    }

    #[test]
    fn samples_far_apart_are_not_bridged() {
        let track = track(&[(SECOND, 1.0, 0.0), (9 * SECOND, 3.0, 0.0)]);
        let TrackedPose::Never(refusal) = track.at(5 * SECOND) else {
            panic!("eight seconds must not be bridged");
        };
        assert_eq!(refusal.code, "pose_gap");
    }

    #[test]
    fn half_a_turn_between_samples_is_refused() {
        let track = track(&[(0, 0.0, 0.0), (SECOND, 0.0, PI)]);
        assert!(matches!(track.at(SECOND / 2), TrackedPose::Never(_)));
    }

    #[test]
    fn a_wild_sample_is_forgotten_when_the_old_time_goes_on() {
        let mut track = track(&[(SECOND, 1.0, 0.0), (1_000 * SECOND, 99.0, 0.0)]);
        track
            .push(2 * SECOND, pose(3.0, 0.0))
            .expect("the old time goes on");
        let TrackedPose::At(found) = track.at(SECOND + SECOND / 2) else {
            panic!("the samples around the stamp are there");
        };
        assert_eq!(found.translation.x, 2.0);
    }

    #[test]
    fn a_reset_clock_forgets_the_old_samples() {
        let mut track = track(&[(1_000 * SECOND, 1.0, 0.0)]);
        for (stamp, refused) in [(1, true), (2, true), (3, false), (4, false)] {
            assert_eq!(track.push(stamp * SECOND, pose(0.0, 0.0)).is_err(), refused);
        }
        assert!(matches!(track.at(3 * SECOND + 5), TrackedPose::At(_)));
    }

    #[test]
    fn the_history_is_bounded() {
        let mut track = PoseTrack::default();
        for stamp in 0..10 * SAMPLES_MAX as i64 {
            track.push(stamp, pose(0.0, 0.0)).expect("in order");
        }
        assert_eq!(track.samples.len(), SAMPLES_MAX);
    }
}
