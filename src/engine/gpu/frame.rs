//! One device's work: viewpoints are brought, passes are recorded and submitted, the report is read. Whatever is here is
//! lost with the device, and can be made again from the memory.

use std::sync::Arc;

use super::{
    Counters,
    arenas::Arenas,
    buffers::{
        Bound, ESTIMATE_BYTES, EXPOSURE_BYTES, PRIOR_BYTES, RECORD_BYTES, REPORT_HEAD_BYTES,
        RecallBuffers, ScoreBuffers, SharedBuffers, fits,
    },
    card::Share,
    device::{Device, Lost},
    layout::{Estimate, Exposure, Frame, Rules, View},
    passes::{BLOCK_MEANS, BLOCK_MEDIANS, EXPOSE, EXPOSE_PIXELS, GAIN, PASSES, SCORE_PIXELS},
    recording::{Passes, pass_seconds},
    refine::refined,
    residency::Place,
};
use crate::{
    config::Evidence,
    engine::cpu::{RecallView, Score},
    model::{
        belief::{Belief, Record},
        camera::Intrinsics,
        frame::RgbImage,
        pose::{Pose, PoseNoise},
        viewpoint::{Mesh, Viewpoint},
    },
    stages::{
        attend::BlockMap,
        interpolate::prior::{PLANES, Prior, put},
        refine::{Refined, believed},
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
    /// Of the pose, where it is to be refined first.
    pub noise: Option<PoseNoise>,
    pub evidence: Evidence,
    pub posterior: bool,
    /// The surprise map, if a block inside this border, pixels, has more nats than this.
    pub surprise_from: (usize, f32),
}

pub struct Report {
    pub refined: Refined,
    pub evidence: BlockMap,
    pub seen: usize,
}

pub struct State {
    pub device: Arc<Device>,
    pub(super) shared: SharedBuffers,
    pub(super) arenas: Arenas,
    pub(super) queries: Option<wgpu::QuerySet>,
    /// How many views are recalled as a rule.
    views: u32,
    /// The last used at the end.
    pub(super) sizes: Vec<(RecallBuffers, ScoreBuffers)>,
    /// Whether the last of `sizes` holds the maps of the last frame.
    has_maps: bool,
}

impl State {
    /// `views` are recalled as a rule.
    pub fn new(device: Arc<Device>, rules: &Rules, views: usize, share: Share) -> Self {
        let queries = device.timed.then(|| {
            device.device.create_query_set(&wgpu::QuerySetDescriptor {
                label: Some("stamps"),
                ty: wgpu::QueryType::Timestamp,
                count: 2 * PASSES.len() as u32,
            })
        });
        Self {
            shared: SharedBuffers::new(&device, rules),
            arenas: Arenas::new(&device, share),
            queries,
            views: views as u32,
            sizes: Vec::new(),
            has_maps: false,
            device,
        }
    }

    /// Compares an image with what the views expect, from the refined pose if that is wanted. `score` gets the gain and
    /// what is wanted.
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
        self.bring(views, counters)?;
        self.take_image(&frame, image, counters)?;
        let placed = self.placed(
            views,
            |viewpoint| &viewpoint.mesh,
            intrinsics,
            world_from_camera,
        );
        let (recall, buffers) = self.sizes.last().expect("the size was just taken");
        let bound = Bound {
            shared: &self.shared,
            arenas: &self.arenas,
            recall,
            score: Some(buffers),
            level: 0,
        };
        let noise = wanted.noise.filter(|_| !views.is_empty()).map(believed);
        let is_given = noise.is_some();
        counters.uploaded_bytes += self.shared.upload(&self.device, &frame, &placed, is_given);

        let mut passes = Passes::new(&self.device, self.queries.as_ref(), "frame");
        if let Some(noise) = noise {
            counters.uploaded_bytes += self.refine(
                &mut passes,
                bound,
                views,
                intrinsics,
                world_from_camera,
                noise,
            );
        }
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
        let stamps_at = EXPOSURE_BYTES + ESTIMATE_BYTES;
        let evidence_at = REPORT_HEAD_BYTES;
        let posterior_at = evidence_at + 4 * frame.blocks();
        let SharedBuffers {
            exposure, estimate, ..
        } = &self.shared;
        passes.copy(exposure, &buffers.report, 0, EXPOSURE_BYTES);
        passes.copy(estimate, &buffers.report, EXPOSURE_BYTES, ESTIMATE_BYTES);
        passes.resolve(&self.shared.stamps, &buffers.report, stamps_at);
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
        counters.passes += run.labels.len() as u64;
        let read = self.device.read(&buffers.report, bytes, run.index)?;
        counters.read_backs += 1;
        counters.read_back_bytes += bytes;

        let (head, posterior) = read.split_at(posterior_at as usize);
        let exposure: Exposure = bytemuck::pod_read_unaligned(&head[..size_of::<Exposure>()]);
        score.gain = exposure.gain;
        let refined = match noise {
            Some(_) => {
                let estimate = &head[EXPOSURE_BYTES as usize..stamps_at as usize];
                let estimate: Estimate = bytemuck::pod_read_unaligned(estimate);
                refined(&estimate, world_from_camera)
            }
            None => Refined::unchanged(*world_from_camera),
        };
        if self.queries.is_some() {
            let stamps = &head[stamps_at as usize..evidence_at as usize];
            counters.pass_seconds = pass_seconds(&self.device, &run.labels, stamps);
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
            counters.read_backs += 1;
            counters.read_back_bytes += 4 * frame.pixels();
        }
        self.has_maps = true;
        Ok(Report {
            refined,
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
        if !fits(&self.device, &frame, frame.view_count) {
            return Err(Failure::TooLarge);
        }
        self.bring(views, counters)?;
        let placed = self.placed(
            views,
            |viewpoint| &viewpoint.mesh,
            intrinsics,
            world_from_camera,
        );
        let recall = RecallBuffers::new(&self.device, &frame, frame.view_count);
        let bound = Bound {
            shared: &self.shared,
            arenas: &self.arenas,
            recall: &recall,
            score: None,
            level: 0,
        };
        counters.uploaded_bytes += self.shared.upload(&self.device, &frame, &placed, false);
        let mut passes = Passes::new(&self.device, None, "recall");
        passes.recall(bound, &frame, views);
        counters.passes += passes.submit().labels.len() as u64;
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
        let index = passes.submit().index;
        let records = self
            .device
            .read(&buffers.report, RECORD_BYTES * pixels, index)?;
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
        let evicted = self.arenas.residency.evicted();
        self.arenas.begin(&self.device, std::iter::once(viewpoint));
        // Without room the next recall brings it.
        if let Some(Place::Empty(first)) = self.arenas.place(&self.device, viewpoint) {
            counters.uploaded_bytes += self.arenas.upload_meshes(&self.device, first, viewpoint);
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
        counters.evicted += self.arenas.residency.evicted() - evicted;
    }

    /// Viewpoints changed elsewhere: the next recall brings what it needs.
    pub fn forget(&mut self) {
        self.arenas.residency.clear();
    }

    /// Brings the views that are not there.
    fn bring(&mut self, views: &[RecallView], counters: &mut Counters) -> Result<(), Failure> {
        let evicted = self.arenas.residency.evicted();
        if !self.bring_all(views, counters) {
            // There may be room, but in pieces.
            self.arenas.residency.clear();
            if !self.bring_all(views, counters) {
                return Err(Failure::TooLarge);
            }
        }
        counters.resident_bytes = self.arenas.bytes();
        counters.evicted += self.arenas.residency.evicted() - evicted;
        Ok(())
    }

    fn bring_all(&mut self, views: &[RecallView], counters: &mut Counters) -> bool {
        let viewpoints = || views.iter().map(|view| view.viewpoint);
        self.arenas.begin(&self.device, viewpoints());
        for viewpoint in viewpoints() {
            let Some(place) = self.arenas.place(&self.device, viewpoint) else {
                return false;
            };
            if let Place::Empty(first) = place {
                counters.views_brought += 1;
                counters.uploaded_bytes +=
                    self.arenas.upload_meshes(&self.device, first, viewpoint)
                        + self
                            .arenas
                            .upload_records(&self.device, first, &viewpoint.records);
            }
        }
        true
    }

    /// The views that were brought, as a camera sees them.
    pub(super) fn placed(
        &self,
        views: &[RecallView],
        mesh: fn(&Viewpoint) -> &Mesh,
        intrinsics: &Intrinsics,
        world_from_camera: &Pose,
    ) -> Vec<View> {
        views
            .iter()
            .map(|view| {
                let first = self.arenas.residency.first(view.viewpoint.id);
                View::new(
                    mesh(view.viewpoint),
                    &view.viewpoint.world_from_camera,
                    intrinsics,
                    world_from_camera,
                    first.expect("the views were brought") as u32,
                    view.weight,
                    view.fresh,
                )
            })
            .collect()
    }

    /// Puts the buffers of an image's size at the end of `sizes`, with the image in them. The maps of the frame before
    /// are gone then.
    fn take_image(
        &mut self,
        frame: &Frame,
        image: &RgbImage,
        counters: &mut Counters,
    ) -> Result<(), Failure> {
        let views = self.views.max(frame.view_count);
        if !fits(&self.device, frame, views) {
            return Err(Failure::TooLarge);
        }
        self.has_maps = false;
        let is_same_size = |(recall, _): &(RecallBuffers, ScoreBuffers)| {
            (recall.width, recall.height) == (frame.width, frame.height)
        };
        let known = self
            .sizes
            .iter()
            .position(|size| is_same_size(size) && size.0.views >= views);
        let buffers = match known {
            Some(index) => self.sizes.remove(index),
            None => {
                self.sizes.retain(|size| !is_same_size(size));
                if self.sizes.len() == SIZES_MAX {
                    self.sizes.remove(0);
                }
                (
                    RecallBuffers::new(&self.device, frame, views),
                    ScoreBuffers::new(&self.device, frame),
                )
            }
        };
        self.device.upload(&buffers.1.image, 0, &image.data);
        counters.uploaded_bytes += image.data.len() as u64;
        self.sizes.push(buffers);
        Ok(())
    }

    fn read_prior(&self, recall: &RecallBuffers, prior: &mut Prior) -> Result<(), Lost> {
        let (width, height) = (recall.width as usize, recall.height as usize);
        let mut planes: [Vec<[f32; 4]>; 4] = Default::default();
        for (plane, buffer) in planes.iter_mut().zip(&recall.prior) {
            let mut passes = Passes::new(&self.device, None, "prior plane");
            let bytes = PRIOR_BYTES * (width * height) as u64;
            passes.copy(buffer, &recall.plane, 0, bytes);
            let index = passes.submit().index;
            let read = self.device.read(&recall.plane, bytes, index)?;
            *plane = bytemuck::pod_collect_to_vec(&read);
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
        let index = passes.submit().index;
        Ok(bytemuck::pod_collect_to_vec(&self.device.read(
            &recall.plane,
            bytes,
            index,
        )?))
    }
}
