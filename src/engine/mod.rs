//! Where interpolation and surprise are computed.

pub mod cpu;

pub mod gpu;

use std::sync::Arc;

use rayon::ThreadPool;

use crate::{
    config::{Evidence, Settings},
    isa::Isa,
    model::{
        belief::Record,
        camera::Intrinsics,
        frame::RgbImage,
        pose::Pose,
        viewpoint::{Coarse, Mesh, MeshCut, Viewpoint},
    },
    stages::{attend::BlockMap, interpolate::prior::Prior},
};

use self::{
    cpu::{CpuEngine, Observation, RecallView, Score},
    gpu::GpuEngine,
};

/// Which engine is asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, clap::ValueEnum)]
pub enum EngineKind {
    /// A graphics card if there is one, else the processor.
    #[default]
    Auto,
    Cpu,
    /// Any adapter, one in software too.
    Gpu,
}

#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum EngineError {
    #[error(
        "there is no graphics adapter here: install a Vulkan driver (in software: mesa-vulkan-drivers) or run with --engine cpu"
    )]
    NoAdapter,
    #[error("the graphics device was lost and cannot be replaced: {0}")]
    Lost(String),
}

/// An image, and the views that say what it should look like.
#[derive(Clone, Copy)]
pub struct Question<'a> {
    /// At most 16, with different ids.
    pub views: &'a [RecallView<'a>],
    pub intrinsics: &'a Intrinsics,
    pub world_from_camera: &'a Pose,
    pub image: &'a RgbImage,
    /// The image in luminance and chrominance.
    pub observation: &'a Observation,
}

/// Where the answer goes; memory that is there is used again.
pub struct Answer<'a> {
    pub prior: &'a mut Prior,
    pub score: &'a mut Score,
    /// What regions and thresholds look at, nats.
    pub evidence: &'a mut BlockMap,
    /// Working memory.
    pub blocks: &'a mut BlockMap,
}

/// What is known of every compared image, beside its evidence.
#[derive(Debug, Clone)]
pub struct Compared {
    /// Pixels that some viewpoint saw.
    pub seen: usize,
    /// Whether prior and score are whole; else [`Engine::maps`] completes them.
    pub maps_read: bool,
}

#[expect(clippy::large_enum_variant, reason = "a place has one")]
pub enum Engine {
    Cpu(CpuEngine),
    Gpu(Box<GpuEngine>),
}

impl Engine {
    /// `pool` may be shared among engines; each engine opens its own device.
    ///
    /// # Errors
    /// `Gpu` was asked for and there is none.
    pub fn new(
        kind: EngineKind,
        settings: &Settings,
        pool: Arc<ThreadPool>,
        isa: Isa,
    ) -> Result<Self, EngineError> {
        let gpu = |software_too| {
            GpuEngine::new(software_too, settings, Arc::clone(&pool), isa)
                .map(|engine| Self::Gpu(Box::new(engine)))
        };
        match kind {
            EngineKind::Gpu => gpu(true),
            EngineKind::Auto => match gpu(false) {
                Err(EngineError::Lost(reason)) => {
                    tracing::warn!(reason, "the graphics card cannot be used");
                    Ok(Self::Cpu(CpuEngine::new(settings, pool, isa)))
                }
                Err(EngineError::NoAdapter) => Ok(Self::Cpu(CpuEngine::new(settings, pool, isa))),
                Ok(engine) => Ok(engine),
            },
            EngineKind::Cpu => Ok(Self::Cpu(CpuEngine::new(settings, pool, isa))),
        }
    }

    /// Compares an image with what its views expect. `score` has the gain then, the surprise map wherever the evidence
    /// seeds a region, and the posterior if it is learnt; the rest when [`Compared::maps_read`] says so.
    ///
    /// # Errors
    /// The device was lost, cannot be replaced, and nothing else was allowed.
    pub fn compare(
        &mut self,
        question: &Question,
        evidence: Evidence,
        learn: bool,
        mut answer: Answer<'_>,
    ) -> Result<Compared, EngineError> {
        let gpu = match self {
            Self::Cpu(engine) => {
                return Ok(compare_on_processor(
                    engine,
                    question,
                    evidence,
                    &mut answer,
                ));
            }
            Self::Gpu(gpu) => gpu,
        };
        match gpu.compare(question, learn, &mut answer) {
            Err(error) if gpu.falls_back() => {
                tracing::error!(%error, "going on with the processor");
                *self = Self::Cpu(gpu.fallback());
                self.compare(question, evidence, learn, answer)
            }
            result => result,
        }
    }

    /// Takes an image apart into planes; memory that is there is used again.
    pub fn observe(&self, image: &RgbImage, observation: &mut Observation) {
        self.processor().observe(image, observation);
    }

    /// Makes what follows from a mesh's depth and its records when they are stored.
    pub fn prepare(
        &self,
        mesh: &mut Mesh,
        records: &[Record],
        coarse: Option<&mut Coarse>,
        cut: MeshCut,
    ) {
        self.processor().prepare(mesh, records, coarse, cut);
    }

    fn processor(&self) -> &CpuEngine {
        match self {
            Self::Cpu(engine) => engine,
            Self::Gpu(gpu) => gpu.processor(),
        }
    }

    /// Interpolates the beliefs at a pose from at most 16 views into `prior`.
    pub fn recall(
        &mut self,
        views: &[RecallView],
        intrinsics: &Intrinsics,
        world_from_camera: &Pose,
        prior: &mut Prior,
    ) {
        match self {
            Self::Cpu(engine) => engine.recall(views, intrinsics, world_from_camera, prior),
            Self::Gpu(gpu) => gpu.recall(views, intrinsics, world_from_camera, prior),
        }
    }

    /// Completes what was left where it was computed.
    ///
    /// # Errors
    /// It was lost with the device.
    pub fn maps(&self, prior: &mut Prior, score: &mut Score) -> Result<(), EngineError> {
        match self {
            Self::Cpu(_) => Ok(()),
            Self::Gpu(gpu) => gpu.maps(prior, score),
        }
    }

    /// Says that the posterior of the last frame has become this viewpoint.
    pub fn remember(&mut self, viewpoint: &Viewpoint) {
        if let Self::Gpu(gpu) = self {
            gpu.remember(viewpoint);
        }
    }

    /// What computes, for people.
    pub fn name(&self) -> &str {
        match self {
            Self::Cpu(_) => "processor",
            Self::Gpu(gpu) => gpu.adapter(),
        }
    }
}

fn compare_on_processor(
    engine: &CpuEngine,
    question: &Question,
    evidence: Evidence,
    answer: &mut Answer,
) -> Compared {
    let Answer {
        prior,
        score,
        evidence: found,
        blocks,
    } = answer;
    let seen = engine.compare(
        question.views,
        question.intrinsics,
        question.world_from_camera,
        question.observation,
        prior,
        score,
    );
    found.find(&score.surprise, prior.width, evidence, blocks);
    Compared {
        seen,
        maps_read: true,
    }
}
