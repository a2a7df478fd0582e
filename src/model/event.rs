//! Something surprising, or never seen, at one place of the world, followed over time and across cameras.

use std::sync::Arc;

use nalgebra::{Point3, Vector3};

use super::{
    frame::{RgbImage, Source},
    report::PixelBox,
};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// It looks different from what was expected.
    Change,
    /// No viewpoint knows it: nothing is expected there, so nothing can be surprising.
    Unseen,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EndReason {
    /// Its place was seen again and is as expected.
    SeenAgain,
    /// Too many others lasted; nobody had seen this one for longest.
    NoRoom,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum State {
    New,
    Update,
    End(EndReason),
}

/// One frame of one camera in which it was.
#[derive(Debug, Clone, PartialEq)]
pub struct Sighting {
    pub source: Source,
    pub stamp_ns: i64,
    pub sequence: u64,
    pub pixel_box: PixelBox,
    /// Of the evidence map, nats; 0 for what was never seen.
    pub surprise: f32,
}

/// What the box and its surroundings looked like, at most [`Picture::SIDE_MAX`] pixels a side.
#[derive(Debug, Clone, PartialEq)]
pub struct Picture {
    pub seen: RgbImage,
    /// What the memory expected there; `None` where it was not at hand.
    pub expected: Option<RgbImage>,
}

impl Picture {
    pub const SIDE_MAX: u32 = 160;
}

#[derive(Debug, Clone, PartialEq)]
pub struct Event {
    /// Unique in its place, also over restarts: microseconds of the first sighting's stamp, or more.
    pub id: u64,
    pub kind: Kind,
    pub state: State,
    /// Stamps of the robots that saw it, nanoseconds since the epoch.
    pub first_seen_ns: i64,
    pub last_seen_ns: i64,
    /// Stamp of the frame that ended it.
    pub ended_ns: Option<i64>,
    /// Metres; `None` where nothing of it has depth.
    pub center_in_world: Option<Point3<f64>>,
    /// Half sizes of the axis-parallel box around the centre, metres.
    pub extent_in_world: Vector3<f64>,
    /// Greatest evidence of its regions, nats.
    pub peak_surprise: f32,
    /// Greatest share of a frame that was never seen, 0..1.
    pub unseen_share: f32,
    /// Of what was never seen: points spread over what is still unknown of it, metres.
    pub unseen_points: Vec<Point3<f64>>,
    /// Frames in which it was surprising, or unseen.
    pub sightings: u32,
    /// Who saw it, in the order they did.
    pub robots: Vec<Arc<str>>,
    /// The most surprising sighting, of those that the image's border does not cut if there are any.
    pub peak: Sighting,
    pub last: Sighting,
    /// Of the peak.
    pub picture: Option<Arc<Picture>>,
}

impl Event {
    pub fn is_open(&self) -> bool {
        !matches!(self.state, State::End(_))
    }
}
