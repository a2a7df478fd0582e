//! The only file that knows the order of the stages. One pipeline is one place; a plain function from frame to report:
//! no clock, no network, no locks.

use std::{cell::OnceCell, collections::HashMap, sync::Arc};

use arrayvec::ArrayVec;

use crate::{
    config::Settings,
    engine::{
        Answer, Engine, Engines, Question,
        cpu::{CpuEngine, Observation, RecallView, Score},
    },
    isa::Isa,
    memory::{Memory, forget::Forgetting, visit::Visit},
    model::{
        camera::Intrinsics,
        event::Event,
        frame::{DepthSource, Frame, FrameError, Sides, Source},
        mode::Mode,
        pose::Pose,
        report::Report,
        viewpoint::{Coarse, Mesh, MeshCut, VIEWS_MAX, Viewpoint},
    },
    pool::Pool,
    stages::{
        attend::{BlockMap, Follower, Scene, regions},
        depth::{InverseDepthRange, SidesDepth, given},
        events::{Events, Look},
        interpolate::prior::{self, Prior},
        next_view::{self, Promise},
        refine::PoseRefiner,
        update::UpdateRules,
    },
};

/// Pixels times labels that depth is computed of: 250 MB of costs, and somewhat more for what is sent between pixels.
const DEPTH_COSTS_MAX: usize = 1 << 28;
/// Labels between neighbours that still are one surface: a slanted one moves by one at a time, and refinement below a
/// label adds to that on both sides.
const LABELS_JOINED: f32 = 1.5;

/// One to be filled, and one that may still be on its way to where it is stored.
const SPARES_MAX: usize = 2;

/// Everything that was computed for the last frame, until the next.
#[derive(Debug, Clone, Default)]
pub struct Maps {
    pub intrinsics: Option<Intrinsics>,
    /// The prior that the frame was compared with.
    pub prior: Prior,
    pub score: Score,
    /// What regions and thresholds look at, nats.
    pub evidence: BlockMap,
}

/// The prior at a pose that somebody asked for.
#[derive(Debug, Clone, Default)]
pub struct PriorAt {
    pub prior: Prior,
    pub viewpoints_used: ArrayVec<u64, VIEWS_MAX>,
}

/// What a frame may cost.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Effort {
    /// All of [`Settings::views`] are recalled.
    Whole,
    /// [`Settings::views_busy`] of them.
    Hurried,
}

/// A part of a frame's way. A pipeline has no clock: it says when a part has ended, and who has a clock may time it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stage {
    /// Given and checked, or computed.
    Depth,
    Refine,
    /// Interpolation and surprise.
    Compare,
    /// Regions and events.
    Attend,
    /// The frame becomes a viewpoint.
    Remember,
}

/// Called when a stage has ended, on any thread.
type Ended<'a> = &'a mut (dyn FnMut(Stage) + Send);

/// What a place knows about one camera.
#[derive(Debug, Clone, Default)]
struct Camera {
    visit: Visit,
    follower: Follower,
}

/// Working memory between frames: what was overwritten is filled again.
#[derive(Default)]
struct Workspace {
    /// Metres; 0 = none, or out of the settings' range.
    depth_m: Vec<f32>,
    cut: MeshCut,
    /// What is expected where depth is computed.
    expected: Prior,
    observation: Observation,
    selected: Vec<usize>,
    blocks: BlockMap,
}

pub struct Pipeline {
    settings: Settings,
    pool: Pool,
    sides_depth: SidesDepth,
    engine: Engine,
    refiner: PoseRefiner,
    update_rules: UpdateRules,
    memory: Memory,
    /// Viewpoints that were replaced: their memory is used again.
    spares: ArrayVec<Arc<Viewpoint>, SPARES_MAX>,
    cameras: HashMap<Source, Camera>,
    events: Events,
    last_region_id: u64,
    /// What the last frame's report needed.
    maps: Maps,
    maps_read: bool,
    /// All of them, if the engine kept some and somebody wanted them.
    whole_maps: OnceCell<Maps>,
    workspace: Workspace,
}

impl Pipeline {
    /// `pool` may be shared among places.
    pub fn new(settings: Settings, pool: impl Into<Pool>) -> Self {
        Self::with_isa(settings, pool, Isa::detect())
    }

    /// With other instructions than the best; they must exist on this processor.
    pub fn with_isa(settings: Settings, pool: impl Into<Pool>, isa: Isa) -> Self {
        let pool = pool.into();
        let engine = Engine::Cpu(CpuEngine::new(&settings, pool.clone(), isa));
        Self::with_engine(settings, pool, isa, engine)
    }

    /// Where these engines compute.
    pub fn on(engines: &Engines, settings: Settings) -> Self {
        let engine = engines.engine(&settings);
        Self::with_engine(settings, engines.pool().clone(), engines.isa(), engine)
    }

    fn with_engine(settings: Settings, pool: Pool, isa: Isa, engine: Engine) -> Self {
        Self {
            sides_depth: SidesDepth::new(depth_range(&settings), isa),
            engine,
            refiner: PoseRefiner::new(pool.clone(), isa),
            pool,
            update_rules: UpdateRules::new(&settings),
            memory: Memory::default(),
            spares: ArrayVec::new(),
            cameras: HashMap::new(),
            events: Events::default(),
            last_region_id: 0,
            maps: Maps::default(),
            maps_read: true,
            whole_maps: OnceCell::new(),
            workspace: Workspace::default(),
            settings,
        }
    }

    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    pub fn memory(&self) -> &Memory {
        &self.memory
    }

    /// For who stores it, and for who forgets some of it.
    pub fn memory_mut(&mut self) -> &mut Memory {
        &mut self.memory
    }

    /// Of the last frame that was processed or evaluated.
    pub fn maps(&self) -> &Maps {
        if self.maps_read {
            return &self.maps;
        }
        self.whole_maps.get_or_init(|| {
            let mut maps = Maps {
                intrinsics: self.maps.intrinsics,
                evidence: self.maps.evidence.clone(),
                ..Maps::default()
            };
            maps.score.gain = self.maps.score.gain;
            match self.engine.maps(&mut maps.prior, &mut maps.score) {
                Ok(()) => maps,
                Err(error) => {
                    tracing::warn!(%error, "the last frame's maps are gone");
                    Maps::default()
                }
            }
        })
    }

    pub fn engine(&self) -> &Engine {
        &self.engine
    }

    /// Compares a frame with the memory and learns it.
    ///
    /// # Errors
    /// A frame that cannot be used; nothing has changed then.
    pub fn process(&mut self, frame: &Frame) -> Result<Report, FrameError> {
        self.process_in(Mode::Learn, frame)
    }

    /// Compares a frame with the memory, which it changes as the mode says. Regions are followed in every mode.
    ///
    /// # Errors
    /// A frame that cannot be used; nothing has changed then.
    pub fn process_in(&mut self, mode: Mode, frame: &Frame) -> Result<Report, FrameError> {
        self.process_staged(mode, Effort::Whole, frame, &mut |_| {})
    }

    /// The same with less effort if need be, telling `ended` of every stage.
    ///
    /// # Errors
    /// A frame that cannot be used; nothing has changed then.
    pub fn process_staged(
        &mut self,
        mode: Mode,
        effort: Effort,
        frame: &Frame,
        ended: Ended,
    ) -> Result<Report, FrameError> {
        let _computing = self.pool.begin();
        self.depth(frame)?;
        ended(Stage::Depth);
        let mut camera = match self.cameras.get_mut(&frame.source) {
            Some(camera) => std::mem::take(camera),
            None => Camera::default(),
        };
        let before = (mode == Mode::Freeze).then(|| camera.visit.clone());
        let learn = mode == Mode::Learn;
        let looked = self.look(frame, effort, &mut camera.visit, learn, ended);
        let looked = looked.map(|mut report| {
            camera
                .follower
                .follow(&mut report.regions, &mut self.last_region_id);
            report.events = self.follow_events(frame, &mut report);
            ended(Stage::Attend);
            if learn {
                let id = self.remember(frame, &report.world_from_camera);
                camera.visit.wrote(id);
                report.viewpoint_id = Some(id);
                ended(Stage::Remember);
            }
            report.learned = learn;
            report
        });
        if let Some(before) = before {
            camera.visit = before;
        }
        match self.cameras.get_mut(&frame.source) {
            Some(slot) => *slot = camera,
            None => {
                self.cameras.insert(frame.source.clone(), camera);
            }
        }
        looked
    }

    /// Goes on with an event that was told of before, as after a restart.
    pub fn resume_event(&mut self, event: Event) {
        self.events.resume(event);
    }

    /// What the frame that was looked at says about the place's events, before its depth becomes a viewpoint's.
    fn follow_events(&mut self, frame: &Frame, report: &mut Report) -> Vec<Event> {
        let mut events = std::mem::take(&mut self.events);
        let look = Look {
            source: &frame.source,
            stamp_ns: frame.stamp_ns,
            sequence: frame.sequence,
            image: &frame.image,
            scene: Scene {
                depth_m: &self.workspace.depth_m,
                intrinsics: &frame.intrinsics,
                world_from_camera: &report.world_from_camera,
            },
            evidence: &self.maps.evidence,
            unseen_share: 1.0 - report.coverage,
            prior: &|| &self.maps().prior,
        };
        let changed = events.observe(&look, &mut report.regions, &self.settings);
        self.events = events;
        changed
    }

    /// Makes the posterior of the frame that was looked at a viewpoint and returns its id.
    fn remember(&mut self, frame: &Frame, world_from_camera: &Pose) -> u64 {
        let mut viewpoint = self.spare(frame);
        let work = &mut self.workspace;
        let fresh = Arc::get_mut(&mut viewpoint).expect("a spare has one owner");
        fresh.world_from_camera = *world_from_camera;
        fresh.world_from_home = *world_from_camera;
        fresh.source.clone_from(&frame.source);
        fresh.stamp_ns = frame.stamp_ns;
        fresh.mesh.intrinsics = frame.intrinsics;
        std::mem::swap(&mut fresh.mesh.depth_m, &mut work.depth_m);
        // The next posterior is written where records were that nobody needs.
        std::mem::swap(&mut fresh.records, &mut self.maps.score.posterior);
        // Nothing else looks at half resolution.
        let refined_against = self.settings.refine_pose.then_some(&mut fresh.coarse);
        self.engine
            .prepare(&mut fresh.mesh, &fresh.records, refined_against, work.cut);
        let slot = self.memory.slot(
            &work.selected,
            world_from_camera,
            viewpoint.bytes(),
            &self.settings,
        );
        let (id, old) = self.memory.replace(slot, viewpoint);
        let written = self.memory.viewpoints().iter().find(|view| view.id == id);
        self.engine
            .remember(written.expect("it was written just now"));
        if let Some(old) = old
            && !self.spares.is_full()
        {
            self.spares.push(old);
        }
        id
    }

    /// A viewpoint to be filled in: one that was replaced and is not being stored any more, or a new one.
    fn spare(&mut self, frame: &Frame) -> Arc<Viewpoint> {
        let free = self
            .spares
            .iter_mut()
            .position(|spare| Arc::get_mut(spare).is_some());
        match free {
            Some(index) => self.spares.swap_remove(index),
            None => Arc::new(Viewpoint {
                id: 0,
                world_from_camera: frame.world_from_camera,
                world_from_home: frame.world_from_camera,
                mesh: Mesh::default(),
                records: Vec::new(),
                coarse: Coarse::default(),
                source: frame.source.clone(),
                stamp_ns: frame.stamp_ns,
                updates: 0,
            }),
        }
    }

    /// Compares a frame with the memory and changes nothing but [`Self::maps`]. Its regions have no ids.
    ///
    /// # Errors
    /// A frame that cannot be used.
    pub fn evaluate(&mut self, frame: &Frame) -> Result<Report, FrameError> {
        let _computing = self.pool.begin();
        self.depth(frame)?;
        let camera = self.cameras.get(&frame.source);
        let mut visit = camera
            .map(|camera| camera.visit.clone())
            .unwrap_or_default();
        self.look(frame, Effort::Whole, &mut visit, false, &mut |_| {})
    }

    /// The prior at a pose, as somebody would see it who was not here lately.
    pub fn prior(&mut self, intrinsics: &Intrinsics, world_from_camera: &Pose) -> PriorAt {
        let _computing = self.pool.begin();
        let mut selected = Vec::new();
        self.select(world_from_camera, &mut selected);
        let mut prior = Prior::default();
        let views = recall_views(&self.memory, &self.settings, &selected, &Visit::default());
        self.engine
            .recall(&views, intrinsics, world_from_camera, &mut prior);
        PriorAt {
            prior,
            viewpoints_used: self.ids(&selected),
        }
    }

    /// Forgets what is known about a camera beside the viewpoints it wrote.
    pub fn forget_camera(&mut self, source: &Source) {
        self.cameras.remove(source);
    }

    /// Goes on forgetting, over at most so many viewpoints; whether all is done.
    pub fn forget(&mut self, forgetting: &mut Forgetting, viewpoints_max: usize) -> bool {
        let _computing = self.pool.begin();
        let memory = &mut self.memory;
        let done = self
            .pool
            .install(|| memory.forget(forgetting, viewpoints_max));
        self.engine.forget();
        done
    }

    /// What an observation from a pose is expected to tell. One pass of the engine.
    pub fn promise(&mut self, intrinsics: &Intrinsics, world_from_camera: &Pose) -> Promise {
        let at = self.prior(intrinsics, world_from_camera);
        next_view::promise(&at.prior, &self.update_rules)
    }

    /// Compares a checked frame with what is expected; nothing is learnt yet.
    fn look(
        &mut self,
        frame: &Frame,
        effort: Effort,
        visit: &mut Visit,
        learn: bool,
        ended: Ended,
    ) -> Result<Report, FrameError> {
        let mut work = std::mem::take(&mut self.workspace);
        let mut maps = std::mem::take(&mut self.maps);
        self.engine.observe(&frame.image, &mut work.observation);

        self.select(&frame.world_from_camera, &mut work.selected);
        let mut used = self.ids(&work.selected);
        // A visit goes on, and the frame is learnt where it would be, however much effort is made.
        visit.select(&used);
        if effort == Effort::Hurried {
            used.truncate(self.settings.views_busy);
        }

        let recalled = &work.selected[..used.len()];
        let views = recall_views(&self.memory, &self.settings, recalled, visit);
        let question = Question {
            views: &views,
            intrinsics: &frame.intrinsics,
            world_from_camera: &frame.world_from_camera,
            noise: self.settings.refine_pose.then(|| {
                let own = frame.pose_noise;
                own.unwrap_or_else(|| self.settings.pose_noise(&frame.source.robot))
            }),
            image: &frame.image,
            observation: &work.observation,
        };
        let answer = Answer {
            prior: &mut maps.prior,
            score: &mut maps.score,
            evidence: &mut maps.evidence,
            blocks: &mut work.blocks,
            refiner: &mut self.refiner,
        };
        let between = &mut || ended(Stage::Refine);
        let evidence = self.settings.evidence;
        let compared = self
            .engine
            .compare(&question, evidence, learn, answer, between);
        self.whole_maps.take();
        ended(Stage::Compare);
        let compared = match compared {
            Ok(compared) => compared,
            Err(error) => {
                self.workspace = work;
                self.maps_read = true;
                return Err(FrameError::Engine(error.to_string()));
            }
        };
        maps.intrinsics = Some(frame.intrinsics);
        self.maps_read = compared.maps_read;
        let refined = compared.refined;
        let world_from_camera = refined.world_from_camera;

        let scene = Scene {
            depth_m: &work.depth_m,
            intrinsics: &frame.intrinsics,
            world_from_camera: &world_from_camera,
        };
        let regions = regions(&maps.score.surprise, &maps.evidence, &scene, &self.settings);
        let inside = maps.evidence.inside(self.settings.border_px);
        let (mut count, mut sum, mut max) = (0usize, 0.0f64, 0.0f32);
        for (_, _, value) in inside {
            count += 1;
            sum += f64::from(value);
            max = max.max(value);
        }
        let report = Report {
            source: frame.source.clone(),
            stamp_ns: frame.stamp_ns,
            sequence: frame.sequence,
            width: frame.intrinsics.width,
            height: frame.intrinsics.height,
            world_from_camera,
            regions,
            max_surprise: max,
            mean_surprise: (sum / count.max(1) as f64) as f32,
            coverage: compared.seen as f32 / frame.intrinsics.pixels() as f32,
            events: Vec::new(),
            learned: false,
            viewpoint_id: None,
            viewpoints_used: used,
            pose_correction_m: refined.correction_m,
            pose_correction_rad: refined.correction_rad,
        };
        self.maps = maps;
        self.workspace = work;
        Ok(report)
    }

    fn select(&self, world_from_camera: &Pose, selected: &mut Vec<usize>) {
        self.memory
            .select(world_from_camera, &self.settings, selected);
    }

    fn ids(&self, selected: &[usize]) -> ArrayVec<u64, VIEWS_MAX> {
        selected
            .iter()
            .map(|&index| self.memory.viewpoints()[index].id)
            .collect()
    }

    /// The frame's depth, given or computed, goes into the workspace.
    fn depth(&mut self, frame: &Frame) -> Result<(), FrameError> {
        let Intrinsics { width, height, .. } = frame.intrinsics;
        if (frame.image.width, frame.image.height) != (width, height) {
            return Err(FrameError::ImageSize {
                image_width: frame.image.width,
                image_height: frame.image.height,
                width,
                height,
            });
        }
        match &frame.depth {
            DepthSource::Given(depth_m) => {
                self.workspace.cut = self.settings.mesh_cut.into();
                given::check(
                    depth_m,
                    width * height,
                    &self.settings,
                    &mut self.workspace.depth_m,
                )
            }
            DepthSource::Sides(sides) => self.depth_from_sides(frame, sides),
        }
    }

    fn depth_from_sides(&mut self, frame: &Frame, sides: &Sides) -> Result<(), FrameError> {
        for (side, view) in [("left", &sides.left), ("right", &sides.right)] {
            let (got, camera) = (&view.image, &view.intrinsics);
            if (got.width, got.height) != (camera.width, camera.height) {
                return Err(FrameError::SideSize {
                    side,
                    got_width: got.width,
                    got_height: got.height,
                    width: camera.width,
                    height: camera.height,
                });
            }
        }
        let pixels = frame.intrinsics.pixels();
        let labels = self.settings.depth_labels;
        if pixels.saturating_mul(labels) > DEPTH_COSTS_MAX {
            return Err(FrameError::DepthTooLarge {
                pixels,
                labels,
                most: DEPTH_COSTS_MAX,
            });
        }
        let expected_m = self.expected_depth(frame);
        let computed = self.pool.install(|| {
            self.sides_depth.compute(
                &frame.intrinsics,
                &frame.image,
                sides,
                expected_m.as_deref(),
            )
        });
        let (inverse_depth, computed_m) = (computed.label_step * LABELS_JOINED, &computed.depth_m);
        self.workspace.cut = MeshCut {
            share: self.settings.mesh_cut,
            inverse_depth,
        };
        given::check(
            computed_m,
            pixels,
            &self.settings,
            &mut self.workspace.depth_m,
        )
    }

    /// What the memory expects from the frame's pose as it was given: good enough where the images say nothing.
    fn expected_depth(&mut self, frame: &Frame) -> Option<Vec<f32>> {
        let work = &mut self.workspace;
        let mut selected = std::mem::take(&mut work.selected);
        let mut expected = std::mem::take(&mut work.expected);
        self.select(&frame.world_from_camera, &mut selected);
        let depth_m = (!selected.is_empty()).then(|| {
            let visit = Visit::default();
            let visit = self
                .cameras
                .get(&frame.source)
                .map_or(&visit, |camera| &camera.visit);
            let views = recall_views(&self.memory, &self.settings, &selected, visit);
            self.engine.recall(
                &views,
                &frame.intrinsics,
                &frame.world_from_camera,
                &mut expected,
            );
            expected.plane(prior::DEPTH).collect()
        });
        self.workspace.selected = selected;
        self.workspace.expected = expected;
        depth_m
    }
}

/// The hypotheses where depth is computed.
pub fn depth_range(settings: &Settings) -> InverseDepthRange {
    InverseDepthRange::new(
        1.0 / settings.depth_far_m,
        1.0 / settings.depth_near_m,
        settings.depth_labels,
    )
    .expect("settings were validated")
}

/// The selected viewpoints with the weights that this visit gives them.
fn recall_views<'a>(
    memory: &'a Memory,
    settings: &Settings,
    selected: &[usize],
    visit: &Visit,
) -> ArrayVec<RecallView<'a>, VIEWS_MAX> {
    selected
        .iter()
        .map(|&index| {
            let viewpoint = &memory.viewpoints()[index];
            let (weight, fresh) = if settings.fresh_views {
                visit.weight(viewpoint.id)
            } else {
                (1.0, false)
            };
            RecallView {
                viewpoint,
                weight,
                fresh,
            }
        })
        .collect()
}
