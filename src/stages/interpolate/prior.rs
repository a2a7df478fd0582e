//! The interpolated beliefs of a whole image.

use crate::model::belief::{Belief, CHANNELS, rgb_from_ycbcr};

/// Planes of a [`Prior`] row. Channels in the order Y, Cb, Cr.
pub const ALPHA: usize = 0;
pub const BETA: usize = 1;
pub const TAU: usize = 4;
pub const SIGMA: usize = 7;
pub const TAU2: usize = 10;
pub const P2: usize = 13;
/// Metres, of the kept views; 0 where unseen.
pub const DEPTH: usize = 14;
/// How many views saw the pixel, outvoted ones included.
pub const COVERAGE: usize = 15;
pub const PLANES: usize = 16;

/// What nobody saw is shown in a grey that stands back.
const UNSEEN_RGB: [u8; 3] = [40, 40, 40];

/// Row after row, each a run of [`PLANES`] planes of `width` values: a pass over a row touches 16 short streams, and
/// rows can be shared out among threads.
#[derive(Debug, Clone, Default)]
pub struct Prior {
    pub width: usize,
    pub height: usize,
    pub data: Vec<f32>,
}

impl Prior {
    /// Sized for an image, keeping its allocation; the contents are unspecified.
    pub fn resize(&mut self, width: usize, height: usize) {
        self.width = width;
        self.height = height;
        self.data.resize(width * height * PLANES, 0.0);
    }

    pub fn row(&self, y: usize) -> PriorRow<'_> {
        PriorRow::of(&self.data, y, self.width)
    }

    /// One plane of the whole image, row by row.
    pub fn plane(&self, plane: usize) -> impl Iterator<Item = f32> {
        (0..self.height).flat_map(move |y| self.row(y).plane(plane).iter().copied())
    }

    pub fn belief(&self, x: usize, y: usize) -> Belief {
        self.row(y).belief(x)
    }
}

#[derive(Clone, Copy)]
pub struct PriorRow<'a> {
    pub width: usize,
    pub data: &'a [f32],
}

impl<'a> PriorRow<'a> {
    /// Row `y` of such rows.
    pub fn of(data: &'a [f32], y: usize, width: usize) -> Self {
        let stride = width * PLANES;
        Self {
            width,
            data: &data[y * stride..][..stride],
        }
    }

    #[inline(always)]
    pub fn plane(&self, plane: usize) -> &'a [f32] {
        &self.data[plane * self.width..][..self.width]
    }

    /// What is expected, for people.
    pub fn expected_rgb(&self, x: usize) -> [u8; 3] {
        if self.plane(COVERAGE)[x] > 0.0 {
            rgb_from_ycbcr([TAU, TAU + 1, TAU + 2].map(|plane| self.plane(plane)[x]))
        } else {
            UNSEEN_RGB
        }
    }

    #[inline(always)]
    pub fn belief(&self, x: usize) -> Belief {
        let at = |plane: usize| self.plane(plane)[x];
        let channels =
            |plane: usize| -> [f32; CHANNELS] { [at(plane), at(plane + 1), at(plane + 2)] };
        Belief {
            alpha: at(ALPHA),
            beta: channels(BETA),
            tau: channels(TAU),
            sigma: channels(SIGMA),
            tau2: channels(TAU2),
            p2: at(P2),
        }
    }
}

/// Writes one pixel of a row of planes.
#[inline(always)]
pub fn put(row: &mut [f32], width: usize, x: usize, belief: &Belief, depth_m: f32, coverage: f32) {
    let mut set = |plane: usize, value: f32| row[plane * width + x] = value;
    set(ALPHA, belief.alpha);
    for channel in 0..CHANNELS {
        set(BETA + channel, belief.beta[channel]);
        set(TAU + channel, belief.tau[channel]);
        set(SIGMA + channel, belief.sigma[channel]);
        set(TAU2 + channel, belief.tau2[channel]);
    }
    set(P2, belief.p2);
    set(DEPTH, depth_m);
    set(COVERAGE, coverage);
}
