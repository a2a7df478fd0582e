//! Plane sweep over inverse depth (the paper's section III-C and its [29]): what it costs to believe that a pixel of the
//! middle image lies at each hypothesis, by its luminance in the left and in the right image.
//! In: luminance of two or three cameras, the rig, the range of inverse depth (1/m). Out: a cost volume, grey levels.
//! Open in the paper: the cost. Chosen: per side the difference to the interval of luminance that the hypothesis and
//! its halves towards the next ones span (Birchfield and Tomasi 1998), cut at `most_difference`; of the two sides
//! the mean, but where they disagree no more than the better one and `occlusion`, as the other camera may not see the
//! point; a side that looks past its image has no vote. Exposure of the side images is matched to the middle's.
//!
//! A side image is first turned once to the middle camera's axes and lens (its image of infinitely far points), so
//! that a hypothesis only shifts it, and scales it if a side camera stands before or behind the middle one. A rig that
//! shifts along rows alone takes its samples from one table a row of eight sub-pixel phases.

use super::{
    checkerboard::{Checkerboard, CostRow},
    lanes::{Lanes, for_each_isa},
    messages::Belief,
};
use crate::{
    isa::Isa,
    model::{camera::Intrinsics, pose::Pose},
};
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;

/// A camera beside the middle one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SideCamera {
    pub intrinsics: Intrinsics,
    pub side_from_middle: Pose,
}

/// Rectified (undistorted) cameras; without one of its sides it is a stereo pair.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DepthRig {
    pub middle: Intrinsics,
    pub left: Option<SideCamera>,
    pub right: Option<SideCamera>,
}

/// Hypotheses: `labels` inverse depths at equal distances.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InverseDepthRange {
    /// Of label 0, 1/m; 0 is infinitely far.
    pub far: f64,
    /// Of the last label, 1/m.
    pub near: f64,
    pub labels: usize,
}

impl InverseDepthRange {
    /// `None` unless 0 <= far < near, both finite, and 2 <= labels <= 255.
    pub fn new(far: f64, near: f64, labels: usize) -> Option<Self> {
        let ordered = far >= 0.0 && near > far && near.is_finite();
        (ordered && (2..=255).contains(&labels)).then_some(Self { far, near, labels })
    }

    /// 1/m from one label to the next.
    pub fn step(&self) -> f64 {
        (self.near - self.far) / (self.labels - 1) as f64
    }

    /// 1/m
    pub fn inverse_depth(&self, label: f64) -> f64 {
        self.far + label * self.step()
    }

    /// Fractional, not limited to the labels there are.
    pub fn label_of_depth(&self, depth_m: f64) -> f64 {
        (1.0 / depth_m - self.far) / self.step()
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SweepSettings {
    /// Grey levels; a larger difference says no more than this.
    pub most_difference: u8,
    /// Grey levels that seeing a point from one side only costs.
    pub occlusion: u8,
    /// The most that a label far from the expected depth costs, grey levels: far less than `most_difference`, so that
    /// it decides where the images do not, and never against them.
    pub most_surprise: u8,
    /// What a label costs that neither side could see, grey levels.
    pub unseen: u8,
}

impl SweepSettings {
    /// No cost exceeds it.
    pub fn highest_cost(&self) -> u8 {
        self.most_difference.saturating_add(self.most_surprise)
    }
}

/// Blocks the view of every label: beyond the image.
const OUTSIDE: u8 = 255;

/// Sub-pixel phases of the tables.
const PHASES: usize = 8;

/// Pixels of a row that a hypothesis may reach beyond the image; no vote there.
const VECTOR_SLACK: usize = 64;

/// A side image turned to the middle camera's axes and lens, with a margin on all sides.
#[derive(Default)]
pub(super) struct Side {
    /// What the canvas was made for.
    seen: Option<(Intrinsics, SideCamera, usize, usize)>,
    /// Per pixel of the canvas: where in the side image, `None` outside; empty if the canvas is the image itself.
    look_up: Vec<LookUp>,
    /// Of the canvas, which begins `margin` pixels left of and `margin_rows` above the image.
    width: usize,
    margin: usize,
    margin_rows: usize,
    luminance: Vec<u8>,
    /// [`OUTSIDE`] where there is no image, else 0.
    outside: Vec<u8>,
    /// The least label that is seen there past what is known to stand in front: `outside`, and nearest labels.
    blocker: Vec<u8>,
    motion: Motion,
}

#[derive(Clone, Copy)]
struct LookUp {
    /// Upper left of the four pixels; `u32::MAX` outside.
    index: u32,
    /// 1/16 pixel.
    right: u8,
    below: u8,
}

/// How a hypothesis moves the turned image: `x' - cx = (x - cx + rho * x_pixels) / (1 + rho * scale)`, likewise y.
#[derive(Debug, Clone, Copy, Default)]
struct Motion {
    /// Pixel metres.
    x: f64,
    y: f64,
    /// Metres.
    z: f64,
    cx: f64,
    cy: f64,
}

impl Motion {
    fn of(middle: &Intrinsics, side: &SideCamera) -> Self {
        let t = side.side_from_middle.rotation.inverse() * side.side_from_middle.translation.vector;
        Self {
            x: middle.fx * t.x,
            y: middle.fy * t.y,
            z: t.z,
            cx: middle.cx,
            cy: middle.cy,
        }
    }

    /// Scale, and where the pixel (0, 0) comes from.
    fn at(&self, inverse_depth: f64) -> (f64, f64, f64) {
        // A point at or behind the side camera is seen nowhere; a scale this great leads off any image.
        let scale = 1.0 / (1.0 + inverse_depth * self.z).max(1e-3);
        (
            scale,
            (inverse_depth * self.x - self.cx) * scale + self.cx,
            (inverse_depth * self.y - self.cy) * scale + self.cy,
        )
    }

    /// The image keeps its rows and its scale, to a fraction of a pixel that interpolation hides.
    fn along_rows(&self, middle: &Intrinsics, range: &InverseDepthRange) -> bool {
        let (scale, _, y) = self.at(range.near);
        let stretch = (scale - 1.0).abs() * middle.width.max(middle.height) as f64;
        stretch < 1.0 / 16.0 && y.abs() < 1.0 / 16.0
    }
}

impl Side {
    /// Takes the next image, `luminance` of the side camera's size.
    pub fn turn(
        &mut self,
        middle: &Intrinsics,
        side: &SideCamera,
        range: &InverseDepthRange,
        exposure: &[u8; 256],
        luminance: &[u8],
    ) {
        self.motion = Motion::of(middle, side);
        let reach = |size: usize, shift: &dyn Fn(&(f64, f64, f64)) -> f64| {
            let reach = [range.far, range.near]
                .map(|rho| {
                    let (scale, ..) = self.motion.at(rho);
                    let first = shift(&self.motion.at(rho));
                    let last = first + (scale - 1.0) * size as f64;
                    first.abs().max(last.abs())
                })
                .into_iter()
                .fold(0.0, f64::max);
            // Beyond its own width there is no image left to see.
            (reach.ceil() as usize + 2).min(size + 2)
        };
        let margin = reach(middle.width, &|motion| motion.1);
        let margin_rows = reach(middle.height, &|motion| motion.2);
        let seen = Some((*middle, *side, margin, margin_rows));
        let width = middle.width + 2 * margin;
        let height = middle.height + 2 * margin_rows;
        if self.seen != seen {
            self.seen = seen;
            (self.width, self.margin, self.margin_rows) = (width, margin, margin_rows);
            self.luminance = vec![0; width * height];
            self.outside = vec![OUTSIDE; width * height];
            let same_lens = side.intrinsics == *middle;
            self.look_up =
                if same_lens && side.side_from_middle.rotation.angle() * middle.fx < 1.0 / 64.0 {
                    Vec::new()
                } else {
                    look_up(middle, side, width, height, margin, margin_rows)
                };
            for (outside, look_up) in self.outside.iter_mut().zip(&self.look_up) {
                *outside = if look_up.index == u32::MAX {
                    OUTSIDE
                } else {
                    0
                };
            }
        }
        if self.look_up.is_empty() {
            for (y, row) in luminance.chunks_exact(middle.width).enumerate() {
                let at = (y + margin_rows) * width + margin;
                self.outside[at..at + middle.width].fill(0);
                for (to, from) in self.luminance[at..at + middle.width].iter_mut().zip(row) {
                    *to = exposure[usize::from(*from)];
                }
            }
            self.blocker.clone_from(&self.outside);
            return;
        }
        self.blocker.clone_from(&self.outside);
        let stride = side.intrinsics.width;
        self.luminance
            .par_chunks_exact_mut(width)
            .zip(self.look_up.par_chunks_exact(width))
            .for_each(|(row, look_up)| {
                for (
                    to,
                    LookUp {
                        index,
                        right,
                        below,
                    },
                ) in row.iter_mut().zip(look_up)
                {
                    if *index == u32::MAX {
                        continue;
                    }
                    let at = *index as usize;
                    let pixel = |offset: usize| {
                        u32::from(luminance[(at + offset).min(luminance.len() - 1)])
                    };
                    let (right, below) = (u32::from(*right), u32::from(*below));
                    let upper = pixel(0) * (16 - right) + pixel(1) * right;
                    let lower = pixel(stride) * (16 - right) + pixel(stride + 1) * right;
                    *to = exposure[((upper * (16 - below) + lower * below + 128) >> 8) as usize];
                }
            });
    }
}

fn look_up(
    middle: &Intrinsics,
    side: &SideCamera,
    width: usize,
    height: usize,
    margin: usize,
    margin_rows: usize,
) -> Vec<LookUp> {
    let rotation: Matrix3<f64> = side
        .side_from_middle
        .rotation
        .to_rotation_matrix()
        .into_inner();
    let camera = &side.intrinsics;
    let mut table = Vec::with_capacity(width * height);
    for y in 0..height {
        for x in 0..width {
            let ray = Vector3::new(
                (x as f64 - margin as f64 - middle.cx) / middle.fx,
                (y as f64 - margin_rows as f64 - middle.cy) / middle.fy,
                1.0,
            );
            table.push(match camera.project(&(rotation * ray).into()) {
                Some((u, v))
                    if u >= 0.0
                        && v >= 0.0
                        && u <= camera.width as f64 - 1.0
                        && v <= camera.height as f64 - 1.0 =>
                {
                    let sixteenths = |value: f64| (value * 16.0).round() as usize;
                    let (u, v) = (sixteenths(u), sixteenths(v));
                    LookUp {
                        index: (v / 16 * camera.width + u / 16) as u32,
                        right: (u % 16) as u8,
                        below: (v % 16) as u8,
                    }
                }
                _ => LookUp {
                    index: u32::MAX,
                    right: 0,
                    below: 0,
                },
            });
        }
    }
    table
}

/// Samples of one side for one row: where each label's are.
#[derive(Default, Clone)]
struct Strip {
    /// Least, greatest luminance of each sample's interval, and what blocks its view.
    low: Vec<u8>,
    high: Vec<u8>,
    blocker: Vec<u8>,
    /// `[label][parity]`: first sample of the half row, in `low` and `high` and in `blocker`.
    at: Vec<[usize; 2]>,
    blocker_at: Vec<[usize; 2]>,
    scratch: Vec<u8>,
}

impl Strip {
    /// One that never has a vote.
    fn blind(labels: usize, half: usize) -> Self {
        let none = vec![0; half + VECTOR_SLACK];
        let at = vec![[0; 2]; labels];
        Self {
            low: none.clone(),
            high: none,
            blocker: vec![OUTSIDE; half + VECTOR_SLACK],
            blocker_at: at.clone(),
            at,
            scratch: Vec::new(),
        }
    }
}

/// How a row of one side is sampled.
enum Sampler<'a> {
    Blind,
    /// All labels shift along the row: `[label]` in 1/8 pixel, `radius` to the interval's ends.
    Rows {
        side: &'a Side,
        eighths: Vec<isize>,
        radius: isize,
    },
    /// `[2 * label + 1]` and the two halves beside it: scale and first x, y.
    Free {
        side: &'a Side,
        motions: Vec<(f64, f64, f64)>,
    },
}

impl<'a> Sampler<'a> {
    fn new(side: Option<&'a Side>, middle: &Intrinsics, range: &InverseDepthRange) -> Self {
        let Some(side) = side else { return Self::Blind };
        if side.motion.along_rows(middle, range) {
            let most = side.margin as f64 - 1.0;
            let eighths = |label: f64| {
                let (_, x, _) = side.motion.at(range.inverse_depth(label));
                (x.clamp(-most, most) * PHASES as f64).round() as isize
            };
            let step = (range.step() * side.motion.x).abs();
            return Self::Rows {
                side,
                eighths: (0..range.labels)
                    .map(|label| eighths(label as f64))
                    .collect(),
                radius: (step / 2.0 * PHASES as f64)
                    .round()
                    .clamp(0.0, PHASES as f64 / 2.0) as isize,
            };
        }
        let motions = (0..=2 * range.labels)
            .map(|half_label| {
                side.motion
                    .at(range.inverse_depth((half_label as f64 - 1.0) / 2.0))
            })
            .collect();
        Self::Free { side, motions }
    }

    fn strip(&self, labels: usize, board: &Checkerboard) -> Strip {
        match self {
            Self::Blind => Strip::blind(labels, board.half),
            Self::Rows { side, eighths, .. } => {
                let line = side.width.div_ceil(2) + VECTOR_SLACK;
                // First pixel and phase of a label, and of its half rows.
                let place = |eighths: &isize, parity: usize| {
                    let (pixels, phase) = (
                        eighths.div_euclid(PHASES as isize),
                        eighths.rem_euclid(PHASES as isize),
                    );
                    let x = (side.margin as isize + pixels) as usize + parity;
                    (x, phase as usize)
                };
                let at = |eighths: &isize, parity: usize| {
                    let (x, phase) = place(eighths, parity);
                    (x % 2 * PHASES + phase) * line + x / 2
                };
                let blocker_at = |eighths: &isize, parity: usize| {
                    let (x, phase) = place(eighths, parity);
                    (x % 2 * 2 + phase.min(1)) * line + x / 2
                };
                Strip {
                    low: vec![0; 2 * PHASES * line],
                    high: vec![0; 2 * PHASES * line],
                    blocker: vec![OUTSIDE; 4 * line],
                    at: eighths
                        .iter()
                        .map(|eighths| [at(eighths, 0), at(eighths, 1)])
                        .collect(),
                    blocker_at: eighths
                        .iter()
                        .map(|eighths| [blocker_at(eighths, 0), blocker_at(eighths, 1)])
                        .collect(),
                    scratch: vec![0; (2 * PHASES + 4) * line],
                }
            }
            Self::Free { side, motions } => {
                let line = board.half + VECTOR_SLACK;
                let at: Vec<_> = (0..labels)
                    .map(|label| [0, 1].map(|parity| (label * 2 + parity) * line))
                    .collect();
                Strip {
                    low: vec![0; labels * 2 * line],
                    high: vec![0; labels * 2 * line],
                    blocker: vec![OUTSIDE; labels * 2 * line],
                    blocker_at: at.clone(),
                    at,
                    scratch: vec![0; 2 * (side.width + 2) + 2 * motions.len() * (board.width + 1)],
                }
            }
        }
    }

    fn fill(&self, isa: Isa, y: usize, board: &Checkerboard, strip: &mut Strip) {
        match self {
            Self::Blind => {}
            Self::Rows { side, radius, .. } => {
                let from = (y + side.margin_rows) * side.width;
                let row = &side.luminance[from..from + side.width];
                let blocker = &side.blocker[from..from + side.width];
                // SAFETY: `isa` is available; the kernel is safe code.
                unsafe { fill_phases(isa, row, blocker, *radius, strip) };
            }
            Self::Free { side, motions } => fill_free(isa, side, motions, y, board, strip),
        }
    }
}

for_each_isa! {
    unsafe fn fill_phases = fill_phases_kernel(row: &[u8], blocker: &[u8], radius: isize, strip: &mut Strip)
}

/// The row at eight sub-pixel phases, even and odd pixels apart, with the interval to `radius` eighths around. Sample `i`
/// of phase `q` in 0..16 stands at pixel `2 i + q / 8`.
#[inline(always)]
fn fill_phases_kernel<V: Lanes>(row: &[u8], blocker: &[u8], radius: isize, strip: &mut Strip) {
    let line = row.len().div_ceil(2) + VECTOR_SLACK;
    let n = row.len().div_ceil(2);
    let Strip {
        low,
        high,
        blocker: blockers,
        scratch,
        ..
    } = strip;
    let (phases, pixels) = scratch.split_at_mut(2 * PHASES * line);
    let (row_even, rest) = pixels.split_at_mut(line);
    let (row_odd, rest) = rest.split_at_mut(line);
    let (blocker_even, blocker_odd) = rest.split_at_mut(line);
    part(row, row_even, row_odd);
    part(blocker, blocker_even, blocker_odd);
    // One sample of margin at the front, for intervals that begin before the row, and one at the end.
    for phase in 0..PHASES {
        let (w1, w0) = (phase as u16, (PHASES - phase) as u16);
        let half = PHASES as u16 / 2;
        let even = &mut phases[phase * line..][..n + 2];
        for i in 0..n {
            even[1 + i] = ((u16::from(row_even[i]) * w0 + u16::from(row_odd[i]) * w1 + half)
                / PHASES as u16) as u8;
        }
        (even[0], even[n + 1]) = (even[1], even[n]);
        let odd = &mut phases[(PHASES + phase) * line..][..n + 2];
        for i in 0..n {
            odd[1 + i] = ((u16::from(row_odd[i]) * w0 + u16::from(row_even[i + 1]) * w1 + half)
                / PHASES as u16) as u8;
        }
        (odd[0], odd[n + 1]) = (odd[1], odd[n]);
    }
    for q in 0..2 * PHASES {
        let begin = |eighths: isize| {
            let at = q as isize + eighths;
            let (pairs, q) = (
                at.div_euclid(2 * PHASES as isize),
                at.rem_euclid(2 * PHASES as isize) as usize,
            );
            q * line + (1 + pairs) as usize
        };
        let before = &phases[begin(-radius)..][..n];
        let here = &phases[begin(0)..][..n];
        let after = &phases[begin(radius)..][..n];
        let low = &mut low[q * line..][..n];
        for i in 0..n {
            low[i] = before[i].min(here[i]).min(after[i]);
        }
        let high = &mut high[q * line..][..n];
        for i in 0..n {
            high[i] = before[i].max(here[i]).max(after[i]);
        }
    }
    // A sample between two pixels needs both.
    for i in 0..n {
        blockers[i] = blocker_even[i];
        blockers[line + i] = blocker_even[i].max(blocker_odd[i]);
        blockers[2 * line + i] = blocker_odd[i];
        blockers[3 * line + i] = blocker_odd[i].max(blocker_even[i + 1]);
    }
}

/// Even and odd pixels of a row; the one beyond its end is as its last.
#[inline(always)]
fn part(row: &[u8], even: &mut [u8], odd: &mut [u8]) {
    let (pairs, rest) = row.as_chunks::<2>();
    // As words, which compilers vectorise.
    for (even, pair) in even.iter_mut().zip(pairs) {
        *even = u16::from_le_bytes(*pair) as u8;
    }
    for (odd, pair) in odd.iter_mut().zip(pairs) {
        *odd = (u16::from_le_bytes(*pair) >> 8) as u8;
    }
    let last = row[row.len() - 1];
    even[pairs.len()] = last;
    if !rest.is_empty() {
        odd[pairs.len()] = last;
    }
}

/// Every label's row sampled by itself, where a hypothesis also shifts rows or scales.
fn fill_free(
    isa: Isa,
    side: &Side,
    motions: &[(f64, f64, f64)],
    y: usize,
    board: &Checkerboard,
    strip: &mut Strip,
) {
    let Strip {
        low,
        high,
        blocker,
        at,
        scratch,
        ..
    } = strip;
    let (scratch, samples) = scratch.split_at_mut(2 * (side.width + 2));
    let (values, blockers) = samples.split_at_mut(motions.len() * (board.width + 1));
    let rows = values
        .chunks_exact_mut(board.width + 1)
        .zip(blockers.chunks_exact_mut(board.width + 1));
    for ((scale, x0, y0), (values, blockers)) in motions.iter().zip(rows) {
        // SAFETY: `isa` is available; the kernel is safe code.
        unsafe {
            sample_row(
                isa,
                side,
                (*scale, *x0, *y0),
                y,
                board.width,
                scratch,
                values,
                blockers,
            )
        };
    }
    let row =
        |values: &[u8], half_label: usize, x: usize| values[half_label * (board.width + 1) + x];
    for (label, at) in at.iter().enumerate() {
        for (parity, at) in at.iter().enumerate() {
            for i in 0..(board.width - parity).div_ceil(2) {
                let x = 2 * i + parity;
                let of = |half_label: usize| row(values, half_label, x);
                let (before, here, after) = (of(2 * label), of(2 * label + 1), of(2 * label + 2));
                low[at + i] = before.min(here).min(after);
                high[at + i] = before.max(here).max(after);
                blocker[at + i] = row(blockers, 2 * label + 1, x);
            }
        }
    }
}

for_each_isa! {
    unsafe fn sample_row = sample_row_kernel(
        side: &Side, motion: (f64, f64, f64), y: usize, width: usize, scratch: &mut [u8], values: &mut [u8], blockers: &mut [u8],
    )
}

#[inline(always)]
fn sample_row_kernel<V: Lanes>(
    side: &Side,
    (scale, x0, y0): (f64, f64, f64),
    y: usize,
    width: usize,
    scratch: &mut [u8],
    values: &mut [u8],
    blockers: &mut [u8],
) {
    let sixteenths = ((y as f64 * scale + y0 + side.margin_rows as f64) * 16.0).round() as i64;
    let rows = (side.luminance.len() / side.width) as i64;
    let (upper, weight) = (sixteenths.div_euclid(16), sixteenths.rem_euclid(16) as u16);
    if upper < 0 || upper + 1 >= rows {
        blockers.fill(OUTSIDE);
        values.fill(0);
        return;
    }
    let upper = upper as usize * side.width;
    let (blend, blocked) = scratch.split_at_mut(side.width + 2);
    let (a, b) = side.luminance[upper..upper + 2 * side.width].split_at(side.width);
    for ((to, a), b) in blend.iter_mut().zip(a).zip(b) {
        *to = ((u16::from(*a) * (16 - weight) + u16::from(*b) * weight + 8) / 16) as u8;
    }
    let (a, b) = side.blocker[upper..upper + 2 * side.width].split_at(side.width);
    for ((to, a), b) in blocked.iter_mut().zip(a).zip(b) {
        *to = if weight == 0 { *a } else { *a.max(b) };
    }
    let last = side.width as i64 - 2;
    let first = x0 + side.margin as f64;
    if (scale - 1.0).abs() * width as f64 <= 1.0 / 16.0 {
        let sixteenths = (first * 16.0).round() as i64;
        let (pixel, weight) = (sixteenths.div_euclid(16), sixteenths.rem_euclid(16) as u16);
        let pixel = pixel.clamp(0, last + 1 - width as i64) as usize;
        let (blend, blocked) = (
            &blend[pixel..pixel + width + 1],
            &blocked[pixel..pixel + width + 1],
        );
        for ((to, a), b) in values[..width].iter_mut().zip(blend).zip(&blend[1..]) {
            *to = ((u16::from(*a) * (16 - weight) + u16::from(*b) * weight + 8) / 16) as u8;
        }
        for ((to, a), b) in blockers[..width].iter_mut().zip(blocked).zip(&blocked[1..]) {
            *to = if weight == 0 { *a } else { *a.max(b) };
        }
        return;
    }
    // 16.16 fixed point along the row.
    let (mut position, step) = (
        (first * 65536.0).round() as i64,
        (scale * 65536.0).round() as i64,
    );
    for (value, blocker) in values[..width].iter_mut().zip(blockers.iter_mut()) {
        let pixel = position >> 16;
        let at = pixel.clamp(0, last) as usize;
        let weight = ((position >> 12) & 15) as u16;
        let (a, b) = (u16::from(blend[at]), u16::from(blend[at + 1]));
        *value = ((a * (16 - weight) + b * weight + 8) / 16) as u8;
        *blocker = if pixel == at as i64 {
            blocked[at].max(blocked[at + 1])
        } else {
            OUTSIDE
        };
        position += step;
    }
}

/// The middle image and what is known of it.
pub(super) struct Middle<'a> {
    pub intrinsics: &'a Intrinsics,
    pub luminance: &'a [u8],
    /// Metres, 0 = none.
    pub expected_depth_m: Option<&'a [f32]>,
}

/// Everything that the rows of one frame share.
pub(super) struct Sweep<'a> {
    isa: Isa,
    settings: &'a SweepSettings,
    middle: Middle<'a>,
    range: &'a InverseDepthRange,
    samplers: [Sampler<'a>; 2],
    tolerance: usize,
    board: Checkerboard,
}

/// What one thread fills rows with.
pub(super) struct Scratch {
    strips: [Strip; 2],
    luminance: Vec<u8>,
    expected: Vec<u8>,
}

impl<'a> Sweep<'a> {
    /// Both sides have been turned.
    pub fn new(
        isa: Isa,
        settings: &'a SweepSettings,
        middle: Middle<'a>,
        sides: [Option<&'a Side>; 2],
        range: &'a InverseDepthRange,
    ) -> Self {
        let board = Checkerboard::new(middle.intrinsics.width, middle.intrinsics.height);
        let samplers = sides.map(|side| Sampler::new(side, middle.intrinsics, range));
        let tolerance = sides
            .iter()
            .flatten()
            .map(|side| side.tolerance(range))
            .max()
            .unwrap_or(0);
        Self {
            isa,
            settings,
            middle,
            range,
            samplers,
            tolerance,
            board,
        }
    }

    pub fn scratch(&self) -> Scratch {
        let line = vec![0; self.board.half + VECTOR_SLACK];
        Scratch {
            strips: [0, 1].map(|side| self.samplers[side].strip(self.range.labels, &self.board)),
            luminance: line.clone(),
            expected: line,
        }
    }

    /// Costs of row `y`.
    pub fn fill_row(&self, scratch: &mut Scratch, y: usize, row: &mut CostRow<'_>) {
        let Self {
            board,
            range,
            middle,
            ..
        } = self;
        let Scratch {
            strips,
            luminance,
            expected,
        } = scratch;
        let labels = range.labels;
        for (sampler, strip) in self.samplers.iter().zip(strips.iter_mut()) {
            sampler.fill(self.isa, y, board, strip);
        }
        let pixels = y * board.width..(y + 1) * board.width;
        let colour_bytes = row.bytes.len() / 2;
        for (colour, costs) in row.bytes.chunks_exact_mut(colour_bytes).enumerate() {
            let parity = Checkerboard::parity(y, colour);
            let here = middle.luminance[pixels.clone()]
                .iter()
                .skip(parity)
                .step_by(2);
            for (to, from) in luminance.iter_mut().zip(here) {
                *to = *from;
            }
            if let Some(depth_m) = middle.expected_depth_m {
                let here = depth_m[pixels.clone()].iter().skip(parity).step_by(2);
                for (to, depth_m) in expected.iter_mut().zip(here) {
                    *to = if *depth_m > 0.0 {
                        range
                            .label_of_depth(f64::from(*depth_m))
                            .round()
                            .clamp(0.0, labels as f64 - 1.0) as u8
                    } else {
                        NOT_EXPECTED
                    };
                }
            }
            let half_row = HalfRow {
                luminance,
                expected: middle.expected_depth_m.map(|_| &expected[..]),
                strips,
                parity,
                tolerance: self.tolerance,
                board,
            };
            half_row.check(labels, costs);
            let isa = if board.half < 64 {
                self.isa.min(Isa::Avx2)
            } else {
                self.isa
            };
            // SAFETY: `isa` is available; `check` has found all slices long enough for vectors that start below
            // `half`, and no vector is longer than a half row or 32.
            unsafe { cost_half_row(isa, self.settings, &half_row, labels, costs) };
            // Outside the image there is nothing to cost; coarser levels sum these too.
            if 2 * (board.half - 1) + parity >= board.width {
                for costs in costs.chunks_exact_mut(board.stride) {
                    costs[board.half - 1] = 0;
                }
            }
        }
    }
}

/// Label that stands for an unknown depth; a range of 256 labels loses its nearest as an expectation.
const NOT_EXPECTED: u8 = 255;

struct HalfRow<'a> {
    luminance: &'a [u8],
    expected: Option<&'a [u8]>,
    strips: &'a [Strip; 2],
    parity: usize,
    /// Labels by which a blocker must be nearer.
    tolerance: usize,
    board: &'a Checkerboard,
}

impl HalfRow<'_> {
    fn check(&self, labels: usize, costs: &[u8]) {
        let reach = self.board.half.max(32);
        assert!(self.luminance.len() >= reach && costs.len() >= labels * self.board.stride);
        assert!(self.expected.is_none_or(|expected| expected.len() >= reach));
        for strip in self.strips {
            let end =
                |at: &[[usize; 2]]| at.iter().map(|at| at[self.parity]).max().unwrap_or(0) + reach;
            assert!(strip.at.len() == labels && strip.blocker_at.len() == labels);
            assert!(strip.low.len().min(strip.high.len()) >= end(&strip.at));
            assert!(strip.blocker.len() >= end(&strip.blocker_at));
        }
    }
}

for_each_isa! {
    unsafe fn cost_half_row = cost_kernel(settings: &SweepSettings, row: &HalfRow<'_>, labels: usize, costs: &mut [u8])
}

/// # Safety
/// [`HalfRow::check`] has passed.
#[inline(always)]
unsafe fn cost_kernel<V: Lanes>(
    settings: &SweepSettings,
    row: &HalfRow<'_>,
    labels: usize,
    costs: &mut [u8],
) {
    let Checkerboard { half, stride, .. } = *row.board;
    // SAFETY: see `sweep`.
    unsafe {
        let most = V::splat(settings.most_difference);
        let occlusion = V::splat(settings.occlusion);
        let most_surprise = V::splat(settings.most_surprise);
        let unseen = V::splat(settings.unseen);
        for start in Checkerboard::vector_starts(half, V::N) {
            let luminance = V::load(row.luminance.as_ptr().add(start));
            for label in 0..labels {
                // Plain loops: a closure would be a function of its own, without the vector instructions.
                let mut differences = [most; 2];
                let mut blockers = [most; 2];
                for side in 0..2 {
                    let strip = &row.strips[side];
                    let at = strip.at.get_unchecked(label)[row.parity] + start;
                    let low = V::load(strip.low.as_ptr().add(at));
                    let high = V::load(strip.high.as_ptr().add(at));
                    let difference = luminance
                        .sub_saturating(high)
                        .max(low.sub_saturating(luminance));
                    differences[side] = difference.min(most);
                    let blocker_at = strip.blocker_at.get_unchecked(label)[row.parity] + start;
                    blockers[side] = V::load(strip.blocker.as_ptr().add(blocker_at));
                }
                let ([left, right], [left_blocker, right_blocker]) = (differences, blockers);
                let passes = V::splat((label + row.tolerance).min(OUTSIDE as usize - 1) as u8);
                let l = left.replace_where_less(passes, left_blocker, right);
                let r = right.replace_where_less(passes, right_blocker, left);
                let mut cost = l.average(r).min(l.min(r).add(occlusion));
                cost = cost.replace_where_less(passes, left_blocker.min(right_blocker), unseen);
                if let Some(expected) = row.expected {
                    let expected = V::load(expected.as_ptr().add(start));
                    let here = V::splat(label as u8);
                    let away = here
                        .sub_saturating(expected)
                        .max(expected.sub_saturating(here))
                        .min(most_surprise);
                    let away =
                        away.replace_where_less(V::splat(NOT_EXPECTED - 1), expected, V::splat(0));
                    cost = cost.add(away);
                }
                cost.store(costs.as_mut_ptr().add(label * stride + start));
            }
        }
    }
}

/// A table that gives a side image the middle one's exposure: a line through the tenth, fiftieth and ninetieth hundredth of
/// both distributions of luminance. Differences that parallax alone explains change nothing.
pub(super) fn match_exposure(middle: &[u8], side: &[u8]) -> [u8; 256] {
    let same = std::array::from_fn(|value| value as u8);
    let quantiles = |image: &[u8]| {
        let mut count = [0_usize; 256];
        for value in image {
            count[usize::from(*value)] += 1;
        }
        [0.1, 0.5, 0.9].map(|part| {
            let mut left = (part * image.len() as f64) as usize;
            let value = count.iter().position(|n| {
                let found = left < *n;
                left = left.saturating_sub(*n);
                found
            });
            value.unwrap_or(255) as f64
        })
    };
    let (middle, side) = (quantiles(middle), quantiles(side));
    const UNNOTICED: f64 = 2.5;
    if middle
        .iter()
        .zip(&side)
        .all(|(m, s)| (m - s).abs() <= UNNOTICED)
        || side[2] - side[0] < 8.0
    {
        return same;
    }
    let gain = ((middle[2] - middle[0]) / (side[2] - side[0])).clamp(0.5, 2.0);
    let offset = (0..3).map(|i| middle[i] - gain * side[i]).sum::<f64>() / 3.0;
    std::array::from_fn(|value| (gain * value as f64 + offset).round().clamp(0.0, 255.0) as u8)
}

/// Where a side sees the middle's pixels at one hypothesis, in its turned image.
#[derive(Clone, Copy)]
struct Placing {
    scale: f32,
    x: f32,
    y: f32,
}

impl Side {
    fn placings(&self, range: &InverseDepthRange) -> Vec<Placing> {
        let placing = |label: usize| {
            let (scale, x, y) = self.motion.at(range.inverse_depth(label as f64));
            Placing {
                scale: scale as f32,
                x: (x + self.margin as f64 + 0.5) as f32,
                y: (y + self.margin_rows as f64 + 0.5) as f32,
            }
        };
        (0..range.labels).map(placing).collect()
    }

    /// Index on the canvas; `None` beyond it.
    fn place(&self, placing: Placing, x: usize, y: usize) -> Option<usize> {
        // Rounds, as what is added contains a half.
        let u = (x as f32 * placing.scale + placing.x) as i32;
        let v = (y as f32 * placing.scale + placing.y) as i32;
        let at = v as usize * self.width + u as usize;
        (u >= 0 && v >= 0 && u < self.width as i32 && at < self.blocker.len()).then_some(at)
    }

    /// A slanted surface puts neighbours up to a pixel apart in one place: only what is nearer by more labels than
    /// these hides what is behind.
    pub fn tolerance(&self, range: &InverseDepthRange) -> usize {
        let labels = (1.0 / self.pixels_per_label(range)).min(range.labels as f64);
        labels.ceil() as usize + 1
    }

    /// How far one label moves the middle of the image, on average.
    pub fn pixels_per_label(&self, range: &InverseDepthRange) -> f64 {
        let (far, near) = (self.motion.at(range.far), self.motion.at(range.near));
        let centre = |(scale, x, y): (f64, f64, f64)| {
            (scale * self.motion.cx + x, scale * self.motion.cy + y)
        };
        let ((x0, y0), (x1, y1)) = (centre(far), centre(near));
        (x1 - x0).hypot(y1 - y0) / (range.labels - 1) as f64
    }

    /// Lets the middle's pixels, `width` in a row, block the view of what is behind them.
    pub fn block(&mut self, range: &InverseDepthRange, beliefs: &[Belief], width: usize) {
        self.blocker.clone_from(&self.outside);
        let placings = self.placings(range);
        for (y, row) in beliefs.chunks_exact(width).enumerate() {
            for (x, Belief { label, .. }) in row.iter().enumerate() {
                if let Some(at) = self.place(placings[usize::from(*label)], x, y) {
                    self.blocker[at] = self.blocker[at].max(*label);
                }
            }
        }
    }

    /// Adds `bit` where nothing blocks the view of a pixel's label.
    pub fn mark_seen(
        &self,
        range: &InverseDepthRange,
        beliefs: &[Belief],
        width: usize,
        bit: u8,
        seen_by: &mut [u8],
    ) {
        let placings = self.placings(range);
        let tolerance = self.tolerance(range);
        let rows = beliefs
            .chunks_exact(width)
            .zip(seen_by.chunks_exact_mut(width));
        for (y, (beliefs, seen_by)) in rows.enumerate() {
            for (x, (Belief { label, .. }, seen_by)) in beliefs.iter().zip(seen_by).enumerate() {
                let label = usize::from(*label);
                if let Some(at) = self.place(placings[label], x, y) {
                    let passes = (label + tolerance).min(usize::from(OUTSIDE) - 1);
                    *seen_by |= if usize::from(self.blocker[at]) <= passes {
                        bit
                    } else {
                        0
                    };
                }
            }
        }
    }
}
