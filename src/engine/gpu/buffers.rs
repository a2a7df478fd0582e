//! What lies on the device: arenas of resident viewpoints, and the buffers of one image size. Every buffer carries the
//! name of the shaders' variable.

use wgpu::BufferUsages;

use super::{
    device::Device,
    layout::{Exposure, Frame, Rules, View},
    passes::{HISTOGRAM_WORDS, PASSES, Slot},
    residency::{BYTES_PER_PIXEL, Place, Residency},
};
use crate::{
    model::{
        belief::Record,
        viewpoint::{Mesh, Viewpoint},
    },
    stages::interpolate::merge::VIEWS_MAX,
};

pub const DEPTH_BYTES: u64 = size_of::<f32>() as u64;
pub const RECORD_BYTES: u64 = size_of::<Record>() as u64;
/// alpha and beta; tau and p2; sigma and depth; tau2 and coverage.
pub const PRIOR_BYTES: u64 = 4 * size_of::<f32>() as u64;
pub const EXPOSURE_BYTES: u64 = size_of::<Exposure>().next_multiple_of(16) as u64;
/// Begin and end of every pass.
pub const STAMPS_BYTES: u64 = (PASSES.len() * 2 * size_of::<u64>()) as u64;

/// At the start: seven viewpoints of 320x240.
const ARENA_PIXELS: u64 = 7 * 320 * 240;
/// At most: what seven viewpoints of 2 megapixels or 190 of 320x240 take, a share of a small card's memory.
const ARENA_BYTES_MAX: u64 = 512 << 20;

/// Of all images alike.
pub struct SharedBuffers {
    frame: wgpu::Buffer,
    rules: wgpu::Buffer,
    views: wgpu::Buffer,
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
            views: device.buffer("views", (VIEWS_MAX * size_of::<View>()) as u64, uniform),
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

    /// Returns how many bytes went up.
    pub fn upload(&self, device: &Device, frame: &Frame, views: &[View]) -> u64 {
        device.upload(&self.frame, 0, bytemuck::bytes_of(frame));
        device.upload(&self.views, 0, bytemuck::cast_slice(views));
        (size_of::<Frame>() + size_of_val(views)) as u64
    }
}

/// Depth and records of the resident viewpoints, one after the other.
pub struct Arenas {
    pub residency: Residency,
    depth: wgpu::Buffer,
    pub records: wgpu::Buffer,
}

impl Arenas {
    pub fn new(device: &Device) -> Self {
        let most = (device.buffer_max() / RECORD_BYTES).min(ARENA_BYTES_MAX / BYTES_PER_PIXEL);
        let residency = Residency::new(ARENA_PIXELS, most);
        let (depth, records) = Self::buffers(device, residency.capacity());
        Self {
            residency,
            depth,
            records,
        }
    }

    fn buffers(device: &Device, pixels: u64) -> (wgpu::Buffer, wgpu::Buffer) {
        let usage = BufferUsages::STORAGE | BufferUsages::COPY_DST | BufferUsages::COPY_SRC;
        (
            device.buffer("depth_arena", DEPTH_BYTES * pixels, usage),
            device.buffer("record_arena", RECORD_BYTES * pixels, usage),
        )
    }

    pub fn bytes(&self) -> u64 {
        self.residency.pixels() * BYTES_PER_PIXEL
    }

    /// The place of a viewpoint, within buffers that have grown to hold it.
    pub fn place(&mut self, device: &Device, viewpoint: &Viewpoint) -> Option<Place> {
        let before = self.residency.capacity();
        let pixels = viewpoint.mesh.depth_m.len() as u64;
        let version = (viewpoint.updates, viewpoint.stamp_ns);
        let place = self.residency.place(viewpoint.id, version, pixels);
        if self.residency.capacity() > before {
            let (depth, records) = Self::buffers(device, self.residency.capacity());
            let mut encoder =
                device
                    .device
                    .create_command_encoder(&wgpu::CommandEncoderDescriptor {
                        label: Some("arenas grow"),
                    });
            encoder.copy_buffer_to_buffer(&self.depth, 0, &depth, 0, DEPTH_BYTES * before);
            encoder.copy_buffer_to_buffer(&self.records, 0, &records, 0, RECORD_BYTES * before);
            device.queue.submit([encoder.finish()]);
            (self.depth, self.records) = (depth, records);
        }
        place
    }

    /// Which triangles of a pixel's quad exist goes into the two lowest bits of its depth, which moves it by less than
    /// 4e-7 of itself. Returns how many bytes went up.
    pub fn upload_mesh(&self, device: &Device, first: u64, mesh: &Mesh) -> u64 {
        let width = mesh.intrinsics.width;
        let mut words: Vec<u32> = mesh.depth_m.iter().map(|z| z.to_bits() & !3).collect();
        let quads = mesh.cut.chunks_exact((width - 1).max(1));
        for (words, quads) in words.chunks_exact_mut(width).zip(quads) {
            for (word, quad) in words.iter_mut().zip(quads) {
                *word |= u32::from(*quad);
            }
        }
        device.upload(
            &self.depth,
            DEPTH_BYTES * first,
            bytemuck::cast_slice(&words),
        );
        size_of_val(words.as_slice()) as u64
    }

    pub fn upload_records(&self, device: &Device, first: u64, records: &[Record]) -> u64 {
        device.upload(
            &self.records,
            RECORD_BYTES * first,
            bytemuck::cast_slice(records),
        );
        size_of_val(records) as u64
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
    pub fn new(device: &Device, frame: &Frame) -> Self {
        let pixels = frame.pixels();
        let views = frame.view_count.max(1);
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
    /// What every frame reads: exposure, time stamps, evidence, and the posterior if it is learnt.
    pub report: wgpu::Buffer,
}

impl ScoreBuffers {
    pub fn new(device: &Device, frame: &Frame) -> Self {
        let pixels = frame.pixels();
        let storage = BufferUsages::STORAGE | BufferUsages::COPY_DST | BufferUsages::COPY_SRC;
        Self {
            image: device.buffer("image", 3 * pixels, storage),
            surprise_map: device.buffer("surprise_map", 4 * pixels, storage),
            posterior_records: device.buffer("posterior_records", RECORD_BYTES * pixels, storage),
            block_means: device.buffer("block_means", 4 * frame.blocks(), storage),
            block_medians: device.buffer("block_medians", 4 * frame.blocks(), storage),
            report: device.buffer(
                "report",
                EXPOSURE_BYTES + STAMPS_BYTES + 4 * frame.blocks() + RECORD_BYTES * pixels,
                BufferUsages::COPY_DST | BufferUsages::MAP_READ,
            ),
        }
    }
}

/// Whether a device can hold what an image needs.
pub fn fits(device: &Device, frame: &Frame) -> bool {
    let pixels = frame.pixels();
    let largest = (RECORD_BYTES * pixels + EXPOSURE_BYTES + STAMPS_BYTES + 4 * frame.blocks())
        .max(4 * pixels * u64::from(frame.view_count));
    largest.next_multiple_of(16) <= device.buffer_max()
}

/// Everything that a pass can bind.
#[derive(Clone, Copy)]
pub struct Bound<'a> {
    pub shared: &'a SharedBuffers,
    pub arenas: &'a Arenas,
    pub recall: &'a RecallBuffers,
    pub score: Option<&'a ScoreBuffers>,
}

impl<'a> Bound<'a> {
    pub fn buffer(&self, slot: Slot) -> &'a wgpu::Buffer {
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
        }
    }
}
