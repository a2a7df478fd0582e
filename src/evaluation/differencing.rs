//! Image differencing, the baseline of section V-B, and the same with every help that a preset has.
//!
//! The memory holds images, not beliefs; the prediction is the mean of the covering views, warped; the score of a
//! pixel is the sum of absolute differences over Y, Cb and Cr. Views, warps and the replacement rule are those of the
//! settings under test, so that only the probabilities differ.

use crate::{
    config::{Evidence, Settings},
    engine::cpu::{CpuEngine, Observation, RecallView},
    evaluation::method::Verdict,
    isa::Isa,
    memory::Memory,
    model::{
        belief::{Belief, CHANNELS, Record},
        frame::{Frame, FrameError},
        pose::{Pose, PoseNoise},
        viewpoint::{Coarse, Mesh, Viewpoint},
    },
    pool::Pool,
    stages::{
        attend::{BlockMap, Scene, regions},
        exposure::exposure_gain,
        interpolate::prior::{self, Prior},
        refine::{PoseRefiner, REFINE_VIEWS},
        select::select_nearest,
    },
};

/// Sum of grey level differences from which a block is reported; finds as much as 6 nats do (ObChange, given poses).
const THRESHOLD_GREY: f32 = 90.0;
/// Of every pixel: differencing knows no uncertainty. The sensor's noise, grey levels squared; refinement adds its own.
const VARIANCE: f32 = 1.0;

/// What helps beyond plain differencing.
#[derive(Debug, Clone, Copy)]
pub struct Helps {
    pub refine_pose: bool,
    pub depth_vote: bool,
    pub exposure_gain: bool,
    /// The least difference over 3x3 shifts of the prediction.
    pub tolerance: bool,
    pub evidence: Evidence,
}

impl Helps {
    pub const NONE: Self = Self {
        refine_pose: false,
        depth_vote: false,
        exposure_gain: false,
        tolerance: false,
        evidence: Evidence::Blocks,
    };

    /// What the settings give the beliefs, as far as images can have it.
    pub fn of(settings: &Settings) -> Self {
        Self {
            refine_pose: settings.refine_pose,
            depth_vote: settings.depth_vote,
            exposure_gain: settings.exposure_gain,
            tolerance: settings.edge_error_px > 0.0,
            evidence: settings.evidence,
        }
    }
}

pub struct Differencing {
    settings: Settings,
    helps: Helps,
    engine: CpuEngine,
    refiner: PoseRefiner,
    memory: Memory,
    prior: Prior,
}

impl Differencing {
    /// `settings` give views, mesh, memory and regions.
    pub fn new(settings: &Settings, helps: Helps, pool: Pool) -> Self {
        let settings = Settings {
            depth_vote: helps.depth_vote,
            colour_vote: false,
            view_variance: false,
            earlier_appearance: false,
            surprise_threshold: THRESHOLD_GREY,
            ..settings.clone()
        };
        Self {
            engine: CpuEngine::new(&settings, pool, Isa::detect()),
            helps,
            refiner: PoseRefiner::default(),
            memory: Memory::default(),
            prior: Prior::default(),
            settings,
        }
    }

    pub fn threshold(&self) -> f32 {
        THRESHOLD_GREY
    }

    pub fn viewpoints(&self) -> usize {
        self.memory.viewpoints().len()
    }

    /// The prediction of the last frame.
    pub fn prior(&self) -> &Prior {
        &self.prior
    }

    /// Scores a frame and, if told to, stores it.
    ///
    /// # Errors
    /// None that a pipeline would not find; the recording's frames have image and given depth of one size.
    pub fn judge(&mut self, frame: &Frame, learn: bool) -> Result<Verdict, FrameError> {
        let range = self.settings.depth_min_m..=self.settings.depth_max_m;
        let Some(given_m) = frame.depth.given_m() else {
            return Err(FrameError::NoDepth { valid_percent: 0.0 });
        };
        let depth_m: Vec<f32> = given_m
            .iter()
            .map(|&z| if range.contains(&z) { z } else { 0.0 })
            .collect();
        let observation = Observation::new(&frame.image);
        let (world_from_camera, correction_m) = self.refine(frame, &observation);
        let selected = self.select(&world_from_camera);
        let views = recall_views(&self.memory, &selected);
        self.engine.recall(
            &views,
            &frame.intrinsics,
            &world_from_camera,
            &mut self.prior,
        );
        let gain = if self.helps.exposure_gain {
            gain(&self.prior, &observation)
        } else {
            1.0
        };
        let map = difference_map(&self.prior, &observation, gain, self.helps.tolerance);
        let evidence = BlockMap::evidence(&map, frame.intrinsics.width, self.helps.evidence);
        let scene = Scene {
            depth_m: &depth_m,
            intrinsics: &frame.intrinsics,
            world_from_camera: &world_from_camera,
        };
        let regions = regions(&map, &evidence, &scene, &self.settings);
        if learn {
            self.learn(
                frame,
                &observation,
                gain,
                depth_m,
                world_from_camera,
                &selected,
            );
        }
        Ok(Verdict {
            map,
            evidence,
            regions,
            world_from_camera,
            gain,
            correction_m,
        })
    }

    fn learn(
        &mut self,
        frame: &Frame,
        observation: &Observation,
        gain: f32,
        depth_m: Vec<f32>,
        world_from_camera: Pose,
        selected: &[usize],
    ) {
        let records: Vec<Record> = (0..frame.intrinsics.pixels())
            .map(|pixel| {
                Record::pack(&Belief {
                    alpha: 1.0,
                    beta: [VARIANCE; CHANNELS],
                    tau: std::array::from_fn(|c| observation.planes[c][pixel] / gain),
                    sigma: [1.0; CHANNELS],
                    ..Belief::default()
                })
            })
            .collect();
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
        let bytes = viewpoint.bytes();
        let slot = self
            .memory
            .slot(selected, &world_from_camera, bytes, &self.settings);
        self.memory.write(slot, viewpoint);
    }

    /// Pose and how far it moved, metres.
    fn refine(&mut self, frame: &Frame, observation: &Observation) -> (Pose, f64) {
        if !self.helps.refine_pose {
            return (frame.world_from_camera, 0.0);
        }
        let noise = frame.pose_noise.unwrap_or(PoseNoise {
            position_m: self.settings.pose_position_sd_m,
            rotation_rad: self.settings.pose_rotation_sd_rad,
        });
        let mut selected = self.select(&frame.world_from_camera);
        selected.truncate(REFINE_VIEWS);
        let views: Vec<(&Coarse, &Pose, f32)> = selected
            .iter()
            .map(|&index| &self.memory.viewpoints()[index])
            .map(|viewpoint| (&viewpoint.coarse, &viewpoint.world_from_camera, 1.0))
            .collect();
        let refined = self.refiner.refine(
            &views,
            &observation.planes[0],
            &frame.intrinsics,
            &frame.world_from_camera,
            noise,
        );
        (refined.world_from_camera, refined.correction_m)
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
}

fn recall_views<'a>(memory: &'a Memory, selected: &[usize]) -> Vec<RecallView<'a>> {
    selected
        .iter()
        .map(|&index| RecallView {
            viewpoint: &memory.viewpoints()[index],
            weight: 1.0,
            fresh: false,
        })
        .collect()
}

fn gain(prior: &Prior, observation: &Observation) -> f32 {
    let width = prior.width;
    exposure_gain((0..prior.height).map(|y| {
        let row = prior.row(y);
        (
            row.plane(prior::TAU),
            row.plane(prior::COVERAGE),
            &observation.planes[0][y * width..][..width],
        )
    }))
}

/// Sum over the channels of |x/gain - tau|; with `tolerance` the least over the prediction's 3x3 seen neighbours.
fn difference_map(
    prior: &Prior,
    observation: &Observation,
    gain: f32,
    tolerance: bool,
) -> Vec<f32> {
    let Prior { width, height, .. } = *prior;
    let reach = usize::from(tolerance);
    let mut map = vec![0.0; width * height];
    for y in 0..height {
        let coverage = prior.row(y).plane(prior::COVERAGE);
        for x in (0..width).filter(|&x| coverage[x] > 0.0) {
            let observed: [f32; CHANNELS] =
                std::array::from_fn(|c| observation.planes[c][y * width + x] / gain);
            let mut least = f32::INFINITY;
            for row in y.saturating_sub(reach)..=(y + reach).min(height - 1) {
                let row = prior.row(row);
                for x in x.saturating_sub(reach)..=(x + reach).min(width - 1) {
                    if row.plane(prior::COVERAGE)[x] > 0.0 {
                        let difference: f32 = (0..CHANNELS)
                            .map(|c| (observed[c] - row.plane(prior::TAU + c)[x]).abs())
                            .sum();
                        least = least.min(difference);
                    }
                }
            }
            map[y * width + x] = least;
        }
    }
    map
}
