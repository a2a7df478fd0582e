//! What a place's worker publishes about itself after everything it did; readers take the latest and lock nobody.

use std::{collections::BTreeMap, sync::Arc};

use serde::Serialize;
use utoipa::ToSchema;

use super::inbox::{InboxCounters, SlotCounters};
use crate::{
    engine::gpu::Counters,
    memory::store::StoreStatus,
    model::{camera::Intrinsics, mode::Mode},
    wire::proto,
};

#[derive(Debug, Clone, Default, Serialize)]
pub struct PlaceStatus {
    #[serde(flatten)]
    pub totals: PlaceTotals,
    pub cameras: Vec<CameraStatus>,
}

/// Of a place as a whole; counters never fall.
#[derive(Debug, Clone, Default, PartialEq, Serialize, ToSchema)]
pub struct PlaceTotals {
    pub place: String,
    /// Processed.
    pub frames: u64,
    /// Of these, compared with `views_busy` viewpoints, because others waited.
    pub frames_hurried: u64,
    /// Frames and what comes beside them.
    pub refused: u64,
    /// By code.
    #[schema(value_type = BTreeMap<String, u64>)]
    pub refused_by: BTreeMap<&'static str, u64>,
    /// Missing in the robots' sequences although nothing here replaced them.
    pub frames_lost: u64,
    #[serde(flatten)]
    pub inbox: InboxCounters,
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
    #[schema(value_type = Option<Object>)]
    pub store: Option<StoreStatus>,
    /// What cameras begin with.
    #[schema(value_type = String)]
    pub mode: Mode,
    pub asks_answered: u64,
    /// Passes of the engine that asks have taken.
    pub ask_passes: u64,
    /// Asks whose askers had gone when their turn came.
    pub asks_abandoned: u64,
    /// What computes: the processor, or the name of a graphics card.
    pub engine: String,
    /// Events that last.
    pub open_events: usize,
    #[serde(skip)]
    pub gpu: Option<Counters>,
}

#[derive(Debug, Clone, Default, PartialEq, Serialize, ToSchema)]
pub struct CameraStatus {
    pub robot: String,
    pub camera: String,
    /// Its liveliness token is there.
    pub live: bool,
    #[schema(value_type = String)]
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
    #[schema(value_type = BTreeMap<String, u64>)]
    pub refused: BTreeMap<&'static str, u64>,
    /// Code and sentence.
    pub last_refusal: Option<String>,
    pub last_sequence: Option<u64>,
    /// The robot's stamp, nanoseconds since the epoch.
    pub last_stamp_ns: Option<i64>,
    pub processing_seconds: f64,
    pub max_surprise: f32,
    pub coverage: f32,
    pub regions: usize,
    #[serde(skip)]
    pub intrinsics: Option<Intrinsics>,
    #[serde(skip)]
    pub report: Option<Arc<proto::SurpriseReport>>,
}
