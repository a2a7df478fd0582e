//! The optical tracker on the ceiling: measures the plate's LEDs at 25 Hz, with noise, and not always all of them.

use nalgebra::Point3;

use super::{random::Stream, rig::Rig};
use crate::model::pose::Pose;

pub const TRACKER_HZ: f64 = 25.0;

/// One LED as the tracker reports it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Marker {
    /// Metres; without meaning if not visible.
    pub in_world: Point3<f64>,
    pub visible: bool,
}

impl Marker {
    pub fn tracked(&self) -> Option<Point3<f64>> {
        self.visible.then_some(self.in_world)
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tracker {
    /// Standard deviation per axis, metres.
    pub noise_m: f64,
    /// Share of the time that one LED is hidden; it then stays so for [`HIDDEN_SECS`].
    pub hidden: f64,
    /// Share of the samples without any LED.
    pub lost: f64,
    /// Share of the samples in which one LED is mistaken for a reflection some centimetres away.
    pub wrong: f64,
}

pub const HIDDEN_SECS: f64 = 0.4;

impl Default for Tracker {
    fn default() -> Self {
        Self {
            noise_m: 0.3e-3,
            hidden: 0.02,
            lost: 0.001,
            wrong: 0.002,
        }
    }
}

impl Tracker {
    /// What the tracker says at `time_secs`; `key` tells robots apart.
    pub fn observe(
        &self,
        rig: &Rig,
        world_from_camera: &Pose,
        time_secs: f64,
        seed: u64,
        key: u64,
    ) -> Vec<Marker> {
        let world_from_plate = world_from_camera * rig.camera_from_plate;
        let instant = (time_secs * 1e6).round() as i64 as u64;
        let mut stream = Stream::new(seed, &[key, instant]);
        let lost = stream.uniform() < self.lost;
        let wrong = (stream.uniform() < self.wrong)
            .then(|| stream.below(rig.marker_in_plate.len() as u64) as usize);
        let window = (time_secs / HIDDEN_SECS).floor() as i64 as u64;
        rig.marker_in_plate
            .iter()
            .enumerate()
            .map(|(index, in_plate)| {
                let hidden =
                    Stream::new(seed, &[key, window, index as u64]).uniform() < self.hidden;
                let mut in_world = world_from_plate * in_plate;
                for value in in_world.iter_mut() {
                    *value += self.noise_m * stream.normal();
                }
                if wrong == Some(index) {
                    for value in in_world.iter_mut() {
                        *value += 0.03 * stream.normal();
                    }
                }
                Marker {
                    in_world,
                    visible: !lost && !hidden,
                }
            })
            .collect()
    }
}
