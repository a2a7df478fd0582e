//! The thread that owns a place: its pipeline, its memory, and what is known about its cameras. It takes one frame at a
//! time, of the camera that waited longest for its turn, and works at asks in between, as [`super::turns`] says.
//!
//! ```text
//! frames ─┬─> memory     what is stored, and what holds of the modes
//! asks ───┘└> telling    status, events, news, pictures: what others may know
//! ```

mod asks;

mod frames;

mod memory;

mod telling;

mod writer;

use std::{collections::BTreeMap, sync::Arc, time::Duration};

use tokio::sync::{mpsc, watch};

use self::writer::Writer;
use super::{
    ask::Ask,
    camera::Camera,
    events::PlaceEvents,
    inbox::{Delivery, Inbox},
    live::News,
    metrics::{Metrics, Stopwatches},
    status::PlaceStatus,
    turns::{self, Hands, take_turns},
};
use crate::{
    memory::store::PlaceStore,
    model::{camera::RigCalibration, frame::Source, mode::Modes, pose::PoseNoise},
    pipeline::Pipeline,
    wire::{decode::Limits, keys::CameraPath},
};

/// How long a starting worker waits for what is stored of its place.
const READ_WITHIN: Duration = Duration::from_secs(3);
/// How long a closing worker waits until everything is stored.
const STORE_WITHIN: Duration = Duration::from_secs(2);

pub struct Worker {
    pub place: Arc<str>,
    pub root: Arc<str>,
    pub session: zenoh::Session,
    pub inbox: Arc<Inbox>,
    pub pipeline: Pipeline,
    /// Where the place's memory lasts.
    pub memory: Option<PlaceStore>,
    pub status: watch::Sender<Arc<PlaceStatus>>,
    pub events: watch::Sender<Arc<PlaceEvents>>,
    pub metrics: Arc<Metrics>,
    /// For whoever watches over HTTP.
    pub news: Option<mpsc::Sender<News>>,
    /// Asks a robot for its calibration; the answer comes through the inbox.
    pub ask_calibration: Box<dyn Fn(&CameraPath) + Send>,
}

/// What the loop keeps from turn to turn.
struct Desk {
    worker: Worker,
    limits: Limits,
    noise_default: PoseNoise,
    pose_wait: Duration,
    cameras: BTreeMap<Source, Camera>,
    /// Whose last frame the pipeline's maps are of.
    maps_of: Option<Source>,
    frames: u64,
    /// Of these, compared with less effort.
    frames_hurried: u64,
    /// Of cameras that made room for others, and what was refused.
    frames_lost_before: u64,
    refused_by: BTreeMap<&'static str, u64>,
    stopwatches: Stopwatches,
    /// What was said about modes; of a stored memory, what holds there.
    modes: Modes,
    /// The last of each camera, also of cameras that made room for others or have not come again since the start.
    calibrations: BTreeMap<Source, RigCalibration>,
    asks: AskCounters,
    /// While another service writes the place and frames are refused.
    writer: Option<Writer>,
}

#[derive(Debug, Default)]
struct AskCounters {
    answered: u64,
    passes: u64,
    abandoned: u64,
}

impl Worker {
    /// Until the inbox is closed.
    pub fn run(self) {
        let settings = self.pipeline.settings();
        let mut desk = Desk {
            limits: Limits::new(settings),
            noise_default: PoseNoise {
                position_m: settings.pose_position_sd_m,
                rotation_rad: settings.pose_rotation_sd_rad,
            },
            pose_wait: Duration::from_secs_f64(settings.pose_wait_s),
            cameras: BTreeMap::new(),
            maps_of: None,
            frames: 0,
            frames_hurried: 0,
            frames_lost_before: 0,
            refused_by: BTreeMap::new(),
            stopwatches: self.metrics.stopwatches(&self.place),
            modes: Modes::default(),
            calibrations: BTreeMap::new(),
            asks: AskCounters::default(),
            writer: None,
            worker: self,
        };
        if let Some(memory) = &desk.worker.memory {
            // Most stores answer at once; frames of the others are refused with the reason.
            memory.wait_read(READ_WITHIN);
        }
        desk.sync_memory();
        let inbox = desk.worker.inbox.clone();
        take_turns(&inbox, &mut desk);
        let Worker {
            memory, pipeline, ..
        } = &mut desk.worker;
        if let Some(memory) = memory {
            memory.close(pipeline.memory_mut(), STORE_WITHIN);
        }
    }
}

impl Hands for Desk {
    fn holds(&self, source: &Source) -> bool {
        let camera = self.cameras.get(source);
        camera.is_some_and(|camera| camera.waiting.is_some())
    }

    fn receive(&mut self, delivery: Delivery) {
        for (source, aside) in delivery.asides {
            self.aside(&source, aside);
        }
        for source in delivery.frames {
            self.receive_frame(&source);
        }
        self.sync_memory();
        self.fit_markers();
    }

    fn serve(&mut self, but: &[Source]) -> turns::Turn {
        self.serve_longest_waiting(but)
    }

    fn step(&mut self, ask: Ask) -> Option<Ask> {
        if ask.is_abandoned() {
            self.asks.abandoned += 1;
            return None;
        }
        let left = self.work_at(ask);
        self.asks.answered += u64::from(left.is_none());
        left
    }

    fn publish(&mut self) {
        self.publish_status();
    }
}
