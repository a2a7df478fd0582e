//! The engine on the processor: passes over strips of rows, shared out among the threads of one pool.

mod score;

mod strips;

use std::sync::{Mutex, MutexGuard};

use arrayvec::ArrayVec;
use rayon::prelude::*;

use crate::{
    config::Settings,
    isa::{Isa, for_each_isa},
    model::{
        belief::{CHANNELS, Record, ycbcr_from_rgb},
        camera::Intrinsics,
        frame::RgbImage,
        pose::Pose,
        viewpoint::{Coarse, Mesh, MeshCut, VIEWS_MAX, Viewpoint, halve_luminance},
    },
    pool::Pool,
    stages::{
        exposure::ExposureRatios,
        interpolate::{
            merge::{MergeRules, MergeView},
            prior::{self, Prior, PriorRow},
            project::Projector,
            reach::Reach,
        },
        surprise::GammaTerm,
        update::UpdateRules,
    },
};

use score::{ScoreRules, ScoreScratch};
use strips::StripScratch;

/// Pixels of a strip, about: its maps of seven views stay within 450 KB, beside the records that they lead to, in a core's
/// second-level cache.
const STRIP_PIXELS: usize = 640 * 12;
/// Most rows of a strip, for one thread and for several: what lies across two strips is drawn for both, so that long ones
/// cost less, but shares of few strips are not even.
const STRIP_ROWS_MAX: [usize; 2] = [24, 12];

/// A viewpoint to recall from.
#[derive(Clone, Copy)]
pub struct RecallView<'a> {
    pub viewpoint: &'a Viewpoint,
    /// In votes and means.
    pub weight: f32,
    /// Written during this visit.
    pub fresh: bool,
}

/// Luminance and chrominance of a frame, a plane a channel.
#[derive(Debug, Clone, Default)]
pub struct Observation {
    pub width: usize,
    pub height: usize,
    pub planes: [Vec<f32>; CHANNELS],
}

impl Observation {
    pub fn new(image: &RgbImage) -> Self {
        let mut observation = Self::default();
        observation.read(image, Isa::Portable);
        observation
    }

    fn read(&mut self, image: &RgbImage, isa: Isa) {
        (self.width, self.height) = (image.width, image.height);
        for plane in &mut self.planes {
            plane.resize(image.width * image.height, 0.0);
        }
        let [y, cb, cr] = &mut self.planes;
        transform_colours(isa, &image.data, y, cb, cr);
    }

    fn row(&self, y: usize) -> [&[f32]; CHANNELS] {
        std::array::from_fn(|channel| &self.planes[channel][y * self.width..][..self.width])
    }
}

for_each_isa! {
    fn transform_colours(rgb: &[u8], y: &mut [f32], cb: &mut [f32], cr: &mut [f32]) = transform_kernel;
}

#[inline(always)]
fn transform_kernel(rgb: &[u8], y: &mut [f32], cb: &mut [f32], cr: &mut [f32]) {
    let planes = y.iter_mut().zip(cb).zip(cr);
    for (rgb, ((y, cb), cr)) in rgb.chunks_exact(3).zip(planes) {
        [*y, *cb, *cr] = ycbcr_from_rgb([f32::from(rgb[0]), f32::from(rgb[1]), f32::from(rgb[2])]);
    }
}

for_each_isa! {
    fn join(mesh: &mut Mesh, cut: MeshCut) = join_kernel;
}

#[inline(always)]
fn join_kernel(mesh: &mut Mesh, cut: MeshCut) {
    mesh.join(cut);
}

for_each_isa! {
    fn halve(coarse: &mut Mesh, mesh: &Mesh, cut: MeshCut) = halve_kernel;
}

#[inline(always)]
fn halve_kernel(coarse: &mut Mesh, mesh: &Mesh, cut: MeshCut) {
    coarse.halve(mesh, cut);
}

for_each_isa! {
    fn reduce(
        records: &[Record],
        fine: &Intrinsics,
        luminance: &mut Vec<f32>,
        variance: &mut Vec<f32>,
    ) = halve_luminance;
}

/// What a frame did to the prior.
#[derive(Debug, Clone, Default)]
pub struct Score {
    /// Nats a pixel; 0 where unseen.
    pub surprise: Vec<f32>,
    /// The posterior, a record a pixel; taken away when it becomes a viewpoint.
    pub posterior: Vec<Record>,
    /// The exposure gain the observation was divided by.
    pub gain: f32,
}

impl Score {
    fn resize(&mut self, prior: &Prior, observation: &Observation) {
        assert_eq!(
            (observation.width, observation.height),
            (prior.width, prior.height),
            "the prior is recalled for the frame's camera"
        );
        let pixels = prior.width * prior.height;
        self.surprise.resize(pixels, 0.0);
        self.posterior.resize(pixels, Record::default());
    }
}

/// Working memory of one thread.
#[derive(Default)]
struct Scratch {
    strip: StripScratch,
    score: ScoreScratch,
    exposure: ExposureRatios,
}

pub struct CpuEngine {
    pool: Pool,
    isa: Isa,
    merge_rules: MergeRules,
    score_rules: ScoreRules,
    exposure_gain: bool,
    /// One a thread; never contended.
    scratch: Vec<Mutex<Scratch>>,
    /// One a view.
    reaches: Mutex<[Reach; VIEWS_MAX]>,
}

impl CpuEngine {
    /// `pool` may be shared among engines.
    pub fn new(settings: &Settings, pool: impl Into<Pool>, isa: Isa) -> Self {
        let pool = pool.into();
        let update = UpdateRules::new(settings);
        let scratch = (0..pool.current_num_threads())
            .map(|_| Mutex::default())
            .collect();
        Self {
            pool,
            isa,
            merge_rules: MergeRules {
                depth_vote_tolerance: settings.depth_vote.then_some(settings.depth_vote_tolerance),
                colour_vote: settings.colour_vote,
                view_variance: settings.view_variance,
                earlier_appearance: settings.earlier_appearance,
            },
            score_rules: ScoreRules {
                gamma: GammaTerm::new(&update),
                update,
                edge_variance_px: settings.edge_error_px * settings.edge_error_px,
                earlier_appearance: settings.earlier_appearance,
                surprise_threshold: settings.surprise_threshold,
            },
            exposure_gain: settings.exposure_gain,
            scratch,
            reaches: Mutex::default(),
        }
    }

    /// Takes an image apart into planes; memory that is there is used again.
    pub fn observe(&self, image: &RgbImage, observation: &mut Observation) {
        observation.read(image, self.isa);
    }

    /// Makes what follows from a mesh's depth and its records when they are stored.
    pub fn prepare(
        &self,
        mesh: &mut Mesh,
        records: &[Record],
        coarse: Option<&mut Coarse>,
        cut: MeshCut,
    ) {
        let Some(coarse) = coarse else {
            join(self.isa, mesh, cut);
            return;
        };
        let Coarse {
            mesh: coarse,
            luminance,
            variance,
        } = coarse;
        let fine = mesh.intrinsics;
        let mut surface = || {
            join(self.isa, mesh, cut);
            halve(self.isa, coarse, mesh, cut);
        };
        let mut appearance = || reduce(self.isa, records, &fine, luminance, variance);
        if self.is_alone() {
            surface();
            appearance();
        } else {
            self.pool.install(|| rayon::join(surface, appearance));
        }
    }

    /// Interpolates the beliefs at a pose from at most 16 views into `prior`.
    pub fn recall(
        &self,
        views: &[RecallView],
        intrinsics: &Intrinsics,
        world_from_camera: &Pose,
        prior: &mut Prior,
    ) {
        self.recall_with(views, intrinsics, world_from_camera, prior, &|_, _, _| {});
    }

    /// The same, and `then` does something with every strip while it is at hand.
    fn recall_with(
        &self,
        views: &[RecallView],
        intrinsics: &Intrinsics,
        world_from_camera: &Pose,
        prior: &mut Prior,
        then: &(dyn Fn(usize, &[f32], &mut Scratch) + Sync),
    ) {
        let mut reaches = self.reaches();
        let recall = Recall::new(self, views, intrinsics, world_from_camera, &mut reaches);
        prior.resize(intrinsics.width, intrinsics.height);
        let strip_rows = recall.strip_rows;
        let strip_values = strip_rows * intrinsics.width * prior::PLANES;
        let recall = |(strip, rows): (usize, &mut [f32])| {
            let scratch = &mut *self.thread_scratch();
            recall.strip(strip, rows, &mut scratch.strip);
            then(strip * strip_rows, rows, scratch);
        };
        let data = &mut prior.data;
        if self.is_alone() {
            data.chunks_mut(strip_values).enumerate().for_each(recall);
        } else {
            self.pool.install(|| {
                data.par_chunks_mut(strip_values)
                    .enumerate()
                    .with_max_len(1)
                    .for_each(recall);
            });
        }
    }

    /// Updates the prior with an observation of the same size and measures the surprise. Returns how many pixels some
    /// view saw.
    pub fn score(&self, prior: &Prior, observation: &Observation, score: &mut Score) -> usize {
        let gain = self.gain(prior, observation);
        self.score_at(gain, prior, observation, score)
    }

    fn score_at(
        &self,
        gain: f32,
        prior: &Prior,
        observation: &Observation,
        score: &mut Score,
    ) -> usize {
        score.resize(prior, observation);
        score.gain = gain;
        let (width, inverse_gain) = (prior.width, 1.0 / score.gain);
        let strip_rows = self.strip_rows(width);
        let strip_pixels = strip_rows * width;
        let update = |(strip, (surprise, posterior)): (usize, (&mut [f32], &mut [Record]))| {
            let scratch = &mut self.thread_scratch().score;
            let rows = strip * strip_rows..prior.height;
            let mut seen = 0;
            for (y, (surprise, posterior)) in rows.zip(
                surprise
                    .chunks_exact_mut(width)
                    .zip(posterior.chunks_exact_mut(width)),
            ) {
                score::score_row(
                    self.isa,
                    y.checked_sub(1).map(|y| prior.row(y)),
                    prior.row(y),
                    (y + 1 < prior.height).then(|| prior.row(y + 1)),
                    observation.row(y),
                    inverse_gain,
                    &self.score_rules,
                    scratch,
                    surprise,
                    posterior,
                    &mut seen,
                );
            }
            seen
        };
        let (surprise, posterior) = (&mut score.surprise, &mut score.posterior);
        if self.is_alone() {
            surprise
                .chunks_mut(strip_pixels)
                .zip(posterior.chunks_mut(strip_pixels))
                .enumerate()
                .map(update)
                .sum()
        } else {
            self.pool.install(|| {
                surprise
                    .par_chunks_mut(strip_pixels)
                    .zip(posterior.par_chunks_mut(strip_pixels))
                    .enumerate()
                    .with_max_len(1)
                    .map(update)
                    .sum()
            })
        }
    }

    /// Recalls and scores: in one pass, while the prior is at hand, unless the score depends on more than the pixel.
    pub fn compare(
        &self,
        views: &[RecallView],
        intrinsics: &Intrinsics,
        world_from_camera: &Pose,
        observation: &Observation,
        prior: &mut Prior,
        score: &mut Score,
    ) -> usize {
        self.in_pool(|| {
            self.compare_here(
                views,
                intrinsics,
                world_from_camera,
                observation,
                prior,
                score,
            )
        })
    }

    fn compare_here(
        &self,
        views: &[RecallView],
        intrinsics: &Intrinsics,
        world_from_camera: &Pose,
        observation: &Observation,
        prior: &mut Prior,
        score: &mut Score,
    ) -> usize {
        if self.exposure_gain {
            self.forget_ratios();
            let width = intrinsics.width;
            let count = |first_row: usize, rows: &[f32], scratch: &mut Scratch| {
                for (index, y) in (first_row..)
                    .take(rows.len() / (width * prior::PLANES))
                    .enumerate()
                {
                    let row = PriorRow::of(rows, index, width);
                    scratch.exposure.count(
                        self.isa,
                        row.plane(prior::TAU),
                        row.plane(prior::COVERAGE),
                        observation.row(y)[0],
                    );
                }
            };
            self.recall_with(views, intrinsics, world_from_camera, prior, &count);
            return self.score_at(self.gain_of_ratios(), prior, observation, score);
        }
        if self.score_rules.looks_around() {
            self.recall(views, intrinsics, world_from_camera, prior);
            return self.score(prior, observation, score);
        }
        let mut reaches = self.reaches();
        let recall = Recall::new(self, views, intrinsics, world_from_camera, &mut reaches);
        let Intrinsics { width, height, .. } = *intrinsics;
        prior.resize(width, height);
        score.resize(prior, observation);
        score.gain = 1.0;
        let strip_rows = recall.strip_rows;
        let strip_pixels = strip_rows * width;
        type Strip<'a> = ((&'a mut [f32], &'a mut [f32]), &'a mut [Record]);
        let both = |(strip, ((rows, surprise), posterior)): (usize, Strip)| {
            let Scratch {
                strip: recall_scratch,
                score: scratch,
                ..
            } = &mut *self.thread_scratch();
            recall.strip(strip, rows, recall_scratch);
            let mut seen = 0;
            for (row, (surprise, posterior)) in surprise
                .chunks_exact_mut(width)
                .zip(posterior.chunks_exact_mut(width))
                .enumerate()
            {
                score::score_row(
                    self.isa,
                    None,
                    PriorRow::of(rows, row, width),
                    None,
                    observation.row(strip * strip_rows + row),
                    1.0,
                    &self.score_rules,
                    scratch,
                    surprise,
                    posterior,
                    &mut seen,
                );
            }
            seen
        };
        let (data, surprise) = (&mut prior.data, &mut score.surprise);
        let posterior = &mut score.posterior;
        if self.is_alone() {
            data.chunks_mut(strip_pixels * prior::PLANES)
                .zip(surprise.chunks_mut(strip_pixels))
                .zip(posterior.chunks_mut(strip_pixels))
                .enumerate()
                .map(both)
                .sum()
        } else {
            self.pool.install(|| {
                data.par_chunks_mut(strip_pixels * prior::PLANES)
                    .zip(surprise.par_chunks_mut(strip_pixels))
                    .zip(posterior.par_chunks_mut(strip_pixels))
                    .enumerate()
                    .with_max_len(1)
                    .map(both)
                    .sum()
            })
        }
    }

    fn gain(&self, prior: &Prior, observation: &Observation) -> f32 {
        if !self.exposure_gain {
            return 1.0;
        }
        let mut ratios = ExposureRatios::default();
        for y in 0..prior.height {
            let row = prior.row(y);
            ratios.count(
                self.isa,
                row.plane(prior::TAU),
                row.plane(prior::COVERAGE),
                observation.row(y)[0],
            );
        }
        ratios.gain()
    }

    fn forget_ratios(&self) {
        for scratch in &self.scratch {
            locked(scratch).exposure.clear();
        }
    }

    /// Of what all threads counted.
    fn gain_of_ratios(&self) -> f32 {
        let mut ratios = ExposureRatios::default();
        for scratch in &self.scratch {
            ratios.add(&locked(scratch).exposure);
        }
        ratios.gain()
    }

    fn reaches(&self) -> MutexGuard<'_, [Reach; VIEWS_MAX]> {
        self.reaches
            .lock()
            .expect("never held by a panicked caller")
    }

    /// Several passes, handed over once.
    pub fn in_pool<T: Send>(&self, passes: impl FnOnce() -> T + Send) -> T {
        if self.is_alone() && !self.pool.is_crowded() {
            passes()
        } else {
            self.pool.install(passes)
        }
    }

    fn strip_rows(&self, width: usize) -> usize {
        let most = STRIP_ROWS_MAX[usize::from(!self.is_alone())];
        (STRIP_PIXELS / width.max(1)).clamp(1, most)
    }

    /// Whether one thread does the work.
    fn is_alone(&self) -> bool {
        self.pool.is_taken()
    }

    fn thread_scratch(&self) -> MutexGuard<'_, Scratch> {
        // Whoever works alone is of none, or the only one at work here.
        let thread = self.pool.current_thread_index().unwrap_or(0);
        locked(&self.scratch[thread])
    }
}

fn locked(scratch: &Mutex<Scratch>) -> MutexGuard<'_, Scratch> {
    scratch
        .lock()
        .expect("a thread that panicked ends the process")
}

/// Views on their way into a prior.
struct Recall<'a> {
    engine: &'a CpuEngine,
    projectors: ArrayVec<Projector<'a>, VIEWS_MAX>,
    views: ArrayVec<MergeView<'a>, VIEWS_MAX>,
    width: usize,
    strip_rows: usize,
}

impl<'a> Recall<'a> {
    fn new(
        engine: &'a CpuEngine,
        views: &[RecallView<'a>],
        intrinsics: &Intrinsics,
        world_from_camera: &Pose,
        reaches: &'a mut [Reach; VIEWS_MAX],
    ) -> Self {
        let aim = |(view, reach): (&RecallView, &mut Reach)| {
            let Viewpoint {
                mesh,
                world_from_camera: world_from_view,
                ..
            } = view.viewpoint;
            reach.aim(
                engine.isa,
                mesh,
                world_from_view,
                intrinsics,
                world_from_camera,
            );
        };
        if engine.is_alone() {
            views.iter().zip(&mut *reaches).for_each(aim);
        } else {
            engine.pool.install(|| {
                let both = views.par_iter().zip(&mut *reaches);
                both.with_max_len(1).for_each(aim);
            });
        }
        Self {
            engine,
            projectors: views
                .iter()
                .zip(&*reaches)
                .map(|(view, reach)| Projector::new(&view.viewpoint.mesh, reach))
                .collect(),
            views: views
                .iter()
                .map(|view| MergeView {
                    records: &view.viewpoint.records,
                    width: view.viewpoint.mesh.intrinsics.width,
                    height: view.viewpoint.mesh.intrinsics.height,
                    weight: view.weight,
                    fresh: view.fresh,
                })
                .collect(),
            width: intrinsics.width,
            strip_rows: engine.strip_rows(intrinsics.width),
        }
    }

    /// The rows of a strip of the prior.
    fn strip(&self, strip: usize, rows: &mut [f32], scratch: &mut StripScratch) {
        scratch.recall(
            self.engine.isa,
            &self.projectors,
            &self.views,
            self.engine.merge_rules,
            self.width,
            strip * self.strip_rows,
            rows,
        );
    }
}
