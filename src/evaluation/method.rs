//! What is compared: a preset's pipeline and image differencing behind one door.

use crate::{
    config::Settings,
    engine::Engines,
    evaluation::differencing::{Differencing, Helps},
    model::{
        camera::Intrinsics,
        frame::{Frame, FrameError},
        pose::Pose,
        report::{PixelBox, Region},
    },
    pipeline::Pipeline,
    stages::{
        attend::{BlockMap, Scene, regions},
        interpolate::prior::{self, Prior},
    },
};

/// What a method says about a frame.
#[derive(Debug, Clone)]
pub struct Verdict {
    /// A score a pixel: nats, or grey levels for differencing; 0 where unseen.
    pub map: Vec<f32>,
    /// What is judged: a score a block.
    pub evidence: BlockMap,
    /// Above the method's threshold.
    pub regions: Vec<Region>,
    pub world_from_camera: Pose,
    /// What the observation was divided by.
    pub gain: f32,
    /// Pose correction, metres.
    pub correction_m: f64,
}

impl Verdict {
    /// The box of the most surprising region, however little surprising it is (section V-C).
    pub fn best_box(&self, frame: &Frame, settings: &Settings) -> Option<PixelBox> {
        let lenient = Settings {
            surprise_threshold: 0.0,
            regions_max: 1,
            ..settings.clone()
        };
        let scene = Scene {
            depth_m: frame
                .depth
                .given_m()
                .expect("a recording's frames have depth"),
            intrinsics: &frame.intrinsics,
            world_from_camera: &self.world_from_camera,
        };
        regions(&self.map, &self.evidence, &scene, &lenient)
            .first()
            .map(|region| region.pixel_box)
    }
}

/// Which method.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MethodKind {
    /// The settings under test.
    Preset,
    /// Plain image differencing, as the paper compares with.
    Diff,
    /// Image differencing with every help that the settings under test have.
    DiffAll,
}

pub enum Method {
    Preset(Box<Pipeline>),
    Difference(Box<Differencing>),
}

impl Method {
    /// Image differencing computes on the processor, whatever the engines are.
    pub fn new(kind: MethodKind, settings: &Settings, engines: &Engines) -> Self {
        let differencing = |helps| {
            let differencing = Differencing::new(settings, helps, engines.pool().clone());
            Self::Difference(Box::new(differencing))
        };
        match kind {
            MethodKind::Preset => Self::Preset(Box::new(Pipeline::on(engines, settings.clone()))),
            MethodKind::Diff => differencing(Helps::NONE),
            MethodKind::DiffAll => differencing(Helps::of(settings)),
        }
    }

    /// Judges a frame and, if told to, learns it.
    ///
    /// # Errors
    /// A frame that cannot be used.
    pub fn judge(&mut self, frame: &Frame, learn: bool) -> Result<Verdict, FrameError> {
        match self {
            Self::Preset(pipeline) => {
                let report = if learn {
                    pipeline.process(frame)?
                } else {
                    pipeline.evaluate(frame)?
                };
                let maps = pipeline.maps();
                Ok(Verdict {
                    map: maps.score.surprise.clone(),
                    evidence: maps.evidence.clone(),
                    regions: report.regions,
                    world_from_camera: report.world_from_camera,
                    gain: maps.score.gain,
                    correction_m: report.pose_correction_m,
                })
            }
            Self::Difference(differencing) => differencing.judge(frame, learn),
        }
    }

    /// The prediction that the last frame was compared with.
    pub fn prior(&self) -> &Prior {
        match self {
            Self::Preset(pipeline) => &pipeline.maps().prior,
            Self::Difference(differencing) => differencing.prior(),
        }
    }

    /// Score from which a block is reported.
    pub fn threshold(&self) -> f32 {
        match self {
            Self::Preset(pipeline) => pipeline.settings().surprise_threshold,
            Self::Difference(differencing) => differencing.threshold(),
        }
    }

    pub fn viewpoints(&self) -> usize {
        match self {
            Self::Preset(pipeline) => pipeline.memory().viewpoints().len(),
            Self::Difference(differencing) => differencing.viewpoints(),
        }
    }

    /// Mean of |Y - tau_Y| over the seen pixels of a mask, grey levels; `None` where none is seen.
    pub fn error_in(&self, frame: &Frame, gain: f32, mask: &[bool]) -> Option<f64> {
        let Intrinsics { width, .. } = frame.intrinsics;
        let prior = self.prior();
        let (mut sum, mut count) = (0.0, 0usize);
        for (pixel, rgb) in frame.image.data.chunks_exact(3).enumerate() {
            let row = prior.row(pixel / width);
            let x = pixel % width;
            if mask[pixel] && row.plane(prior::COVERAGE)[x] > 0.0 {
                let [y, ..] =
                    crate::model::belief::ycbcr_from_rgb([rgb[0], rgb[1], rgb[2]].map(f32::from));
                sum += f64::from((y / gain - row.plane(prior::TAU)[x]).abs());
                count += 1;
            }
        }
        (count > 0).then(|| sum / count as f64)
    }
}
