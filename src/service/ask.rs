//! What others may ask a place's worker, between its frames.

use std::sync::Arc;

use tokio::sync::oneshot;

use crate::{
    model::{
        camera::Intrinsics,
        frame::{RgbImage, Source},
        pose::Pose,
        refusal::Refusal,
    },
    wire::{encode::PriorPlane, proto},
};

pub type Answer<T> = oneshot::Sender<Result<T, Refusal>>;

/// One question and where its answer goes. Nobody waits any more where the answer's other end is gone.
#[derive(Debug)]
pub enum Ask {
    Prior {
        world_from_camera: Pose,
        intrinsics: Intrinsics,
        planes: Vec<PriorPlane>,
        answer: Answer<proto::PriorReply>,
    },
    Evaluate {
        frame: Box<proto::Frame>,
        /// Whose calibration and visit to use; `None`: nobody's.
        camera: Option<Source>,
        answer: Answer<proto::EvaluateReply>,
    },
    Views {
        answer: Answer<proto::ViewsReply>,
    },
    Snapshot {
        camera: Source,
        answer: Answer<Arc<Snapshot>>,
    },
}

impl Ask {
    /// One word, for counting.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Prior { .. } => "prior",
            Self::Evaluate { .. } => "evaluate",
            Self::Views { .. } => "views",
            Self::Snapshot { .. } => "picture",
        }
    }
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
