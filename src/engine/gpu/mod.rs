//! The engine on a graphics card: the stages in WGSL (`shaders/`), a twin for each, in two lists of passes a frame.
//!
//! Viewpoints stay on the device while there is room; the posterior becomes a viewpoint there without a journey. The
//! processor keeps every viewpoint too, so a lost device loses nothing that was reported. One frame of a place is in
//! flight: its report is awaited, because the next frame's prior depends on what is learnt. The device and its pipelines
//! are those of all places.
//!
//! One submission and one read-back a frame: the refined pose is judged on the device, which places the views by it. The
//! image goes up once. Where something surprises, its map is read as well.
//!
//! Passes a frame, whatever the number of views: 14. Refinement has 6: project coarse depth, project coarse triangle,
//! expect, halve (3 dispatches), refine (54: depths and begin, twice accumulate and judge, and magnitudes, accumulate
//! and step four times on each of four levels; coarse ones that the pose's noise does not call for do nothing), and place.
//! The comparison has 8: project depth, project triangle, merge, expose, gain, score, block means, and block medians where
//! the evidence is their median. Bytes a frame of P pixels, V views of P pixels:
//!
//! | over the bus | bytes | 320x240 |
//! |---|---|---|
//! | up: image; depth, coarse depth and luminance of what is learnt | 3 P + 7 P | 0.77 MB |
//! | up: a view that is not resident | 39 P | 3.0 MB |
//! | up: poses, sizes, levels | < 3 kB | 3 kB |
//! | down: evidence, exposure, refined pose, time stamps | P / 4 + 384 | 20 kB |
//! | down, if it is learnt: the posterior | 32 P | 2.46 MB |
//! | down, if something surprises: the map | 4 P | 0.31 MB |
//! | down, if somebody wants the maps | 100 P | 7.7 MB |
//!
//! | within the device | bytes |
//! |---|---|
//! | clear, draw and read the maps: 2 x 4 B cleared, written and read; the depth read three times | 36 V P |
//! | gather: each record once, if neighbours share the cache | 32 V P |
//! | the prior written, then read by expose (32 B) and score (64 B, neighbours from the cache) | 160 P |
//! | image read twice, surprise and posterior written, surprise read, posterior copied | 110 P |
//! | refinement: the maps of three views of P / 4 pixels, luminance and variance gathered | 33 P |
//! | the image read, the pyramid written, read by halve and depths | 18 P |
//! | the pyramid read twice a step, neighbours from the cache: 16 B, 4 steps, P / 3 pixels, and by the judges | 51 P |
//!
//! A model, not a measurement: with V = 7 that is 848 P, 65 MB at 320x240 and 260 MB at 640x480. A card of 400 GB/s that
//! reaches half of it needs 0.3 ms and 1.3 ms, and 0.3 ms beside if each of the 69 dispatches waits 5 us for the one
//! before; a bus of 12 GB/s adds 0.27 ms and 1.1 ms where everything is learnt.

mod arenas;

mod buffers;

pub mod card;

mod device;

mod frame;

pub mod layout;

pub mod passes;

mod recording;

mod refine;

pub mod residency;

use std::sync::Arc;

use self::{
    card::Card,
    frame::{Failure, State, Wanted},
    layout::Rules,
};
use super::{
    Answer, Compared, EngineError, Question, compare_on_processor,
    cpu::{CpuEngine, RecallView, Score},
};
use crate::{
    config::Settings,
    isa::Isa,
    model::{camera::Intrinsics, pose::Pose, viewpoint::Viewpoint},
    pool::Pool,
    stages::interpolate::prior::Prior,
};

/// What was moved and done, since the engine was made.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Counters {
    pub frames: u64,
    /// Frames and recalls that the processor did because the device could not.
    pub on_processor: u64,
    pub passes: u64,
    pub uploaded_bytes: u64,
    /// Times that a frame waited for the device.
    pub read_backs: u64,
    /// For reports and priors; not the maps that somebody wanted.
    pub read_back_bytes: u64,
    /// Viewpoints that had to be uploaded, and that had to make room.
    pub views_brought: u64,
    pub evicted: u64,
    pub resident_bytes: u64,
    /// Devices that were lost and replaced.
    pub losses: u64,
    /// Of the last frame, where the device can tell.
    pub pass_seconds: Vec<(&'static str, f64)>,
}

pub struct GpuEngine {
    settings: Settings,
    rules: Rules,
    card: Arc<Card>,
    state: State,
    /// For what does not fit the device.
    processor: CpuEngine,
    pool: Pool,
    isa: Isa,
    counters: Counters,
}

impl GpuEngine {
    pub(super) fn new(card: &Arc<Card>, settings: &Settings, pool: Pool, isa: Isa) -> Self {
        let rules = Rules::new(settings);
        Self {
            state: State::new(card.device(), &rules, settings.views, card.share()),
            settings: settings.clone(),
            card: Arc::clone(card),
            rules,
            processor: CpuEngine::new(settings, pool.clone(), isa),
            pool,
            isa,
            counters: Counters::default(),
        }
    }

    /// Name and kind of the adapter.
    pub fn adapter(&self) -> &str {
        &self.state.device.adapter
    }

    pub fn counters(&self) -> &Counters {
        &self.counters
    }

    /// Whether another engine should take over when the device cannot be replaced.
    pub(super) fn falls_back(&self) -> bool {
        self.card.falls_back()
    }

    pub(super) fn processor(&self) -> &CpuEngine {
        &self.processor
    }

    /// The engine that takes over.
    pub(super) fn fallback(&self) -> CpuEngine {
        CpuEngine::new(&self.settings, self.pool.clone(), self.isa)
    }

    pub(super) fn compare(
        &mut self,
        question: &Question,
        learn: bool,
        answer: &mut Answer,
    ) -> Result<Compared, EngineError> {
        let wanted = Wanted {
            noise: question.noise,
            evidence: self.settings.evidence,
            posterior: learn,
            surprise_from: (self.settings.border_px, self.settings.surprise_threshold),
        };
        self.counters.frames += 1;
        let report = self.persevere(|state, counters| {
            state.compare(
                question.views,
                question.intrinsics,
                question.world_from_camera,
                question.image,
                wanted,
                answer.score,
                counters,
            )
        })?;
        let Some(report) = report else {
            self.counters.on_processor += 1;
            let evidence = self.settings.evidence;
            return Ok(compare_on_processor(
                &self.processor,
                question,
                evidence,
                answer,
                &mut || {},
            ));
        };
        *answer.evidence = report.evidence;
        Ok(Compared {
            refined: report.refined,
            seen: report.seen,
            maps_read: false,
        })
    }

    pub(super) fn recall(
        &mut self,
        views: &[RecallView],
        intrinsics: &Intrinsics,
        world_from_camera: &Pose,
        prior: &mut Prior,
    ) {
        let done = self.persevere(|state, counters| {
            state.recall(views, intrinsics, world_from_camera, prior, counters)
        });
        // Whoever asks for a prior gets one, with or without a device.
        if !matches!(done, Ok(Some(()))) {
            self.counters.on_processor += 1;
            self.processor
                .recall(views, intrinsics, world_from_camera, prior);
        }
    }

    pub(super) fn maps(&self, prior: &mut Prior, score: &mut Score) -> Result<(), EngineError> {
        self.state
            .maps(prior, score)
            .map_err(|failure| match failure {
                Failure::Lost(lost) => EngineError::Lost(lost.0),
                Failure::TooLarge => unreachable!("maps that were computed fit"),
            })
    }

    pub(super) fn remember(&mut self, viewpoint: &Viewpoint) {
        self.state.remember(viewpoint, &mut self.counters);
    }

    pub(super) fn forget(&mut self) {
        self.state.forget();
    }

    /// Tries on this device and, if it is lost, on the next; `None`: what was asked does not fit.
    fn persevere<T>(
        &mut self,
        mut attempt: impl FnMut(&mut State, &mut Counters) -> Result<T, Failure>,
    ) -> Result<Option<T>, EngineError> {
        let lost = match attempt(&mut self.state, &mut self.counters) {
            Ok(done) => return Ok(Some(done)),
            Err(Failure::TooLarge) => return Ok(None),
            Err(Failure::Lost(lost)) => lost,
        };
        self.counters.losses += 1;
        tracing::warn!(
            adapter = self.adapter(),
            reason = lost.0,
            "the device was lost; opening another"
        );
        let device = self.card.replace(&self.state.device);
        let device = device.map_err(|_| EngineError::Lost(lost.0))?;
        self.state = State::new(device, &self.rules, self.settings.views, self.card.share());
        match attempt(&mut self.state, &mut self.counters) {
            Ok(done) => Ok(Some(done)),
            Err(Failure::TooLarge) => Ok(None),
            Err(Failure::Lost(lost)) => Err(EngineError::Lost(lost.0)),
        }
    }
}
