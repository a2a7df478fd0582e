//! What a place's worker publishes about itself after everything it did; readers take the latest and lock nobody.

use std::{collections::BTreeMap, sync::Arc};

use serde::Serialize;

use super::inbox::SlotCounters;
use crate::{memory::store::StoreStatus, model::mode::Mode, wire::proto};

#[derive(Debug, Clone, Default, Serialize)]
pub struct PlaceStatus {
    pub place: String,
    pub frames: u64,
    pub refused: u64,
    /// In RAM.
    pub viewpoints: usize,
    pub memory_bytes: usize,
    pub memory_bytes_max: usize,
    /// Viewpoints forgotten because the memory was full.
    pub replaced_for_room: u64,
    /// Viewpoints that are known, in RAM or only stored.
    pub viewpoints_known: usize,
    /// Viewpoints that left RAM because others were needed there.
    pub evicted: u64,
    /// `None`: the memory ends with the service.
    pub store: Option<StoreStatus>,
    /// What cameras begin with.
    pub mode: Mode,
    pub asks_answered: u64,
    /// Passes of the engine that asks have taken.
    pub ask_passes: u64,
    /// Asks refused because the queue was full.
    pub asks_busy: u64,
    /// Asks whose askers had gone when their turn came.
    pub asks_abandoned: u64,
    pub cameras: Vec<CameraStatus>,
}

#[derive(Debug, Clone, Default, Serialize)]
pub struct CameraStatus {
    pub robot: String,
    pub camera: String,
    /// Its liveliness token is there.
    pub live: bool,
    pub mode: Mode,
    /// Processed.
    pub frames: u64,
    /// Missing in the robot's sequence although nothing here replaced them.
    pub frames_lost: u64,
    /// Got twice in pull mode.
    pub frames_repeated: u64,
    #[serde(flatten)]
    pub slot: SlotCounters,
    /// By code.
    pub refused: BTreeMap<&'static str, u64>,
    pub last_refusal: Option<String>,
    pub last_sequence: Option<u64>,
    pub last_stamp_ns: Option<i64>,
    pub processing_seconds: f64,
    pub max_surprise: f32,
    pub coverage: f32,
    pub regions: usize,
    #[serde(skip)]
    pub report: Option<Arc<proto::SurpriseReport>>,
}

impl CameraStatus {
    pub fn refusals(&self) -> u64 {
        self.refused.values().sum()
    }
}
