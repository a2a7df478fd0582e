//! Depth from three cameras, online (the paper's section III-C; the paper computes it offline).
//! In: the middle image, luminance of the left and right camera, the rig. Out: depth of the middle image, metres.
//! Open in the paper: see [`plane_sweep`], [`belief_propagation`], [`silhouettes`] and [`refine`], in this order; and who
//! stands in front of whom. Chosen: a first answer by the coarse levels alone, which is enough to tell which side sees
//! what; with that the costs are made again, and solved at all levels.

pub mod given;

mod belief_propagation;
mod checkerboard;
mod contrast;
mod exposure_match;
mod lanes;
mod messages;
mod plane_sweep;
mod refine;
mod rig;
mod sampling;
mod side;
mod sides;
mod silhouettes;
mod texture;

pub use belief_propagation::{BeliefPropagation, Contrast, PropagationSettings, Smoothness};
pub use checkerboard::{CostRow, CostVolume};
pub use messages::Belief;
pub use plane_sweep::SweepSettings;
pub use rig::{DepthRig, InverseDepthRange, SideCamera};
pub use sides::SidesDepth;

use crate::{
    isa::{Isa, for_each_isa},
    model::frame::luminance,
};
use contrast::Contrasts;
use exposure_match::Exposure;
use plane_sweep::{Middle, Sweep};
use rayon::prelude::*;
use refine::Refiner;
use side::Side;
use silhouettes::Silhouettes;
use texture::Textures;

/// Costs are grey levels. The defaults lie in a broad optimum: of 450 random settings around the best of earlier ones,
/// the values that are best on average over all others, for seeds 1 to 3 of the simulated room and for Middlebury's
/// tsukuba; those of texture, of contrast, of what is firm or hidden and of the iterations are from later searches with the
/// same aims.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DepthSettings {
    pub sweep: SweepSettings,
    /// Mean difference between neighbours, half grey levels, up to which differences between cameras count three times.
    pub weak_texture: u8,
    /// Likewise, up to which there is nothing but noise to compare, and what is expected has a vote.
    pub blank_texture: u8,
    /// Margin, grey levels, from which a belief hides what is behind it from the sides.
    pub firm: u8,
    /// Between neighbours of like colour; the step is for a shift of one pixel between cameras, however many labels
    /// that is.
    pub smooth: Smoothness,
    /// Likewise, between neighbours of unlike colour.
    pub across_contrast: Smoothness,
    /// Levels of any colour between neighbours above which they are unlike, at every resolution.
    pub contrast: u8,
    /// See [`PropagationSettings`].
    pub levels: usize,
    pub iterations: usize,
    pub coarse_iterations: usize,
}

impl Default for DepthSettings {
    fn default() -> Self {
        Self {
            sweep: SweepSettings {
                most_difference: 16,
                occlusion: 6,
                most_surprise: 2,
                unseen: 7,
            },
            weak_texture: 20,
            blank_texture: 5,
            firm: 28,
            smooth: Smoothness {
                step: 7,
                truncation: 24,
            },
            across_contrast: Smoothness {
                step: 6,
                truncation: 7,
            },
            contrast: 7,
            levels: 4,
            iterations: 3,
            coarse_iterations: 6,
        }
    }
}

impl DepthSettings {
    fn propagation(&self, pixels_per_label: f64) -> PropagationSettings {
        let per_label = |Smoothness { step, truncation }: Smoothness| Smoothness {
            step: (f64::from(step) * pixels_per_label)
                .round()
                .clamp(1.0, f64::from(truncation.max(1))) as u8,
            truncation,
        };
        PropagationSettings {
            smooth: per_label(self.smooth),
            across_contrast: per_label(self.across_contrast),
            levels: self.levels,
            iterations: self.iterations,
            coarse_iterations: self.coarse_iterations,
        }
    }
}

/// Bits of [`DepthMap::seen_by`].
pub const SEEN_BY_LEFT: u8 = 1;
pub const SEEN_BY_RIGHT: u8 = 2;

/// What is known of the middle image's depth; each `width * height`, row by row.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct DepthMap {
    /// Metres along the optical axis; 0 = nothing can be said.
    pub depth_m: Vec<f32>,
    /// Of what the images say: from 0, another depth is as likely, to 1.
    pub confidence: Vec<f32>,
    /// Which sides see the pixel: [`SEEN_BY_LEFT`], [`SEEN_BY_RIGHT`].
    pub seen_by: Vec<u8>,
    /// The best guess everywhere, also where `depth_m` is 0, 1/m.
    pub inverse_depth: Vec<f32>,
    /// Inverse depth from one hypothesis to the next, 1/m: surfaces are known no better than a fraction of it.
    pub label_step: f32,
}

/// Estimates depth, frame after frame, in the same buffers.
pub struct DepthEstimator {
    settings: DepthSettings,
    isa: Isa,
    propagation: Option<BeliefPropagation>,
    /// What `propagation` was made for.
    kind: Option<(usize, usize, usize, PropagationSettings)>,
    sides: [Side; 2],
    middle_y: Vec<u8>,
    contrasts: Contrasts,
    textures: Textures,
    silhouettes: Silhouettes,
    refiner: Refiner,
    map: DepthMap,
}

impl DepthEstimator {
    pub fn new(settings: DepthSettings) -> Self {
        Self::with_isa(settings, Isa::detect())
    }

    /// As [`new`](Self::new) with at most that instruction set; the depth is the same.
    pub fn with_isa(settings: DepthSettings, isa: Isa) -> Self {
        Self {
            settings,
            isa: isa.or_best_available(),
            propagation: None,
            kind: None,
            sides: Default::default(),
            middle_y: Vec::new(),
            contrasts: Contrasts::default(),
            textures: Textures::default(),
            silhouettes: Silhouettes::default(),
            refiner: Refiner::default(),
            map: DepthMap::default(),
        }
    }

    /// Depth of the middle image, RGB, from the sides' luminances, of the sizes that the rig says; that of a side the rig
    /// lacks is not looked at. `expected_depth_m` (of the middle image, 0 = none) decides where the images are blank or
    /// leave it open, and only there: all hypotheses of `range` are tried at every pixel, so that nothing new stays hidden
    /// behind an expectation, and no mistake that was remembered confirms itself.
    pub fn estimate(
        &mut self,
        rig: &DepthRig,
        middle_rgb: &[[u8; 3]],
        left_y: &[u8],
        right_y: &[u8],
        range: &InverseDepthRange,
        expected_depth_m: Option<&[f32]>,
    ) -> &DepthMap {
        let (width, height) = (rig.middle.width, rig.middle.height);
        let pixels = width * height;
        assert_eq!(
            middle_rgb.len(),
            pixels,
            "the middle image has its camera's size"
        );
        assert!(
            expected_depth_m.is_none_or(|depth_m| depth_m.len() == pixels),
            "one expected depth a pixel"
        );
        let (isa, settings) = (self.isa, &self.settings);
        let contrasts = &mut self.contrasts;
        contrasts.find(middle_rgb, width, settings.levels, settings.contrast);
        self.middle_y.resize(pixels, 0);
        luminances(isa, contrasts.colours(), &mut self.middle_y);
        let middle_y = &*self.middle_y;
        let cameras = [(rig.left, left_y), (rig.right, right_y)];
        let mut exposures = [Exposure::SAME; 2];
        let sides = self.sides.iter_mut().zip(&mut exposures);
        for ((side, exposure), (camera, luminance)) in sides.zip(cameras) {
            if let Some(camera) = camera {
                assert_eq!(
                    luminance.len(),
                    camera.intrinsics.pixels(),
                    "a side image has its camera's size"
                );
                *exposure = Exposure::matching(middle_y, luminance).unless_unnoticed();
                side.turn(&rig.middle, &camera, range, &exposure.table(), luminance);
            }
        }
        let present = self
            .sides
            .iter()
            .zip(cameras)
            .filter(|(_, (camera, _))| camera.is_some());
        let shifts: Vec<f64> = present
            .map(|(side, _)| side.pixels_per_label(range))
            .collect();
        let pixels_per_label = shifts.iter().sum::<f64>() / shifts.len().max(1) as f64;
        let kind = (
            width,
            height,
            range.labels,
            settings.propagation(pixels_per_label),
        );
        if self.kind != Some(kind) {
            self.kind = Some(kind);
            self.propagation = None;
        }
        let propagation = self.propagation.get_or_insert_with(|| {
            BeliefPropagation::new(kind.3, width, height, range.labels, isa)
        });
        propagation.set_contrasts(contrasts.levels());
        let textures = &mut self.textures;
        textures.find(
            middle_y,
            width,
            [settings.weak_texture, settings.blank_texture],
        );
        let middle = Middle {
            intrinsics: &rig.middle,
            luminance: middle_y,
            weak: textures.weak(),
            blank: textures.blank(),
            expected_depth_m,
        };
        let highest = settings.sweep.highest_cost();
        let sides = turned(rig, &self.sides);
        let sweep = Sweep::new(isa, &settings.sweep, middle, sides, range, false);
        propagation.fill_coarse(
            highest,
            || sweep.scratch(),
            |scratch, y, row| sweep.fill_row(scratch, y, row),
        );
        // Which pixels show the same, and who stands in front of whom, is known only after a first answer; then a side
        // has no vote where it has no view.
        let coarse = propagation.solve_coarse();
        let sides = self.sides.iter_mut().zip(exposures);
        for ((side, first), (camera, luminance)) in sides.zip(cameras) {
            if let Some(camera) = camera {
                let (middle_y, side_y) = side.counterparts(range, coarse, middle_y, &rig.middle, 2);
                let known = Exposure::matching(&middle_y, &side_y)
                    .after(first)
                    .unless_unnoticed();
                if known != first {
                    side.turn(&rig.middle, &camera, range, &known.table(), luminance);
                }
                side.block(range, coarse, &rig.middle, 2, settings.firm);
            }
        }
        let sides = turned(rig, &self.sides);
        let sweep = Sweep::new(isa, &settings.sweep, middle, sides, range, true);
        propagation.fill(
            highest,
            || sweep.scratch(),
            |scratch, y, row| sweep.fill_row(scratch, y, row),
        );
        let beliefs = propagation.solve();
        self.silhouettes
            .follow(isa, contrasts.colours(), width, beliefs);
        let beliefs = &*beliefs;

        let map = &mut self.map;
        map.label_step = range.step() as f32;
        map.inverse_depth.resize(pixels, 0.0);
        self.refiner
            .refine(isa, beliefs, width, &mut map.inverse_depth);
        map.seen_by.clear();
        map.seen_by.resize(pixels, 0);
        let bits = [(rig.left, SEEN_BY_LEFT), (rig.right, SEEN_BY_RIGHT)];
        for (side, (camera, bit)) in self.sides.iter_mut().zip(bits) {
            if camera.is_some() {
                side.block(range, beliefs, &rig.middle, 1, settings.firm);
                side.mark_seen(range, beliefs, width, bit, &mut map.seen_by);
            }
        }
        map.depth_m.resize(pixels, 0.0);
        map.confidence.resize(pixels, 0.0);
        let certain = f32::from(settings.sweep.most_difference);
        let expected_depth_m = expected_depth_m.unwrap_or(&[]);
        let outputs = map
            .depth_m
            .par_iter_mut()
            .zip(&mut map.confidence)
            .zip(&mut map.inverse_depth)
            .with_min_len(4096);
        outputs.zip(beliefs).zip(&map.seen_by).enumerate().for_each(
            |(pixel, ((((depth_m, confidence), label), belief), seen_by))| {
                let mut inverse_depth = range.far as f32 + *label * range.step() as f32;
                let margin = f32::from(belief.margin());
                *confidence = if *seen_by == 0 {
                    0.0
                } else {
                    (margin / certain).min(1.0)
                };
                let mut is_known = *confidence > 0.0;
                if !is_known
                    && let Some(expected_m) = expected_depth_m.get(pixel).filter(|z| **z > 0.0)
                {
                    inverse_depth = 1.0 / expected_m;
                    is_known = true;
                }
                *label = inverse_depth;
                // Infinitely far is no depth either.
                *depth_m = if is_known && inverse_depth > 0.0 {
                    1.0 / inverse_depth
                } else {
                    0.0
                };
            },
        );
        &self.map
    }
}

for_each_isa! {
    fn luminances(colours: [&[u8]; 3], luminances: &mut [u8]) = luminances_kernel;
}

/// Of each pixel from its red, green and blue.
#[inline(always)]
fn luminances_kernel([red, green, blue]: [&[u8]; 3], luminances: &mut [u8]) {
    let n = luminances.len();
    let (red, green, blue) = (&red[..n], &green[..n], &blue[..n]);
    for x in 0..n {
        luminances[x] = luminance([red[x], green[x], blue[x]]);
    }
}

fn turned<'a>(rig: &DepthRig, [left, right]: &'a [Side; 2]) -> [Option<&'a Side>; 2] {
    [rig.left.map(|_| left), rig.right.map(|_| right)]
}
