//! The resident viewpoints on the device, one after the other: depth, records, and what refinement looks at.

use wgpu::BufferUsages;

use super::{
    buffers::{DEPTH_BYTES, RECORD_BYTES},
    card::Share,
    device::Device,
    residency::{BYTES_PER_PIXEL, COARSE_PIXELS, Place, Residency},
};
use crate::model::{
    belief::Record,
    viewpoint::{Coarse, Mesh, Viewpoint},
};

/// At the start: seven viewpoints of 320x240.
const ARENA_PIXELS: u64 = 7 * 320 * 240;
/// Luminance and variance.
const COARSE_LEVEL_BYTES: u64 = 2 * size_of::<f32>() as u64;

pub struct Arenas {
    pub residency: Residency,
    share: Share,
    /// Pixels of the largest recall so far.
    needed: u64,
    pub depth: wgpu::Buffer,
    pub records: wgpu::Buffer,
    pub coarse_depth: wgpu::Buffer,
    pub coarse_levels: wgpu::Buffer,
}

impl Arenas {
    pub fn new(device: &Device, share: Share) -> Self {
        let residency = Residency::new(ARENA_PIXELS, share.bytes() / BYTES_PER_PIXEL);
        let [depth, records, coarse_depth, coarse_levels] =
            Self::buffers(device, residency.capacity());
        Self {
            residency,
            share,
            needed: 0,
            depth,
            records,
            coarse_depth,
            coarse_levels,
        }
    }

    fn sizes(pixels: u64) -> [u64; 4] {
        [
            DEPTH_BYTES * pixels,
            RECORD_BYTES * pixels,
            DEPTH_BYTES * (pixels / COARSE_PIXELS),
            COARSE_LEVEL_BYTES * (pixels / COARSE_PIXELS),
        ]
    }

    fn buffers(device: &Device, pixels: u64) -> [wgpu::Buffer; 4] {
        let usage = BufferUsages::STORAGE | BufferUsages::COPY_DST | BufferUsages::COPY_SRC;
        let sizes = Self::sizes(pixels);
        let names = [
            "depth_arena",
            "record_arena",
            "coarse_depth_arena",
            "coarse_level_arena",
        ];
        std::array::from_fn(|index| device.buffer(names[index], sizes[index], usage))
    }

    fn set(&mut self, buffers: [wgpu::Buffer; 4]) {
        [
            self.depth,
            self.records,
            self.coarse_depth,
            self.coarse_levels,
        ] = buffers;
    }

    pub fn bytes(&self) -> u64 {
        self.residency.pixels() * BYTES_PER_PIXEL
    }

    /// Begins a recall. What a recall needs is granted even where the share is smaller; what the share has lost to other
    /// places is given back.
    pub fn begin<'a>(&mut self, device: &Device, viewpoints: impl Iterator<Item = &'a Viewpoint>) {
        self.needed = self.needed.max(viewpoints.map(room).sum());
        let most = device.buffer_max() / RECORD_BYTES;
        let share = self.share.bytes() / BYTES_PER_PIXEL;
        let granted = share.max(self.needed).min(most);
        let before = self.residency.capacity();
        self.residency.begin(granted);
        if self.residency.capacity() < before {
            self.set(Self::buffers(device, self.residency.capacity()));
        }
    }

    /// The place of a viewpoint, within buffers that have grown to hold it.
    pub fn place(&mut self, device: &Device, viewpoint: &Viewpoint) -> Option<Place> {
        let before = self.residency.capacity();
        let version = (viewpoint.updates, viewpoint.stamp_ns);
        let place = self.residency.place(viewpoint.id, version, room(viewpoint));
        if self.residency.capacity() > before {
            let grown = Self::buffers(device, self.residency.capacity());
            let mut encoder =
                device
                    .device
                    .create_command_encoder(&wgpu::CommandEncoderDescriptor {
                        label: Some("arenas grow"),
                    });
            let held = [
                &self.depth,
                &self.records,
                &self.coarse_depth,
                &self.coarse_levels,
            ];
            for ((from, to), bytes) in held.into_iter().zip(&grown).zip(Self::sizes(before)) {
                encoder.copy_buffer_to_buffer(from, 0, to, 0, bytes);
            }
            device.queue.submit([encoder.finish()]);
            self.set(grown);
        }
        place
    }

    /// Depth and what refinement looks at. Returns how many bytes went up.
    pub fn upload_meshes(&self, device: &Device, first: u64, viewpoint: &Viewpoint) -> u64 {
        let coarse_first = first / COARSE_PIXELS;
        let Coarse {
            mesh,
            luminance,
            variance,
        } = &viewpoint.coarse;
        let levels: Vec<[f32; 2]> = luminance
            .iter()
            .zip(variance)
            .map(|(&luminance, &variance)| [luminance, variance])
            .collect();
        device.upload(
            &self.coarse_levels,
            COARSE_LEVEL_BYTES * coarse_first,
            bytemuck::cast_slice(&levels),
        );
        size_of_val(levels.as_slice()) as u64
            + upload_mesh(device, &self.coarse_depth, coarse_first, mesh)
            + upload_mesh(device, &self.depth, first, &viewpoint.mesh)
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

/// Pixels that a viewpoint takes: whole coarse ones.
fn room(viewpoint: &Viewpoint) -> u64 {
    (viewpoint.mesh.depth_m.len() as u64).next_multiple_of(COARSE_PIXELS)
}

/// Which triangles of a pixel's quad exist goes into the two lowest bits of its depth, which moves it by less than 4e-7
/// of itself. Returns how many bytes went up.
fn upload_mesh(device: &Device, depth: &wgpu::Buffer, first: u64, mesh: &Mesh) -> u64 {
    let width = mesh.intrinsics.width.max(1);
    let mut words: Vec<u32> = mesh.depth_m.iter().map(|z| z.to_bits() & !3).collect();
    let quads = mesh.cut.chunks_exact((width - 1).max(1));
    for (words, quads) in words.chunks_exact_mut(width).zip(quads) {
        for (word, quad) in words.iter_mut().zip(quads) {
            *word |= u32::from(*quad);
        }
    }
    device.upload(depth, DEPTH_BYTES * first, bytemuck::cast_slice(&words));
    size_of_val(words.as_slice()) as u64
}
