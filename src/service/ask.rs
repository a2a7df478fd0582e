//! What others may ask a place's worker, between its frames. A step of any ask takes one pass of the engine at most.

use std::{sync::Arc, time::Instant};

use tokio::sync::oneshot;

use crate::{
    memory::forget::Forgetting,
    model::{
        camera::Intrinsics,
        frame::{RgbImage, Source},
        mode::Mode,
        pose::Pose,
        refusal::Refusal,
        report::Report,
    },
    stages::next_view::Promise,
    wire::{
        decode::questions::NextView,
        encode::{PriorPlane, PriorPlanes},
        proto,
    },
};

pub type Answer<T> = oneshot::Sender<Result<T, Refusal>>;

/// One question and where its answer goes. Nobody waits any more where the answer's other end is gone.
#[derive(Debug)]
pub enum Ask {
    Prior {
        world_from_camera: Pose,
        intrinsics: Intrinsics,
        planes: Vec<PriorPlane>,
        /// Since when it waits for stored viewpoints.
        brought_since: Option<Instant>,
        answer: Answer<PriorPlanes>,
    },
    Evaluate {
        frame: Box<proto::Frame>,
        /// Whose calibration and visit to use; `None`: nobody's.
        camera: Option<Source>,
        brought_since: Option<Instant>,
        answer: Answer<Evaluated>,
    },
    Views {
        /// Those with greater ids.
        after: u64,
        limit: usize,
        answer: Answer<proto::ViewsReply>,
    },
    Snapshot {
        camera: Source,
        answer: Answer<Arc<Snapshot>>,
    },
    NextView {
        question: NextView,
        /// The ring's.
        camera: Option<Source>,
        answer: Answer<proto::NextViewReply>,
    },
    /// Some of the candidates are judged already, each with the memory of its moment.
    Ranking {
        candidates: Vec<Pose>,
        intrinsics: Intrinsics,
        promises: Vec<Promise>,
        brought_since: Option<Instant>,
        answer: Answer<proto::NextViewReply>,
    },
    /// Goes on to its end even if nobody waits for it.
    Forget {
        forgetting: Box<Forgetting>,
        answer: Answer<proto::ForgetReply>,
    },
    /// Of a camera, or of the place: then of every camera in it.
    Mode {
        camera: Option<Source>,
        set: Option<Mode>,
        answer: Answer<Mode>,
    },
}

impl Ask {
    /// Nobody waits for it and nothing depends on it.
    pub fn is_abandoned(&self) -> bool {
        match self {
            Self::Prior { answer, .. } => answer.is_closed(),
            Self::Evaluate { answer, .. } => answer.is_closed(),
            Self::Views { answer, .. } => answer.is_closed(),
            Self::Snapshot { answer, .. } => answer.is_closed(),
            Self::NextView { answer, .. } | Self::Ranking { answer, .. } => answer.is_closed(),
            Self::Forget { .. } => false,
            Self::Mode { set, answer, .. } => set.is_none() && answer.is_closed(),
        }
    }
}

impl Ask {
    /// Refuses what cannot be answered before the stored memory has been read; else the ask itself.
    pub fn refused_unread(self, refusal: Refusal) -> Option<Self> {
        match self {
            Self::Prior { answer, .. } => drop(answer.send(Err(refusal))),
            Self::Evaluate { answer, .. } => drop(answer.send(Err(refusal))),
            Self::Views { answer, .. } => drop(answer.send(Err(refusal))),
            Self::NextView { answer, .. } | Self::Ranking { answer, .. } => {
                drop(answer.send(Err(refusal)));
            }
            Self::Forget { answer, .. } => drop(answer.send(Err(refusal))),
            Self::Mode {
                set: None, answer, ..
            } => drop(answer.send(Err(refusal))),
            // What is said about a mode is kept until it can be stored; pictures are of frames that came before.
            Self::Mode { set: Some(_), .. } | Self::Snapshot { .. } => return Some(self),
        }
        None
    }
}

/// What a frame would have been, had it come.
#[derive(Debug)]
pub struct Evaluated {
    pub report: Report,
    pub processing_seconds: f64,
    /// Nats a pixel.
    pub surprise: Vec<f32>,
}

/// What a camera saw last and what was thought of it, for people to look at.
#[derive(Debug)]
pub struct Snapshot {
    pub report: Arc<proto::SurpriseReport>,
    pub frame: Arc<RgbImage>,
    pub expected: RgbImage,
    /// Nats a pixel.
    pub surprise: Vec<f32>,
    /// Squared grey levels a pixel.
    pub uncertainty: Vec<f32>,
}
