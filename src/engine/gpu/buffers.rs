//! What lies on the device beside the resident viewpoints: what all images share, and the buffers of one image size.
//! Every buffer carries the name of the shaders' variable.

use wgpu::BufferUsages;

use super::{
    arenas::Arenas,
    device::Device,
    layout::{Estimate, Exposure, Frame, Level, Rules, View},
    passes::{HISTOGRAM_WORDS, PASSES, REFINE_PIXELS, REFINE_THREADS, SUMS, Slot},
};
use crate::{
    model::{belief::Record, viewpoint::VIEWS_MAX},
    stages::refine::LEVELS_MAX,
};

pub const DEPTH_BYTES: u64 = size_of::<f32>() as u64;
pub const RECORD_BYTES: u64 = size_of::<Record>() as u64;
/// alpha and beta; tau and p2; sigma and depth; tau2 and coverage.
pub const PRIOR_BYTES: u64 = 4 * size_of::<f32>() as u64;
pub const EXPOSURE_BYTES: u64 = size_of::<Exposure>().next_multiple_of(16) as u64;
pub const ESTIMATE_BYTES: u64 = size_of::<Estimate>() as u64;
const VIEWS_BYTES: u64 = (VIEWS_MAX * size_of::<View>()) as u64;
/// Luminance, variance, depth and observation.
const PYRAMID_BYTES: u64 = 4 * size_of::<f32>() as u64;
/// Levels lie as far apart as every device allows bindings to begin.
const LEVEL_STRIDE: u64 = 256;
/// Begin and end of every pass.
pub const STAMPS_BYTES: u64 = (PASSES.len() * 2 * size_of::<u64>()) as u64;
/// What of a report does not depend on the image's size.
pub const REPORT_HEAD_BYTES: u64 = EXPOSURE_BYTES + ESTIMATE_BYTES + STAMPS_BYTES;

/// Of all images alike.
pub struct SharedBuffers {
    frame: wgpu::Buffer,
    rules: wgpu::Buffer,
    views: wgpu::Buffer,
    given_views: wgpu::Buffer,
    half_frame: wgpu::Buffer,
    coarse_views: wgpu::Buffer,
    levels: wgpu::Buffer,
    pub estimate: wgpu::Buffer,
    pub histogram: wgpu::Buffer,
    pub exposure: wgpu::Buffer,
    pub stamps: wgpu::Buffer,
}

impl SharedBuffers {
    pub fn new(device: &Device, rules: &Rules) -> Self {
        let uniform = BufferUsages::UNIFORM | BufferUsages::COPY_DST;
        let storage = BufferUsages::STORAGE | BufferUsages::COPY_DST;
        let shared = Self {
            frame: device.buffer("frame", size_of::<Frame>() as u64, uniform),
            rules: device.buffer("rules", size_of::<Rules>() as u64, uniform),
            views: device.buffer("views", VIEWS_BYTES, uniform | BufferUsages::STORAGE),
            given_views: device.buffer("given_views", VIEWS_BYTES, uniform),
            half_frame: device.buffer("half_frame", size_of::<Frame>() as u64, uniform),
            coarse_views: device.buffer("coarse_views", VIEWS_BYTES, uniform),
            levels: device.buffer("levels", LEVEL_STRIDE * LEVELS_MAX as u64, uniform),
            estimate: device.buffer(
                "estimate",
                ESTIMATE_BYTES,
                storage | BufferUsages::UNIFORM | BufferUsages::COPY_SRC,
            ),
            histogram: device.buffer("histogram", 4 * HISTOGRAM_WORDS, storage),
            exposure: device.buffer(
                "exposure",
                EXPOSURE_BYTES,
                storage | BufferUsages::UNIFORM | BufferUsages::COPY_SRC,
            ),
            stamps: device.buffer(
                "stamps",
                STAMPS_BYTES,
                BufferUsages::QUERY_RESOLVE | BufferUsages::COPY_SRC,
            ),
        };
        device.upload(&shared.rules, 0, bytemuck::bytes_of(rules));
        shared
    }

    /// Returns how many bytes went up. `given`: the views are placed anew when the pose is refined.
    pub fn upload(&self, device: &Device, frame: &Frame, views: &[View], given: bool) -> u64 {
        let to = if given {
            &self.given_views
        } else {
            &self.views
        };
        device.upload(&self.frame, 0, bytemuck::bytes_of(frame));
        device.upload(to, 0, bytemuck::cast_slice(views));
        (size_of::<Frame>() + size_of_val(views)) as u64
    }

    /// The same for refinement.
    pub fn upload_coarse(
        &self,
        device: &Device,
        half: &Frame,
        views: &[View],
        levels: &[Level],
    ) -> u64 {
        device.upload(&self.half_frame, 0, bytemuck::bytes_of(half));
        device.upload(&self.coarse_views, 0, bytemuck::cast_slice(views));
        for (at, level) in (0..).step_by(LEVEL_STRIDE as usize).zip(levels) {
            device.upload(&self.levels, at, bytemuck::bytes_of(level));
        }
        (size_of::<Frame>() + size_of_val(views) + size_of_val(levels)) as u64
    }
}

/// The prior of one image size, and the maps that it is made from.
pub struct RecallBuffers {
    pub width: u32,
    pub height: u32,
    /// Maps of so many views.
    pub views: u32,
    pub nearest: wgpu::Buffer,
    pub triangles: wgpu::Buffer,
    pub prior: [wgpu::Buffer; 4],
    /// Where the prior and surprise map are read from, a plane at a time.
    pub plane: wgpu::Buffer,
}

impl RecallBuffers {
    /// With maps of so many views.
    pub fn new(device: &Device, frame: &Frame, views: u32) -> Self {
        let pixels = frame.pixels();
        let views = views.max(1);
        let storage = BufferUsages::STORAGE | BufferUsages::COPY_DST | BufferUsages::COPY_SRC;
        let map = |label| device.buffer(label, 4 * pixels * u64::from(views), storage);
        let names = [
            Slot::PriorSpread,
            Slot::PriorLevel,
            Slot::PriorSigma,
            Slot::PriorEarlier,
        ];
        Self {
            width: frame.width,
            height: frame.height,
            views,
            nearest: map("nearest"),
            triangles: map("triangles"),
            prior: names.map(|slot| device.buffer(slot.name(), PRIOR_BYTES * pixels, storage)),
            plane: device.buffer(
                "plane",
                PRIOR_BYTES * pixels,
                BufferUsages::COPY_DST | BufferUsages::MAP_READ,
            ),
        }
    }
}

/// What a frame of one size is turned into.
pub struct ScoreBuffers {
    pub image: wgpu::Buffer,
    pub surprise_map: wgpu::Buffer,
    pub posterior_records: wgpu::Buffer,
    pub block_means: wgpu::Buffer,
    pub block_medians: wgpu::Buffer,
    pub pyramid: wgpu::Buffer,
    pub partial_sums: wgpu::Buffer,
    /// What every frame reads: exposure, estimate, time stamps, evidence, and the posterior if it is learnt.
    pub report: wgpu::Buffer,
}

impl ScoreBuffers {
    pub fn new(device: &Device, frame: &Frame) -> Self {
        let pixels = frame.pixels();
        let half = u64::from(frame.width / 2) * u64::from(frame.height / 2);
        let groups = half.div_ceil(u64::from(REFINE_THREADS * REFINE_PIXELS));
        let storage = BufferUsages::STORAGE | BufferUsages::COPY_DST | BufferUsages::COPY_SRC;
        Self {
            image: device.buffer("image", 3 * pixels, storage),
            surprise_map: device.buffer("surprise_map", 4 * pixels, storage),
            posterior_records: device.buffer("posterior_records", RECORD_BYTES * pixels, storage),
            block_means: device.buffer("block_means", 4 * frame.blocks(), storage),
            block_medians: device.buffer("block_medians", 4 * frame.blocks(), storage),
            pyramid: device.buffer("pyramid", PYRAMID_BYTES * (half + half / 2), storage),
            partial_sums: device.buffer("partial_sums", 4 * u64::from(SUMS) * groups, storage),
            report: device.buffer(
                "report",
                REPORT_HEAD_BYTES + 4 * frame.blocks() + RECORD_BYTES * pixels,
                BufferUsages::COPY_DST | BufferUsages::MAP_READ,
            ),
        }
    }
}

/// Whether a device can hold what an image needs, with maps of so many views.
pub fn fits(device: &Device, frame: &Frame, views: u32) -> bool {
    let pixels = frame.pixels();
    let largest = (REPORT_HEAD_BYTES + 4 * frame.blocks() + RECORD_BYTES * pixels)
        .max(4 * pixels * u64::from(views));
    largest.next_multiple_of(16) <= device.buffer_max()
}

/// Everything that a pass can bind.
#[derive(Clone, Copy)]
pub struct Bound<'a> {
    pub shared: &'a SharedBuffers,
    pub arenas: &'a Arenas,
    pub recall: &'a RecallBuffers,
    pub score: Option<&'a ScoreBuffers>,
    /// Of the pyramid.
    pub level: usize,
}

impl<'a> Bound<'a> {
    pub fn resource(&self, slot: Slot) -> wgpu::BindingResource<'a> {
        let buffer = self.buffer(slot);
        if slot == Slot::Level {
            return wgpu::BindingResource::Buffer(wgpu::BufferBinding {
                buffer,
                offset: LEVEL_STRIDE * self.level as u64,
                size: wgpu::BufferSize::new(size_of::<Level>() as u64),
            });
        }
        buffer.as_entire_binding()
    }

    fn buffer(&self, slot: Slot) -> &'a wgpu::Buffer {
        let score = || self.score.expect("only a frame is scored");
        match slot {
            Slot::Frame => &self.shared.frame,
            Slot::Rules => &self.shared.rules,
            Slot::Views => &self.shared.views,
            Slot::DepthArena => &self.arenas.depth,
            Slot::RecordArena => &self.arenas.records,
            Slot::Nearest => &self.recall.nearest,
            Slot::Triangles => &self.recall.triangles,
            Slot::PriorSpread => &self.recall.prior[0],
            Slot::PriorLevel => &self.recall.prior[1],
            Slot::PriorSigma => &self.recall.prior[2],
            Slot::PriorEarlier => &self.recall.prior[3],
            Slot::Image => &score().image,
            Slot::Histogram => &self.shared.histogram,
            Slot::Exposure => &self.shared.exposure,
            Slot::SurpriseMap => &score().surprise_map,
            Slot::PosteriorRecords => &score().posterior_records,
            Slot::BlockMeans => &score().block_means,
            Slot::BlockMedians => &score().block_medians,
            Slot::HalfFrame => &self.shared.half_frame,
            Slot::CoarseViews => &self.shared.coarse_views,
            Slot::CoarseDepthArena => &self.arenas.coarse_depth,
            Slot::LevelArena => &self.arenas.coarse_levels,
            Slot::Level => &self.shared.levels,
            Slot::Pyramid => &score().pyramid,
            Slot::PartialSums => &score().partial_sums,
            Slot::Estimate => &self.shared.estimate,
            Slot::GivenViews => &self.shared.given_views,
        }
    }
}
