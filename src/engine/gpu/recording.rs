//! A list of passes that is being recorded for one submission.

use super::{
    buffers::{Bound, STAMPS_BYTES},
    device::Device,
    layout::Frame,
    passes::{MERGE_VIEWS, PASSES, PROJECT_DEPTH, PROJECT_TRIANGLE, Pass},
};
use crate::{engine::cpu::RecallView, model::camera::Intrinsics};

pub struct Passes<'a> {
    device: &'a Device,
    encoder: wgpu::CommandEncoder,
    queries: Option<&'a wgpu::QuerySet>,
    /// The labels of those so far.
    run: Vec<&'static str>,
}

/// A pipeline over so many invocations.
#[derive(Clone, Copy)]
pub struct Dispatch<'a> {
    pub pass: usize,
    pub bound: Bound<'a>,
    pub invocations: [u64; 3],
}

/// What was submitted.
pub struct Submitted {
    pub labels: Vec<&'static str>,
    pub index: wgpu::SubmissionIndex,
}

impl<'a> Passes<'a> {
    pub fn new(device: &'a Device, queries: Option<&'a wgpu::QuerySet>, label: &str) -> Self {
        let descriptor = wgpu::CommandEncoderDescriptor { label: Some(label) };
        Self {
            encoder: device.device.create_command_encoder(&descriptor),
            device,
            queries,
            run: Vec::new(),
        }
    }

    /// Project and merge.
    pub fn recall(&mut self, bound: Bound, frame: &Frame, views: &[RecallView]) {
        let cameras = views.iter().map(|view| &view.viewpoint.mesh.intrinsics);
        self.project([PROJECT_DEPTH, PROJECT_TRIANGLE], bound, frame, cameras);
        let pixels = [u64::from(frame.width), u64::from(frame.height), 1];
        self.run(MERGE_VIEWS, bound, pixels);
    }

    /// Draws the views' maps.
    pub fn project<'b>(
        &mut self,
        passes: [usize; 2],
        bound: Bound,
        frame: &Frame,
        cameras: impl Iterator<Item = &'b Intrinsics> + Clone,
    ) {
        let views = u64::from(frame.view_count);
        let map_bytes = 4 * frame.pixels() * views;
        for map in [&bound.recall.nearest, &bound.recall.triangles] {
            self.encoder.clear_buffer(map, 0, Some(map_bytes));
        }
        let quads = |side: fn(&Intrinsics) -> usize| {
            let sides = cameras.clone().map(side);
            sides.max().unwrap_or(0).saturating_sub(1) as u64
        };
        let quads = [quads(|i| i.width), quads(|i| i.height), views];
        for pass in passes {
            self.run(pass, bound, quads);
        }
    }

    /// One pass.
    pub fn run(&mut self, pass: usize, bound: Bound, invocations: [u64; 3]) {
        let dispatch = Dispatch {
            pass,
            bound,
            invocations,
        };
        self.run_all(PASSES[pass].label, &[dispatch]);
    }

    /// One pass of several dispatches, each of which sees what those before it have written.
    pub fn run_all(&mut self, label: &'static str, dispatches: &[Dispatch]) {
        let some = |dispatch: &&Dispatch| !dispatch.invocations.contains(&0);
        if dispatches.iter().filter(some).count() == 0 {
            return;
        }
        let first = 2 * self.run.len() as u32;
        let mut compute = self
            .encoder
            .begin_compute_pass(&wgpu::ComputePassDescriptor {
                label: Some(label),
                timestamp_writes: self
                    .queries
                    .map(|query_set| wgpu::ComputePassTimestampWrites {
                        query_set,
                        beginning_of_pass_write_index: Some(first),
                        end_of_pass_write_index: Some(first + 1),
                    }),
            });
        // Of each pass and level.
        let mut groups: Vec<((usize, usize), wgpu::BindGroup)> = Vec::new();
        for dispatch in dispatches.iter().filter(some) {
            let key = (dispatch.pass, dispatch.bound.level);
            let known = groups.iter().position(|(other, _)| *other == key);
            let known = known.unwrap_or_else(|| {
                let group = bind_group(self.device, dispatch.pass, dispatch.bound);
                groups.push((key, group));
                groups.len() - 1
            });
            compute.set_pipeline(&self.device.pipelines[dispatch.pass]);
            compute.set_bind_group(0, &groups[known].1, &[]);
            let size = |axis: usize| {
                let workgroup = PASSES[dispatch.pass].workgroup[axis];
                dispatch.invocations[axis].div_ceil(workgroup.into()) as u32
            };
            compute.dispatch_workgroups(size(0), size(1), size(2));
        }
        drop(compute);
        self.run.push(label);
    }

    pub fn clear(&mut self, buffer: &wgpu::Buffer) {
        self.encoder.clear_buffer(buffer, 0, None);
    }

    /// The whole of `from`, `bytes`, to a place in `to`.
    pub fn copy(&mut self, from: &wgpu::Buffer, to: &wgpu::Buffer, at: u64, bytes: u64) {
        self.encoder.copy_buffer_to_buffer(from, 0, to, at, bytes);
    }

    /// The time stamps of the passes so far.
    pub fn resolve(&mut self, stamps: &wgpu::Buffer, to: &wgpu::Buffer, at: u64) {
        if let Some(queries) = self.queries {
            let count = 2 * self.run.len() as u32;
            self.encoder.resolve_query_set(queries, 0..count, stamps, 0);
            self.copy(stamps, to, at, STAMPS_BYTES);
        }
    }

    pub fn submit(self) -> Submitted {
        Submitted {
            index: self.device.queue.submit([self.encoder.finish()]),
            labels: self.run,
        }
    }
}

fn bind_group(device: &Device, pass: usize, bound: Bound) -> wgpu::BindGroup {
    let Pass {
        label, bindings, ..
    } = &PASSES[pass];
    let entries: Vec<wgpu::BindGroupEntry> = bindings
        .iter()
        .map(|&(binding, slot)| wgpu::BindGroupEntry {
            binding,
            resource: bound.resource(slot),
        })
        .collect();
    device.device.create_bind_group(&wgpu::BindGroupDescriptor {
        label: Some(label),
        layout: &device.pipelines[pass].get_bind_group_layout(0),
        entries: &entries,
    })
}

/// Seconds of each pass, from the time stamps that were resolved.
pub fn pass_seconds(
    device: &Device,
    labels: &[&'static str],
    stamps: &[u8],
) -> Vec<(&'static str, f64)> {
    let period_s = f64::from(device.queue.get_timestamp_period()) * 1e-9;
    let stamps: Vec<u64> = bytemuck::pod_collect_to_vec(stamps);
    labels
        .iter()
        .zip(stamps.chunks_exact(2))
        .map(|(&label, ends)| {
            let ticks = ends[1].saturating_sub(ends[0]);
            (label, ticks as f64 * period_s)
        })
        .collect()
}
