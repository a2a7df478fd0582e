//! The only file that knows the order of the stages. One pipeline is one place; a plain function from frame to report:
//! no clock, no network, no locks.

use std::{cell::OnceCell, collections::HashMap, sync::Arc};

use rayon::ThreadPool;

use crate::{
    config::Settings,
    engine::{
        Engine, Question,
        cpu::{CpuEngine, Observation, RecallView, Score},
        isa::Isa,
    },
    memory::{Memory, visit::Visit},
    model::{
        camera::Intrinsics,
        frame::{Frame, FrameError, Source},
        pose::{Pose, PoseNoise},
        report::Report,
        viewpoint::{Coarse, Mesh, Viewpoint},
    },
    stages::{
        attend::{BlockMap, Follower, Scene, regions},
        interpolate::prior::Prior,
        refine::{PoseRefiner, REFINE_VIEWS, Refined},
        select::select_nearest,
    },
};

/// Less depth than this share of the image is none: such a viewpoint could never be recalled.
const DEPTH_SHARE_MIN: f64 = 0.01;
/// When less of the depth than this lies in the settings' range, its unit must be wrong.
const DEPTH_IN_RANGE_MIN: f64 = 0.1;

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
    pub viewpoints_used: Vec<u64>,
}

/// What a place knows about one camera.
#[derive(Debug, Clone, Default)]
struct Camera {
    visit: Visit,
    follower: Follower,
}

/// A frame compared with what was expected; nothing is learnt yet.
struct Look {
    world_from_camera: Pose,
    selected: Vec<usize>,
    depth_m: Vec<f32>,
    camera: Camera,
    report: Report,
}

pub struct Pipeline {
    settings: Settings,
    engine: Engine,
    refiner: PoseRefiner,
    memory: Memory,
    cameras: HashMap<Source, Camera>,
    last_region_id: u64,
    /// What the last frame's report needed.
    maps: Maps,
    /// All of them, if the engine kept some and somebody wanted them.
    whole_maps: OnceCell<Maps>,
    maps_read: bool,
}

impl Pipeline {
    /// `pool` may be shared among places.
    pub fn new(settings: Settings, pool: Arc<ThreadPool>) -> Self {
        Self::with_isa(settings, pool, Isa::detect())
    }

    /// With other instructions than the best; they must exist on this processor.
    pub fn with_isa(settings: Settings, pool: Arc<ThreadPool>, isa: Isa) -> Self {
        let engine = Engine::Cpu(CpuEngine::new(&settings, pool, isa));
        Self::with_engine(settings, engine)
    }

    /// With an engine that was made for these settings.
    pub fn with_engine(settings: Settings, engine: Engine) -> Self {
        Self {
            engine,
            refiner: PoseRefiner::default(),
            memory: Memory::default(),
            cameras: HashMap::new(),
            last_region_id: 0,
            maps: Maps::default(),
            whole_maps: OnceCell::new(),
            maps_read: true,
            settings,
        }
    }

    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    pub fn memory(&self) -> &Memory {
        &self.memory
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
        let Look {
            world_from_camera,
            selected,
            depth_m,
            mut camera,
            mut report,
        } = self.look(frame, true)?;
        let records = self.maps.score.posterior.clone();
        let mesh = Mesh::new(frame.intrinsics, depth_m, self.settings.mesh_cut);
        let viewpoint = Viewpoint {
            coarse: Coarse::new(&mesh, &records, self.settings.mesh_cut),
            id: 0,
            world_from_camera,
            world_from_home: world_from_camera,
            mesh,
            records,
            source: frame.source.clone(),
            stamp_ns: frame.stamp_ns,
            updates: 0,
        };
        let slot = self.memory.slot(
            &selected,
            &world_from_camera,
            viewpoint.bytes(),
            &self.settings,
        );
        let id = self.memory.write(slot, viewpoint);
        let written = self.memory.viewpoints().iter().find(|view| view.id == id);
        self.engine
            .remember(written.expect("it was written just now"));
        camera.visit.wrote(id);
        camera
            .follower
            .follow(&mut report.regions, &mut self.last_region_id);
        self.cameras.insert(frame.source.clone(), camera);
        report.learned = true;
        report.viewpoint_id = Some(id);
        Ok(report)
    }

    /// Compares a frame with the memory and changes nothing but [`Self::maps`]. Its regions have no ids.
    ///
    /// # Errors
    /// A frame that cannot be used.
    pub fn evaluate(&mut self, frame: &Frame) -> Result<Report, FrameError> {
        self.look(frame, false).map(|look| look.report)
    }

    /// The prior at a pose, as somebody would see it who was not here lately.
    pub fn prior(&mut self, intrinsics: &Intrinsics, world_from_camera: &Pose) -> PriorAt {
        let selected = self.select(world_from_camera);
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
    pub fn forget(&mut self, source: &Source) {
        self.cameras.remove(source);
    }

    fn look(&mut self, frame: &Frame, learn: bool) -> Result<Look, FrameError> {
        let depth_m = self.checked_depth(frame)?;
        let mut camera = self.cameras.get(&frame.source).cloned().unwrap_or_default();
        let observation = Observation::new(&frame.image);

        let refined = self.refine(frame, &observation, &camera.visit);
        let world_from_camera = refined.world_from_camera;

        let selected = self.select(&world_from_camera);
        let used = self.ids(&selected);
        camera.visit.select(&used);

        let mut maps = std::mem::take(&mut self.maps);
        let views = recall_views(&self.memory, &self.settings, &selected, &camera.visit);
        let question = Question {
            views: &views,
            intrinsics: &frame.intrinsics,
            world_from_camera: &world_from_camera,
            image: &frame.image,
            observation: &observation,
        };
        let evidence = self.settings.evidence;
        let compared = self
            .engine
            .compare(&question, evidence, learn, &mut maps.prior, &mut maps.score)
            .map_err(|error| FrameError::Engine(error.to_string()))?;
        maps.intrinsics = Some(frame.intrinsics);
        maps.evidence = compared.evidence;
        self.maps_read = compared.maps_read;
        self.whole_maps.take();

        let scene = Scene {
            depth_m: &depth_m,
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
            learned: false,
            viewpoint_id: None,
            viewpoints_used: used,
            pose_correction_m: refined.correction_m,
            pose_correction_rad: refined.correction_rad,
        };
        self.maps = maps;
        Ok(Look {
            world_from_camera,
            selected,
            depth_m,
            camera,
            report,
        })
    }

    fn refine(&mut self, frame: &Frame, observation: &Observation, visit: &Visit) -> Refined {
        if !self.settings.refine_pose {
            return Refined::unchanged(frame.world_from_camera);
        }
        let noise = frame.pose_noise.unwrap_or(PoseNoise {
            position_m: self.settings.pose_position_sd_m,
            rotation_rad: self.settings.pose_rotation_sd_rad,
        });
        let mut selected = self.select(&frame.world_from_camera);
        selected.truncate(REFINE_VIEWS);
        let recalled = recall_views(&self.memory, &self.settings, &selected, visit);
        let views: Vec<(&Coarse, &Pose, f32)> = recalled
            .iter()
            .map(|view| {
                (
                    &view.viewpoint.coarse,
                    &view.viewpoint.world_from_camera,
                    view.weight,
                )
            })
            .collect();
        self.refiner.refine(
            &views,
            &observation.planes[0],
            &frame.intrinsics,
            &frame.world_from_camera,
            noise,
        )
    }

    fn select(&self, world_from_camera: &Pose) -> Vec<usize> {
        let poses = self
            .memory
            .viewpoints()
            .iter()
            .map(|viewpoint| &viewpoint.world_from_camera);
        select_nearest(
            poses,
            world_from_camera,
            self.settings.metres_per_radian,
            self.settings.views,
            self.settings.view_distance_max_m,
        )
    }

    fn ids(&self, selected: &[usize]) -> Vec<u64> {
        selected
            .iter()
            .map(|&index| self.memory.viewpoints()[index].id)
            .collect()
    }

    /// The frame's depth with everything outside the settings' range taken as none.
    fn checked_depth(&self, frame: &Frame) -> Result<Vec<f32>, FrameError> {
        let Intrinsics { width, height, .. } = frame.intrinsics;
        if (frame.image.width, frame.image.height) != (width, height) {
            return Err(FrameError::ImageSize {
                image_width: frame.image.width,
                image_height: frame.image.height,
                width,
                height,
            });
        }
        if frame.depth_m.len() != width * height {
            return Err(FrameError::DepthSize {
                got: frame.depth_m.len(),
                expected: width * height,
            });
        }
        let range = self.settings.depth_min_m..=self.settings.depth_max_m;
        let mut given: Vec<f32> = frame
            .depth_m
            .iter()
            .copied()
            .filter(|z| z.is_finite() && *z > 0.0)
            .collect();
        let share = given.len() as f64 / frame.depth_m.len() as f64;
        if share < DEPTH_SHARE_MIN {
            return Err(FrameError::NoDepth {
                valid_percent: 100.0 * share,
            });
        }
        let valid = given.iter().filter(|z| range.contains(z)).count() as f64 / given.len() as f64;
        if valid < DEPTH_IN_RANGE_MIN {
            let middle = given.len() / 2;
            let (_, &mut median_m, _) = given.select_nth_unstable_by(middle, f32::total_cmp);
            return Err(FrameError::DepthUnit {
                valid_percent: 100.0 * valid,
                min_m: *range.start(),
                max_m: *range.end(),
                median_m,
            });
        }
        // NaN is in no range.
        Ok(frame
            .depth_m
            .iter()
            .map(|&z| if range.contains(&z) { z } else { 0.0 })
            .collect())
    }
}

/// The selected viewpoints with the weights that this visit gives them.
fn recall_views<'a>(
    memory: &'a Memory,
    settings: &Settings,
    selected: &[usize],
    visit: &Visit,
) -> Vec<RecallView<'a>> {
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
