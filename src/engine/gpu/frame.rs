//! One device's work: viewpoints are brought, passes are recorded and submitted, the report is read. Whatever is here is
//! lost with the device, and can be made again from the memory.

use super::{
    Counters,
    buffers::{
        Arenas, Bound, EXPOSURE_BYTES, PRIOR_BYTES, RECORD_BYTES, RecallBuffers, STAMPS_BYTES,
        ScoreBuffers, SharedBuffers, fits,
    },
    device::{Device, Lost},
    layout::{Exposure, Frame, Rules, View},
    passes::{
        BLOCK_MEANS, BLOCK_MEDIANS, EXPOSE, EXPOSE_PIXELS, GAIN, MERGE_VIEWS, PASSES,
        PROJECT_DEPTH, PROJECT_TRIANGLE, Pass, SCORE_PIXELS,
    },
    residency::Place,
};
use crate::{
    config::Evidence,
    engine::cpu::{RecallView, Score},
    model::{
        belief::{Belief, Record},
        camera::Intrinsics,
        frame::RgbImage,
        pose::Pose,
        viewpoint::Viewpoint,
    },
    stages::{
        attend::BlockMap,
        interpolate::prior::{PLANES, Prior, put},
    },
};

/// Image sizes whose buffers are kept: the cameras of a mixed fleet.
const SIZES_MAX: usize = 4;

/// Why a device did not do what it was asked to.
#[derive(Debug)]
pub enum Failure {
    Lost(Lost),
    /// The image, or its viewpoints, do not fit.
    TooLarge,
}

impl From<Lost> for Failure {
    fn from(lost: Lost) -> Self {
        Self::Lost(lost)
    }
}

/// What is wanted of a frame beside its evidence.
#[derive(Debug, Clone, Copy)]
pub struct Wanted {
    pub evidence: Evidence,
    pub posterior: bool,
    /// The surprise map, if a block inside this border, pixels, has more nats than this.
    pub surprise_from: (usize, f32),
}

pub struct Report {
    pub evidence: BlockMap,
    pub seen: usize,
}

pub struct State {
    pub device: Device,
    shared: SharedBuffers,
    arenas: Arenas,
    queries: Option<wgpu::QuerySet>,
    /// The last used at the end.
    sizes: Vec<(RecallBuffers, ScoreBuffers)>,
    /// Whether the last of `sizes` holds the maps of the last frame.
    has_maps: bool,
}

impl State {
    pub fn new(device: Device, rules: &Rules) -> Self {
        let queries = device.timed.then(|| {
            device.device.create_query_set(&wgpu::QuerySetDescriptor {
                label: Some("stamps"),
                ty: wgpu::QueryType::Timestamp,
                count: 2 * PASSES.len() as u32,
            })
        });
        Self {
            shared: SharedBuffers::new(&device, rules),
            arenas: Arenas::new(&device),
            queries,
            sizes: Vec::new(),
            has_maps: false,
            device,
        }
    }

    /// Compares an image with what the views expect. `score` gets the gain and what is wanted.
    #[allow(clippy::too_many_arguments)]
    pub fn compare(
        &mut self,
        views: &[RecallView],
        intrinsics: &Intrinsics,
        world_from_camera: &Pose,
        image: &RgbImage,
        wanted: Wanted,
        score: &mut Score,
        counters: &mut Counters,
    ) -> Result<Report, Failure> {
        let frame = Frame::new(intrinsics.width, intrinsics.height, views.len());
        if !fits(&self.device, &frame) {
            return Err(Failure::TooLarge);
        }
        self.has_maps = false;
        let placed = self.bring(views, intrinsics, world_from_camera, counters)?;
        self.take_size(&frame);
        let (recall, buffers) = self.sizes.last().expect("the size was just taken");
        let bound = Bound {
            shared: &self.shared,
            arenas: &self.arenas,
            recall,
            score: Some(buffers),
        };
        counters.uploaded_bytes += self.shared.upload(&self.device, &frame, &placed);
        self.device.upload(&buffers.image, 0, &image.data);
        counters.uploaded_bytes += image.data.len() as u64;

        let mut passes = Passes::new(&self.device, self.queries.as_ref(), "frame");
        passes.recall(bound, &frame, views);
        passes.clear(&self.shared.histogram);
        let pixels = [u64::from(frame.width), u64::from(frame.height), 1];
        let strided = frame.pixels().div_ceil(u64::from(EXPOSE_PIXELS));
        passes.run(EXPOSE, bound, [strided, 1, 1]);
        passes.run(GAIN, bound, [1, 1, 1]);
        passes.run(SCORE_PIXELS, bound, pixels);
        let blocks = [
            u64::from(frame.blocks_wide),
            u64::from(frame.blocks_high),
            1,
        ];
        passes.run(BLOCK_MEANS, bound, blocks);
        let evidence = match wanted.evidence {
            Evidence::Blocks => &buffers.block_means,
            Evidence::BlockMedian => {
                passes.run(BLOCK_MEDIANS, bound, blocks);
                &buffers.block_medians
            }
        };
        let evidence_at = EXPOSURE_BYTES + STAMPS_BYTES;
        let posterior_at = evidence_at + 4 * frame.blocks();
        passes.copy(&self.shared.exposure, &buffers.report, 0, EXPOSURE_BYTES);
        passes.resolve(&self.shared.stamps, &buffers.report, EXPOSURE_BYTES);
        passes.copy(evidence, &buffers.report, evidence_at, 4 * frame.blocks());
        let mut bytes = posterior_at;
        if wanted.posterior {
            let records = RECORD_BYTES * frame.pixels();
            passes.copy(
                &buffers.posterior_records,
                &buffers.report,
                posterior_at,
                records,
            );
            bytes += records;
        }
        let run = passes.submit();
        counters.passes += run.len() as u64;
        let read = self.device.read(&buffers.report, bytes)?;
        counters.read_back_bytes += bytes;

        let (head, posterior) = read.split_at(posterior_at as usize);
        let exposure: Exposure = bytemuck::pod_read_unaligned(&head[..size_of::<Exposure>()]);
        score.gain = exposure.gain;
        if self.queries.is_some() {
            let stamps: Vec<u64> =
                bytemuck::pod_collect_to_vec(&head[EXPOSURE_BYTES as usize..evidence_at as usize]);
            let period_s = f64::from(self.device.queue.get_timestamp_period()) * 1e-9;
            counters.pass_seconds = run
                .iter()
                .zip(stamps.chunks_exact(2))
                .map(|(&pass, ends)| {
                    let ticks = ends[1].saturating_sub(ends[0]);
                    (PASSES[pass].label, ticks as f64 * period_s)
                })
                .collect();
        }
        let evidence = BlockMap {
            width: frame.blocks_wide as usize,
            height: frame.blocks_high as usize,
            data: bytemuck::pod_collect_to_vec(&head[evidence_at as usize..]),
        };
        score.posterior.clear();
        if wanted.posterior {
            score.posterior = bytemuck::pod_collect_to_vec::<u8, Record>(posterior);
        }
        score.surprise.clear();
        let (border_px, threshold) = wanted.surprise_from;
        if evidence
            .inside(border_px)
            .any(|(_, _, nats)| nats > threshold)
        {
            score.surprise = self.plane(&buffers.surprise_map, 4 * frame.pixels())?;
            counters.read_back_bytes += 4 * frame.pixels();
        }
        self.has_maps = true;
        Ok(Report {
            evidence,
            seen: exposure.seen as usize,
        })
    }

    /// The prior at a pose; the maps of the last frame stay.
    pub fn recall(
        &mut self,
        views: &[RecallView],
        intrinsics: &Intrinsics,
        world_from_camera: &Pose,
        prior: &mut Prior,
        counters: &mut Counters,
    ) -> Result<(), Failure> {
        let frame = Frame::new(intrinsics.width, intrinsics.height, views.len());
        if !fits(&self.device, &frame) {
            return Err(Failure::TooLarge);
        }
        let placed = self.bring(views, intrinsics, world_from_camera, counters)?;
        let recall = RecallBuffers::new(&self.device, &frame);
        let bound = Bound {
            shared: &self.shared,
            arenas: &self.arenas,
            recall: &recall,
            score: None,
        };
        counters.uploaded_bytes += self.shared.upload(&self.device, &frame, &placed);
        let mut passes = Passes::new(&self.device, None, "recall");
        passes.recall(bound, &frame, views);
        counters.passes += passes.submit().len() as u64;
        counters.read_back_bytes += 4 * PRIOR_BYTES * frame.pixels();
        self.read_prior(&recall, prior)?;
        Ok(())
    }

    /// The maps of the last frame that was compared.
    pub fn maps(&self, prior: &mut Prior, score: &mut Score) -> Result<(), Failure> {
        let sizes = self.sizes.last().filter(|_| self.has_maps);
        let (recall, buffers) =
            sizes.ok_or_else(|| Lost("the maps were lost with their device".to_owned()))?;
        self.read_prior(recall, prior)?;
        let pixels = u64::from(recall.width) * u64::from(recall.height);
        score.surprise = self.plane(&buffers.surprise_map, 4 * pixels)?;
        let mut passes = Passes::new(&self.device, None, "posterior");
        passes.copy(
            &buffers.posterior_records,
            &buffers.report,
            0,
            RECORD_BYTES * pixels,
        );
        passes.submit();
        let records = self.device.read(&buffers.report, RECORD_BYTES * pixels)?;
        score.posterior = bytemuck::pod_collect_to_vec(&records);
        Ok(())
    }

    /// Keeps the posterior of the last frame, which has become this viewpoint, where the next recall finds it.
    pub fn remember(&mut self, viewpoint: &Viewpoint, counters: &mut Counters) {
        let intrinsics = viewpoint.mesh.intrinsics;
        let size = (intrinsics.width as u32, intrinsics.height as u32);
        let is_last = |(recall, _): &&(RecallBuffers, ScoreBuffers)| {
            self.has_maps && (recall.width, recall.height) == size
        };
        let Some((_, buffers)) = self.sizes.last().filter(is_last) else {
            return;
        };
        self.arenas.residency.begin();
        // Without room the next recall brings it.
        if let Some(Place::Empty(first)) = self.arenas.place(&self.device, viewpoint) {
            counters.uploaded_bytes +=
                self.arenas
                    .upload_mesh(&self.device, first, &viewpoint.mesh);
            let mut passes = Passes::new(&self.device, None, "remember");
            passes.copy(
                &buffers.posterior_records,
                &self.arenas.records,
                RECORD_BYTES * first,
                RECORD_BYTES * intrinsics.pixels() as u64,
            );
            passes.submit();
        }
        counters.resident_bytes = self.arenas.bytes();
    }

    /// Viewpoints changed elsewhere: the next recall brings what it needs.
    pub fn forget(&mut self) {
        self.arenas.residency.clear();
    }

    /// Brings the views that are not there, and says where all of them are.
    fn bring(
        &mut self,
        views: &[RecallView],
        intrinsics: &Intrinsics,
        world_from_camera: &Pose,
        counters: &mut Counters,
    ) -> Result<Vec<View>, Failure> {
        let placed = match self.place_all(views, counters) {
            Some(placed) => placed,
            None => {
                // There may be room, but in pieces.
                self.arenas.residency.clear();
                self.place_all(views, counters).ok_or(Failure::TooLarge)?
            }
        };
        counters.resident_bytes = self.arenas.bytes();
        counters.evicted = self.arenas.residency.evicted();
        Ok(views
            .iter()
            .zip(placed)
            .map(|(view, first)| {
                View::new(
                    view.viewpoint,
                    intrinsics,
                    world_from_camera,
                    first as u32,
                    view.weight,
                    view.fresh,
                )
            })
            .collect())
    }

    fn place_all(&mut self, views: &[RecallView], counters: &mut Counters) -> Option<Vec<u64>> {
        self.arenas.residency.begin();
        views
            .iter()
            .map(|view| {
                Some(match self.arenas.place(&self.device, view.viewpoint)? {
                    Place::Held(first) => first,
                    Place::Empty(first) => {
                        let viewpoint = view.viewpoint;
                        counters.views_brought += 1;
                        counters.uploaded_bytes +=
                            self.arenas
                                .upload_mesh(&self.device, first, &viewpoint.mesh)
                                + self.arenas.upload_records(
                                    &self.device,
                                    first,
                                    &viewpoint.records,
                                );
                        first
                    }
                })
            })
            .collect()
    }

    /// Puts the buffers of an image size at the end of `sizes`.
    fn take_size(&mut self, frame: &Frame) {
        let known = self.sizes.iter().position(|(recall, _)| {
            (recall.width, recall.height) == (frame.width, frame.height)
                && recall.views >= frame.view_count
        });
        let buffers = match known {
            Some(index) => self.sizes.remove(index),
            None => {
                self.sizes.retain(|(recall, _)| {
                    (recall.width, recall.height) != (frame.width, frame.height)
                });
                if self.sizes.len() == SIZES_MAX {
                    self.sizes.remove(0);
                }
                (
                    RecallBuffers::new(&self.device, frame),
                    ScoreBuffers::new(&self.device, frame),
                )
            }
        };
        self.sizes.push(buffers);
    }

    fn read_prior(&self, recall: &RecallBuffers, prior: &mut Prior) -> Result<(), Lost> {
        let (width, height) = (recall.width as usize, recall.height as usize);
        let mut planes: [Vec<[f32; 4]>; 4] = Default::default();
        for (plane, buffer) in planes.iter_mut().zip(&recall.prior) {
            let mut passes = Passes::new(&self.device, None, "prior plane");
            let bytes = PRIOR_BYTES * (width * height) as u64;
            passes.copy(buffer, &recall.plane, 0, bytes);
            passes.submit();
            *plane = bytemuck::pod_collect_to_vec(&self.device.read(&recall.plane, bytes)?);
        }
        prior.resize(width, height);
        let [spread, level, sigma, earlier] = &planes;
        for (y, row) in prior.data.chunks_exact_mut(width * PLANES).enumerate() {
            for x in 0..width {
                let pixel = y * width + x;
                let [alpha, b0, b1, b2] = spread[pixel];
                let [t0, t1, t2, p2] = level[pixel];
                let [s0, s1, s2, depth_m] = sigma[pixel];
                let [e0, e1, e2, coverage] = earlier[pixel];
                let belief = Belief {
                    alpha,
                    beta: [b0, b1, b2],
                    tau: [t0, t1, t2],
                    sigma: [s0, s1, s2],
                    tau2: [e0, e1, e2],
                    p2,
                };
                put(row, width, x, &belief, depth_m, coverage);
            }
        }
        Ok(())
    }

    fn plane(&self, buffer: &wgpu::Buffer, bytes: u64) -> Result<Vec<f32>, Lost> {
        let (recall, _) = self.sizes.last().expect("a frame was compared");
        let mut passes = Passes::new(&self.device, None, "plane");
        passes.copy(buffer, &recall.plane, 0, bytes);
        passes.submit();
        Ok(bytemuck::pod_collect_to_vec(
            &self.device.read(&recall.plane, bytes)?,
        ))
    }
}

/// A list of passes that is being recorded.
struct Passes<'a> {
    device: &'a Device,
    encoder: wgpu::CommandEncoder,
    queries: Option<&'a wgpu::QuerySet>,
    run: Vec<usize>,
}

impl<'a> Passes<'a> {
    fn new(device: &'a Device, queries: Option<&'a wgpu::QuerySet>, label: &str) -> Self {
        let descriptor = wgpu::CommandEncoderDescriptor { label: Some(label) };
        Self {
            encoder: device.device.create_command_encoder(&descriptor),
            device,
            queries,
            run: Vec::new(),
        }
    }

    /// Project and merge.
    fn recall(&mut self, bound: Bound, frame: &Frame, views: &[RecallView]) {
        let map_bytes = 4 * frame.pixels() * views.len() as u64;
        self.encoder
            .clear_buffer(&bound.recall.nearest, 0, Some(map_bytes));
        self.encoder
            .clear_buffer(&bound.recall.triangles, 0, Some(map_bytes));
        let quads = |side: fn(&Intrinsics) -> usize| {
            let sides = views
                .iter()
                .map(|view| side(&view.viewpoint.mesh.intrinsics));
            sides.max().unwrap_or(0).saturating_sub(1) as u64
        };
        let quads = [quads(|i| i.width), quads(|i| i.height), views.len() as u64];
        self.run(PROJECT_DEPTH, bound, quads);
        self.run(PROJECT_TRIANGLE, bound, quads);
        let pixels = [u64::from(frame.width), u64::from(frame.height), 1];
        self.run(MERGE_VIEWS, bound, pixels);
    }

    /// One pass over so many invocations.
    fn run(&mut self, pass: usize, bound: Bound, invocations: [u64; 3]) {
        if invocations.contains(&0) {
            return;
        }
        let (
            pipeline,
            Pass {
                label,
                workgroup,
                bindings,
                ..
            },
        ) = (&self.device.pipelines[pass], &PASSES[pass]);
        let entries: Vec<wgpu::BindGroupEntry> = bindings
            .iter()
            .map(|&(binding, slot)| wgpu::BindGroupEntry {
                binding,
                resource: bound.buffer(slot).as_entire_binding(),
            })
            .collect();
        let group = self
            .device
            .device
            .create_bind_group(&wgpu::BindGroupDescriptor {
                label: Some(label),
                layout: &pipeline.get_bind_group_layout(0),
                entries: &entries,
            });
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
        compute.set_pipeline(pipeline);
        compute.set_bind_group(0, &group, &[]);
        let groups = |axis: usize| invocations[axis].div_ceil(workgroup[axis].into()) as u32;
        compute.dispatch_workgroups(groups(0), groups(1), groups(2));
        drop(compute);
        self.run.push(pass);
    }

    fn clear(&mut self, buffer: &wgpu::Buffer) {
        self.encoder.clear_buffer(buffer, 0, None);
    }

    /// The whole of `from`, `bytes`, to a place in `to`.
    fn copy(&mut self, from: &wgpu::Buffer, to: &wgpu::Buffer, at: u64, bytes: u64) {
        self.encoder.copy_buffer_to_buffer(from, 0, to, at, bytes);
    }

    /// The time stamps of the passes so far.
    fn resolve(&mut self, stamps: &wgpu::Buffer, to: &wgpu::Buffer, at: u64) {
        if let Some(queries) = self.queries {
            let count = 2 * self.run.len() as u32;
            self.encoder.resolve_query_set(queries, 0..count, stamps, 0);
            self.copy(stamps, to, at, STAMPS_BYTES);
        }
    }

    /// Returns which passes were run.
    fn submit(self) -> Vec<usize> {
        self.device.queue.submit([self.encoder.finish()]);
        self.run
    }
}
