//! A side image, turned once a frame to the middle camera's axes and lens (its image of infinitely far points), so that
//! a hypothesis only shifts it, and scales it if a side camera stands before or behind the middle one; and who stands
//! in whose view of it.
//! In: luminance of the side, its calibration, later a first answer. Out: the turned image with what blocks each pixel's
//! view, and which of the middle's pixels it sees.

use super::{
    messages::Belief,
    rig::{InverseDepthRange, SideCamera},
};
use crate::model::camera::Intrinsics;
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;

/// Blocks the view of every label: beyond the image.
pub(super) const OUTSIDE: u8 = 255;

/// A side image turned to the middle camera's axes and lens, with a margin on all sides.
#[derive(Default)]
pub(super) struct Side {
    /// What the canvas was made for.
    seen: Option<(Intrinsics, SideCamera, usize, usize)>,
    /// Per pixel of the canvas: where in the side image, `None` outside; empty if the canvas is the image itself.
    look_up: Vec<LookUp>,
    /// Of the canvas, which begins `margin` pixels left of and `margin_rows` above the image.
    pub width: usize,
    pub margin: usize,
    pub margin_rows: usize,
    pub luminance: Vec<u8>,
    /// [`OUTSIDE`] where there is no image, else 0.
    outside: Vec<u8>,
    /// The least label that is seen there past what is known to stand in front: `outside`, and nearest labels.
    pub blocker: Vec<u8>,
    pub motion: Motion,
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
pub(super) struct Motion {
    /// Pixel metres.
    pub x: f64,
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
    pub fn at(&self, inverse_depth: f64) -> (f64, f64, f64) {
        // A point at or behind the side camera is seen nowhere; a scale this great leads off any image.
        let scale = 1.0 / (1.0 + inverse_depth * self.z).max(1e-3);
        (
            scale,
            (inverse_depth * self.x - self.cx) * scale + self.cx,
            (inverse_depth * self.y - self.cy) * scale + self.cy,
        )
    }

    /// The image keeps its rows and its scale, to a fraction of a pixel that interpolation hides.
    pub fn along_rows(&self, middle: &Intrinsics, range: &InverseDepthRange) -> bool {
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

/// Where a side sees the middle's pixels at one hypothesis, in its turned image, with
/// [`FRACTION_BITS`] below a pixel.
#[derive(Clone, Copy)]
struct Placing {
    scale: i64,
    x: i64,
    y: i64,
}

/// Bits below a pixel: an image's size times the greatest scale fits above them.
const FRACTION_BITS: u32 = 20;

impl Side {
    fn placings(&self, range: &InverseDepthRange) -> Vec<Placing> {
        let fixed = |value: f64| (value * f64::from(1_u32 << FRACTION_BITS)) as i64;
        let placing = |label: usize| {
            let (scale, x, y) = self.motion.at(range.inverse_depth(label as f64));
            Placing {
                scale: fixed(scale),
                // What is cut off below a pixel is then rounded.
                x: fixed(x + self.margin as f64 + 0.5),
                y: fixed(y + self.margin_rows as f64 + 0.5),
            }
        };
        (0..range.labels).map(placing).collect()
    }

    /// Columns by which each label's place is right of a pixel's, if that is all: no scale, one row for all labels. The
    /// same places as [`place`](Self::place), in less time.
    fn shifts(&self, placings: &[Placing]) -> Option<[i32; 256]> {
        let same =
            |placing: &Placing| placing.scale == 1 << FRACTION_BITS && placing.y == placings[0].y;
        placings.iter().all(same).then(|| {
            let shift = |placing: &Placing| (placing.x >> FRACTION_BITS) as i32;
            std::array::from_fn(|label| placings.get(label).map_or(i32::MIN, shift))
        })
    }

    /// Where row `y` begins on the canvas; `None` beyond it.
    fn place_row(&self, placing: Placing, y: usize) -> Option<usize> {
        let row = (y as i64 * placing.scale + placing.y) >> FRACTION_BITS;
        let at = usize::try_from(row).ok()? * self.width;
        (at < self.blocker.len()).then_some(at)
    }

    /// Index on the canvas from a row's; `None` beyond it.
    fn place(&self, row: usize, placing: Placing, x: usize) -> Option<usize> {
        let column = (x as i64 * placing.scale + placing.x) >> FRACTION_BITS;
        ((column as u64) < self.width as u64).then(|| row + column as usize)
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

    /// Luminance of middle pixels, one a belief, and of the side where it sees the same, as turned.
    pub fn counterparts(
        &self,
        range: &InverseDepthRange,
        beliefs: &[Belief],
        middle_y: &[u8],
        middle: &Intrinsics,
        scale: usize,
    ) -> (Vec<u8>, Vec<u8>) {
        let placings = self.placings(range);
        let rows = beliefs.chunks_exact(middle.width.div_ceil(scale));
        let mut pairs = (Vec::new(), Vec::new());
        for (y, row) in rows
            .enumerate()
            .map(|(row, beliefs)| (row * scale, beliefs))
        {
            for (x, belief) in (0..middle.width).step_by(scale).zip(row) {
                let placing = placings[usize::from(belief.label)];
                if let Some(row) = self.place_row(placing, y)
                    && let Some(at) = self.place(row, placing, x)
                    && self.outside[at] != OUTSIDE
                {
                    pairs.0.push(middle_y[y * middle.width + x]);
                    pairs.1.push(self.luminance[at]);
                }
            }
        }
        pairs
    }

    /// Lets the middle's pixels block the view of what is behind them, where they are believed by a margin of `firm` or
    /// more: what is taken for near by mistake would hide the very labels that are right, all around it. One belief
    /// stands for `scale * scale` pixels.
    pub fn block(
        &mut self,
        range: &InverseDepthRange,
        beliefs: &[Belief],
        middle: &Intrinsics,
        scale: usize,
        firm: u8,
    ) {
        self.blocker.clone_from(&self.outside);
        let placings = self.placings(range);
        let shifts = self.shifts(&placings);
        let columns = middle.width.div_ceil(scale);
        for y in 0..middle.height {
            let row = &beliefs[y / scale * columns..][..columns];
            if let Some(shifts) = &shifts {
                let Some(start) = self.place_row(placings[0], y) else {
                    continue;
                };
                let blocker = &mut self.blocker[start..][..self.width];
                block_row(row, shifts, scale, middle.width, firm, blocker);
                continue;
            }
            for (column, belief) in row.iter().enumerate() {
                if belief.margin() < firm {
                    continue;
                }
                let placing = placings[usize::from(belief.label)];
                let Some(start) = self.place_row(placing, y) else {
                    continue;
                };
                for x in column * scale..((column + 1) * scale).min(middle.width) {
                    if let Some(at) = self.place(start, placing, x) {
                        self.blocker[at] = self.blocker[at].max(belief.label);
                    }
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
        let shifts = self.shifts(&placings);
        let tolerance = self.tolerance(range);
        let passes: [u8; 256] =
            std::array::from_fn(|label| (label + tolerance).min(usize::from(OUTSIDE) - 1) as u8);
        let rows = beliefs
            .chunks_exact(width)
            .zip(seen_by.chunks_exact_mut(width));
        for (y, (beliefs, seen_by)) in rows.enumerate() {
            if let Some(shifts) = &shifts {
                if let Some(start) = self.place_row(placings[0], y) {
                    let blocker = &self.blocker[start..][..self.width];
                    for (x, (Belief { label, .. }, seen_by)) in
                        beliefs.iter().zip(seen_by).enumerate()
                    {
                        let at = (x as i32).wrapping_add(shifts[usize::from(*label)]);
                        let blocker = *blocker.get(at as u32 as usize).unwrap_or(&OUTSIDE);
                        *seen_by |= if blocker <= passes[usize::from(*label)] {
                            bit
                        } else {
                            0
                        };
                    }
                }
                continue;
            }
            for (x, (Belief { label, .. }, seen_by)) in beliefs.iter().zip(seen_by).enumerate() {
                let placing = placings[usize::from(*label)];
                if let Some(row) = self.place_row(placing, y)
                    && let Some(at) = self.place(row, placing, x)
                {
                    *seen_by |= if self.blocker[at] <= passes[usize::from(*label)] {
                        bit
                    } else {
                        0
                    };
                }
            }
        }
    }
}

/// One row of [`Side::block`], where labels only shift it.
fn block_row(
    row: &[Belief],
    shifts: &[i32; 256],
    scale: usize,
    width: usize,
    firm: u8,
    blocker: &mut [u8],
) {
    for (column, belief) in row.iter().enumerate() {
        // Blocks nothing, without a branch that is as good as random.
        let label = if belief.margin() < firm {
            0
        } else {
            belief.label
        };
        let shift = shifts[usize::from(belief.label)];
        for x in column * scale..((column + 1) * scale).min(width) {
            let at = (x as i32).wrapping_add(shift);
            if let Some(blocker) = blocker.get_mut(at as u32 as usize) {
                *blocker = label.max(*blocker);
            }
        }
    }
}
