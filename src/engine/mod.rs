//! Where interpolation and surprise are computed.

pub mod cpu;

pub mod gpu;

use std::sync::Arc;

use crate::{
    config::{Evidence, Settings},
    isa::Isa,
    model::{
        belief::Record,
        camera::Intrinsics,
        frame::RgbImage,
        pose::{Pose, PoseNoise},
        viewpoint::{Coarse, Mesh, MeshCut, Viewpoint},
    },
    pool::Pool,
    stages::{
        attend::BlockMap,
        interpolate::prior::Prior,
        refine::{PoseRefiner, REFINE_VIEWS, Refined},
    },
};
use arrayvec::ArrayVec;

use self::{
    cpu::{CpuEngine, Observation, RecallView, Score},
    gpu::{
        GpuEngine,
        card::{Card, CardRules},
    },
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
    /// At most 16, with different ids, nearest first.
    pub views: &'a [RecallView<'a>],
    pub intrinsics: &'a Intrinsics,
    pub world_from_camera: &'a Pose,
    /// Of the pose, where it is to be corrected first, against what the nearest views expect.
    pub noise: Option<PoseNoise>,
    pub image: &'a RgbImage,
    /// The image in luminance and chrominance, as [`Engine::observe`] leaves it.
    pub observation: &'a Observation,
}

/// Where the answer goes; memory that is there is used again.
pub struct Answer<'a> {
    pub prior: &'a mut Prior,
    pub score: &'a mut Score,
    /// What regions and thresholds look at, nats.
    pub evidence: &'a mut BlockMap,
    /// Working memory, of the processor.
    pub blocks: &'a mut BlockMap,
    pub refiner: &'a mut PoseRefiner,
}

/// What is known of every compared image, beside its evidence.
#[derive(Debug, Clone)]
pub struct Compared {
    /// Whence the image was compared.
    pub refined: Refined,
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

/// Makes the engines of a process, all on one card.
pub struct Engines {
    /// `None`: the processor alone.
    card: Option<Arc<Card>>,
    pool: Pool,
    isa: Isa,
}

impl Engines {
    /// # Errors
    /// `Gpu` was asked for and there is none.
    pub fn new(kind: EngineKind, pool: impl Into<Pool>, isa: Isa) -> Result<Self, EngineError> {
        let card = match kind {
            EngineKind::Cpu => None,
            EngineKind::Gpu => Some(Card::open(CardRules::any())?),
            EngineKind::Auto => match Card::open(CardRules::auto()) {
                Ok(card) => Some(card),
                Err(EngineError::NoAdapter) => None,
                Err(error) => {
                    tracing::warn!(%error, "the graphics card cannot be used");
                    None
                }
            },
        };
        Ok(Self {
            card,
            pool: pool.into(),
            isa,
        })
    }

    /// On a card that was chosen otherwise.
    pub fn on(card: Arc<Card>, pool: impl Into<Pool>, isa: Isa) -> Self {
        Self {
            card: Some(card),
            pool: pool.into(),
            isa,
        }
    }

    /// A place's.
    pub fn engine(&self, settings: &Settings) -> Engine {
        let pool = self.pool.clone();
        match &self.card {
            Some(card) if card.works() || !card.falls_back() => {
                Engine::Gpu(Box::new(GpuEngine::new(card, settings, pool, self.isa)))
            }
            _ => Engine::Cpu(CpuEngine::new(settings, pool, self.isa)),
        }
    }

    pub fn card(&self) -> Option<&Card> {
        self.card.as_deref()
    }

    pub fn pool(&self) -> &Pool {
        &self.pool
    }

    pub fn isa(&self) -> Isa {
        self.isa
    }
}

impl Engine {
    /// Compares an image with what its views expect, from the refined pose where the question states a noise. `refined` is
    /// called between the two, unless both are done at once. `score` has the gain then, the surprise map wherever the
    /// evidence seeds a region, and the posterior if it is learnt; the rest when [`Compared::maps_read`] says so.
    ///
    /// # Errors
    /// The device was lost, cannot be replaced, and nothing else was allowed.
    pub fn compare(
        &mut self,
        question: &Question,
        evidence: Evidence,
        learn: bool,
        mut answer: Answer<'_>,
        refined: &mut (dyn FnMut() + Send),
    ) -> Result<Compared, EngineError> {
        let gpu = match self {
            Self::Cpu(engine) => {
                return Ok(compare_on_processor(
                    engine,
                    question,
                    evidence,
                    &mut answer,
                    refined,
                ));
            }
            Self::Gpu(gpu) => gpu,
        };
        match gpu.compare(question, learn, &mut answer) {
            Err(error) if gpu.falls_back() => {
                self.fall_back(&error);
                self.compare(question, evidence, learn, answer, refined)
            }
            result => result,
        }
    }

    /// The processor takes over.
    fn fall_back(&mut self, error: &EngineError) {
        if let Self::Gpu(gpu) = self {
            tracing::error!(%error, "going on with the processor");
            *self = Self::Cpu(gpu.fallback());
        }
    }

    /// Takes an image apart into planes, where they are needed; memory that is there is used again.
    pub fn observe(&self, image: &RgbImage, observation: &mut Observation) {
        match self {
            Self::Cpu(engine) => engine.observe(image, observation),
            Self::Gpu(_) => *observation = Observation::default(),
        }
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

    /// What was moved and done; `None` where nothing is moved.
    pub fn counters(&self) -> Option<&gpu::Counters> {
        match self {
            Self::Cpu(_) => None,
            Self::Gpu(gpu) => Some(gpu.counters()),
        }
    }

    /// Says that viewpoints were changed or removed without a frame.
    pub fn forget(&mut self) {
        if let Self::Gpu(gpu) = self {
            gpu.forget();
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

/// Works with the image in planes, which a card has no need of.
fn observed<T>(engine: &CpuEngine, question: &Question, work: impl FnOnce(&Observation) -> T) -> T {
    let known = question.observation;
    if (known.width, known.height) == (question.image.width, question.image.height) {
        return work(known);
    }
    let mut own = Observation::default();
    engine.observe(question.image, &mut own);
    work(&own)
}

fn refine_on_processor(
    question: &Question,
    noise: PoseNoise,
    observation: &Observation,
    refiner: &mut PoseRefiner,
) -> Refined {
    let views: ArrayVec<(&Coarse, &Pose, f32), REFINE_VIEWS> = question
        .views
        .iter()
        .take(REFINE_VIEWS)
        .map(|view| {
            let Viewpoint {
                coarse,
                world_from_camera,
                ..
            } = view.viewpoint;
            (coarse, world_from_camera, view.weight)
        })
        .collect();
    refiner.refine(
        &views,
        &observation.planes[0],
        question.intrinsics,
        question.world_from_camera,
        noise,
    )
}

fn compare_on_processor(
    engine: &CpuEngine,
    question: &Question,
    evidence: Evidence,
    answer: &mut Answer,
    between: &mut (dyn FnMut() + Send),
) -> Compared {
    let Answer {
        prior,
        score,
        evidence: found,
        blocks,
        refiner,
    } = answer;
    let (refined, seen) = observed(engine, question, |observation| {
        let given = Refined::unchanged(*question.world_from_camera);
        // Handed over once for both.
        engine.in_pool(|| {
            let refined = question.noise.map_or(given, |noise| {
                refine_on_processor(question, noise, observation, refiner)
            });
            between();
            let seen = engine.compare(
                question.views,
                question.intrinsics,
                &refined.world_from_camera,
                observation,
                prior,
                score,
            );
            (refined, seen)
        })
    });
    found.find(&score.surprise, prior.width, evidence, blocks);
    Compared {
        refined,
        seen,
        maps_read: true,
    }
}
