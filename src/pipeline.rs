//! The only file that knows the order of the stages. One pipeline is one place; a plain function from frame to report:
//! no clock, no network, no locks.

use std::{collections::HashMap, sync::Arc};

use rayon::ThreadPool;

use crate::{
    config::Settings,
    engine::{
        cpu::{CpuEngine, Observation, RecallView, Score},
        isa::Isa,
    },
    memory::{Memory, visit::Visit},
    model::{
        camera::Intrinsics,
        frame::{DepthSource, Frame, FrameError, Sides, Source},
        pose::{Pose, PoseNoise},
        report::Report,
        viewpoint::{Coarse, Mesh, MeshCut, Viewpoint},
    },
    stages::{
        attend::{BlockMap, Follower, Scene, regions},
        depth::{InverseDepthRange, SidesDepth},
        interpolate::prior::{self, Prior},
        refine::{PoseRefiner, REFINE_VIEWS, Refined},
        select::select_nearest,
    },
};

/// Less depth than this share of the image is none: such a viewpoint could never be recalled.
const DEPTH_SHARE_MIN: f64 = 0.01;
/// When less of the depth than this lies in the settings' range, its unit must be wrong.
const DEPTH_IN_RANGE_MIN: f64 = 0.1;

/// Pixels times labels that depth is computed of: 250 MB of costs, and somewhat more for what is sent between pixels.
const DEPTH_COSTS_MAX: usize = 1 << 28;
/// Labels between neighbours that still are one surface: a slanted one moves by one at a time, and refinement below a
/// label adds to that on both sides.
const LABELS_JOINED: f32 = 1.5;

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
    depth: Depth,
    camera: Camera,
    report: Report,
}

/// The surface that a frame shows.
struct Depth {
    /// Metres; 0 = none, or out of the settings' range.
    depth_m: Vec<f32>,
    cut: MeshCut,
}

pub struct Pipeline {
    settings: Settings,
    pool: Arc<ThreadPool>,
    engine: CpuEngine,
    sides_depth: SidesDepth,
    /// What is expected where depth is computed; kept for its allocation.
    expected: Prior,
    refiner: PoseRefiner,
    memory: Memory,
    cameras: HashMap<Source, Camera>,
    last_region_id: u64,
    maps: Maps,
}

impl Pipeline {
    /// `pool` may be shared among places.
    pub fn new(settings: Settings, pool: Arc<ThreadPool>) -> Self {
        Self::with_isa(settings, pool, Isa::detect())
    }

    /// With other instructions than the best; they must exist on this processor.
    pub fn with_isa(settings: Settings, pool: Arc<ThreadPool>, isa: Isa) -> Self {
        Self {
            sides_depth: SidesDepth::new(depth_range(&settings)),
            engine: CpuEngine::new(&settings, pool.clone(), isa),
            pool,
            expected: Prior::default(),
            refiner: PoseRefiner::default(),
            memory: Memory::default(),
            cameras: HashMap::new(),
            last_region_id: 0,
            maps: Maps::default(),
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
        &self.maps
    }

    /// Compares a frame with the memory and learns it.
    ///
    /// # Errors
    /// A frame that cannot be used; nothing has changed then.
    pub fn process(&mut self, frame: &Frame) -> Result<Report, FrameError> {
        let Look {
            world_from_camera,
            selected,
            depth: Depth { depth_m, cut },
            mut camera,
            mut report,
        } = self.look(frame)?;
        let records = self.maps.score.posterior.clone();
        let mesh = Mesh::new(frame.intrinsics, depth_m, cut);
        let viewpoint = Viewpoint {
            coarse: Coarse::new(&mesh, &records, cut),
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
        self.look(frame).map(|look| look.report)
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

    fn look(&mut self, frame: &Frame) -> Result<Look, FrameError> {
        let mut camera = self.cameras.get(&frame.source).cloned().unwrap_or_default();
        let depth = self.depth(frame, &camera.visit)?;
        let observation = Observation::new(&frame.image);

        let refined = self.refine(frame, &observation, &camera.visit);
        let world_from_camera = refined.world_from_camera;

        let selected = self.select(&world_from_camera);
        let used = self.ids(&selected);
        camera.visit.select(&used);

        let mut maps = std::mem::take(&mut self.maps);
        let views = recall_views(&self.memory, &self.settings, &selected, &camera.visit);
        self.engine.recall(
            &views,
            &frame.intrinsics,
            &world_from_camera,
            &mut maps.prior,
        );
        self.engine
            .score(&maps.prior, &observation, &mut maps.score);
        maps.intrinsics = Some(frame.intrinsics);
        maps.evidence = BlockMap::evidence(
            &maps.score.surprise,
            frame.intrinsics.width,
            self.settings.evidence,
        );

        let scene = Scene {
            depth_m: &depth.depth_m,
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
        let seen = maps
            .prior
            .plane(prior::COVERAGE)
            .filter(|&c| c > 0.0)
            .count();
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
            coverage: seen as f32 / frame.intrinsics.pixels() as f32,
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
            depth,
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

    /// The frame's depth, given or computed, with everything outside the settings' range taken as none.
    fn depth(&mut self, frame: &Frame, visit: &Visit) -> Result<Depth, FrameError> {
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
            DepthSource::Given(depth_m) => Ok(Depth {
                depth_m: self.checked_depth(depth_m, width * height)?,
                cut: self.settings.mesh_cut.into(),
            }),
            DepthSource::Sides(sides) => self.depth_from_sides(frame, sides, visit),
        }
    }

    fn checked_depth(&self, depth_m: &[f32], pixels: usize) -> Result<Vec<f32>, FrameError> {
        if depth_m.len() != pixels {
            return Err(FrameError::DepthSize {
                got: depth_m.len(),
                expected: pixels,
            });
        }
        let range = self.settings.depth_min_m..=self.settings.depth_max_m;
        let mut given: Vec<f32> = depth_m
            .iter()
            .copied()
            .filter(|z| z.is_finite() && *z > 0.0)
            .collect();
        enough(given.len(), pixels)?;
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
        Ok(in_range(&self.settings, depth_m))
    }

    fn depth_from_sides(
        &mut self,
        frame: &Frame,
        sides: &Sides,
        visit: &Visit,
    ) -> Result<Depth, FrameError> {
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
        let expected_m = self.expected_depth(frame, visit);
        let image = frame.image.grey();
        let computed = self.pool.install(|| {
            self.sides_depth
                .compute(&frame.intrinsics, &image, sides, expected_m.as_deref())
        });
        let (inverse_depth, computed_m) = (computed.label_step * LABELS_JOINED, &computed.depth_m);
        enough(computed_m.iter().filter(|z| **z > 0.0).count(), pixels)?;
        Ok(Depth {
            depth_m: in_range(&self.settings, computed_m),
            cut: MeshCut {
                share: self.settings.mesh_cut,
                inverse_depth,
            },
        })
    }

    /// What the memory expects from the frame's pose as it was given: good enough where the images say nothing.
    fn expected_depth(&mut self, frame: &Frame, visit: &Visit) -> Option<Vec<f32>> {
        let selected = self.select(&frame.world_from_camera);
        if selected.is_empty() {
            return None;
        }
        let views = recall_views(&self.memory, &self.settings, &selected, visit);
        self.engine.recall(
            &views,
            &frame.intrinsics,
            &frame.world_from_camera,
            &mut self.expected,
        );
        Some(self.expected.plane(prior::DEPTH).collect())
    }
}

fn in_range(settings: &Settings, depth_m: &[f32]) -> Vec<f32> {
    let range = settings.depth_min_m..=settings.depth_max_m;
    // NaN is in no range.
    let kept = |&z: &f32| if range.contains(&z) { z } else { 0.0 };
    depth_m.iter().map(kept).collect()
}

fn enough(valid: usize, pixels: usize) -> Result<(), FrameError> {
    let share = valid as f64 / pixels as f64;
    if share < DEPTH_SHARE_MIN {
        return Err(FrameError::NoDepth {
            valid_percent: 100.0 * share,
        });
    }
    Ok(())
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
