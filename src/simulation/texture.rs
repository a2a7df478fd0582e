//! Procedural textures: the colour of a surface at a point, averaged over what one pixel covers of it.
//!
//! Colours are linear RGB. Detail finer than the `footprint` (metres on the surface) fades into its mean, so that
//! textures neither flicker nor alias.

use nalgebra::Point3;

pub type Rgb = [f32; 3];

/// Linear RGB of a colour as people write it, 0xRRGGBB.
pub fn rgb(hex: u32) -> Rgb {
    [16, 8, 0].map(|shift| {
        let value = ((hex >> shift) & 0xff) as f32 / 255.0;
        if value <= 0.040_45 {
            value / 12.92
        } else {
            ((value + 0.055) / 1.055).powf(2.4)
        }
    })
}

pub fn mixed(a: Rgb, b: Rgb, share_of_b: f32) -> Rgb {
    std::array::from_fn(|i| a[i] + (b[i] - a[i]) * share_of_b)
}

pub fn scaled(colour: Rgb, factor: f32) -> Rgb {
    colour.map(|value| value * factor)
}

/// Where on a surface a colour is asked for.
#[derive(Debug, Clone, Copy)]
pub struct Spot {
    /// Metres, right and up on the surface.
    pub u: f64,
    pub v: f64,
    pub part: usize,
    pub point: Point3<f64>,
    /// Diameter of what a pixel covers, metres.
    pub footprint: f64,
}

#[derive(Debug, Clone)]
pub enum Pattern {
    Plain(Rgb),
    /// A tartan of unequal stripes with a woven grain.
    Cloth {
        ground: Rgb,
        warp: Rgb,
        weft: Rgb,
        seed: u32,
    },
    Planks {
        light: Rgb,
        dark: Rgb,
        width: f64,
        seed: u32,
    },
    /// Painted plaster below a patterned paper.
    Wallpaper {
        ground: Rgb,
        figure: Rgb,
        seed: u32,
    },
    /// Cloud-like variation between two colours, `size` metres.
    Mottled {
        a: Rgb,
        b: Rgb,
        size: f64,
        seed: u32,
    },
    /// Rings around an upright object, `period` metres.
    Rings {
        a: Rgb,
        b: Rgb,
        period: f64,
        share_of_b: f32,
    },
    /// Knitted or woven stripes along v.
    Knit {
        a: Rgb,
        b: Rgb,
        period: f64,
    },
    Picture {
        width: f64,
        height: f64,
        seed: u32,
    },
    Spine {
        ground: Rgb,
        ink: Rgb,
        seed: u32,
    },
    Label(Label),
}

/// Printed paper around a package.
#[derive(Debug, Clone)]
pub struct Label {
    pub ground: Rgb,
    pub band: Rgb,
    pub ink: Rgb,
    pub text: &'static str,
    /// Height of a letter, metres.
    pub letter: f64,
    /// Height of the text's middle above the base, metres.
    pub text_v: f64,
    /// Between the starts of neighbouring texts around the object, metres.
    pub repeat: f64,
    /// The band lies between these heights; its edges are waves.
    pub band_v: (f64, f64),
    pub seed: u32,
}

/// A coin-like hash of a grid point, 0..1.
#[inline]
fn hash(x: i64, y: i64, seed: u32) -> f32 {
    let mut h = (x as u32)
        .wrapping_mul(0x9e37_79b1)
        .wrapping_add((y as u32).wrapping_mul(0x85eb_ca77))
        .wrapping_add(seed.wrapping_mul(0xc2b2_ae3d));
    h = (h ^ (h >> 15)).wrapping_mul(0x2c1b_3c6d);
    h = (h ^ (h >> 12)).wrapping_mul(0x297a_2d39);
    h ^= h >> 15;
    (h >> 8) as f32 * (1.0 / (1 << 24) as f32)
}

/// Value noise of period 1, -1..1.
#[inline]
fn noise(x: f64, y: f64, seed: u32) -> f32 {
    let (i, j) = (floor(x), floor(y));
    let (column, row) = (i as f64, j as f64);
    let smooth = |t: f32| t * t * (3.0 - 2.0 * t);
    let (s, t) = (smooth((x - column) as f32), smooth((y - row) as f32));
    let top = hash(i, j, seed) * (1.0 - s) + hash(i + 1, j, seed) * s;
    let bottom = hash(i, j + 1, seed) * (1.0 - s) + hash(i + 1, j + 1, seed) * s;
    (top * (1.0 - t) + bottom * t) * 2.0 - 1.0
}

/// Without SSE4.1, `f64::floor` is a call into the C library.
#[inline]
fn floor(x: f64) -> i64 {
    let whole = x as i64;
    whole - i64::from(x < whole as f64)
}

/// How much of a detail of this size survives a pixel of that footprint, 0..1.
fn kept(size: f64, footprint: f64) -> f32 {
    ((size / footprint - 1.0) as f32).clamp(0.0, 1.0)
}

/// Sum of noises from `size` downwards, each half as large and as strong; -1..1 about.
fn clouds(u: f64, v: f64, size: f64, octaves: u32, footprint: f64, seed: u32) -> f32 {
    let (mut sum, mut size, mut strength) = (0.0, size, 0.6);
    for octave in 0..octaves {
        let share = kept(size, footprint);
        if share == 0.0 {
            break;
        }
        sum += strength * share * noise(u / size, v / size, seed + octave);
        size *= 0.5;
        strength *= 0.55;
    }
    sum
}

/// 1 where `x > edge`, 0 where it is less, the covered share in between.
fn above(x: f64, edge: f64, footprint: f64) -> f32 {
    (((x - edge) / footprint + 0.5) as f32).clamp(0.0, 1.0)
}

fn between(x: f64, low: f64, high: f64, footprint: f64) -> f32 {
    above(x, low, footprint) * (1.0 - above(x, high, footprint))
}

/// Stripes of unequal width in a strip pattern of 0.21 m, of strength 0..1.
fn stripes(x: f64, footprint: f64, seed: u32) -> f32 {
    const PERIOD: f64 = 0.21;
    const LINES: [(f64, f64, f32); 6] = [
        (0.010, 0.034, 0.85),
        (0.043, 0.049, 0.60),
        (0.084, 0.092, 0.45),
        (0.118, 0.148, 0.70),
        (0.156, 0.161, 0.90),
        (0.186, 0.191, 0.40),
    ];
    let turn = floor(x / PERIOD);
    let inside = x - turn as f64 * PERIOD;
    LINES
        .iter()
        .zip(0..)
        // A line is shifted by 6 mm at most.
        .filter(|((low, high, _), _)| {
            inside > low - 0.006 - footprint && inside < high + 0.006 + footprint
        })
        .map(|(&(low, high, strength), line)| {
            let shift = f64::from(hash(turn, line, seed) - 0.5) * 0.012;
            strength * between(inside, low + shift, high + shift, footprint)
        })
        .sum::<f32>()
        .min(1.0)
}

impl Pattern {
    /// Linear RGB reflectance.
    pub fn colour(&self, spot: &Spot) -> Rgb {
        let Spot {
            u, v, footprint, ..
        } = *spot;
        match self {
            Self::Plain(colour) => *colour,
            Self::Cloth {
                ground,
                warp,
                weft,
                seed,
            } => {
                let fold = f64::from(clouds(u, v, 0.11, 1, footprint, seed + 9)) * 0.004;
                let along = stripes(u + fold, footprint, *seed);
                let across = stripes(v + fold * 0.7 + 0.05, footprint, seed + 1);
                let colour = mixed(mixed(*ground, *warp, along * 0.8), *weft, across * 0.62);
                // Embroidered dots in some of the tartan's fields.
                let (i, j) = (floor(u / 0.07), floor(v / 0.07));
                let (column, row) = (i as f64, j as f64);
                let chosen = hash(i, j, seed + 4);
                let colour = if chosen > 0.55 {
                    let du = u - (column + 0.3 + f64::from(chosen) * 0.4) * 0.07;
                    let dv = v - (row + 0.5) * 0.07;
                    let radius = (du * du + dv * dv).sqrt();
                    // Beyond its longest petals there is nothing of it.
                    if radius < 0.013 + footprint {
                        let petal = 0.009 + 0.004 * (5.0 * dv.atan2(du)).cos();
                        let figure = 1.0 - above(radius, petal, footprint);
                        let heart = 1.0 - above(radius, 0.004, footprint);
                        let thread = mixed(*warp, rgb(0xc98a2b), f32::from(chosen > 0.78));
                        mixed(mixed(colour, thread, figure * 0.9), rgb(0xf4e3b0), heart)
                    } else {
                        colour
                    }
                } else {
                    colour
                };
                let grain = 1.0
                    + 0.10 * clouds(u, v, 0.02, 2, footprint, seed + 2)
                    + 0.05 * clouds(u, v, 0.2, 1, footprint, seed + 3);
                scaled(colour, grain)
            }
            Self::Planks {
                light,
                dark,
                width,
                seed,
            } => {
                let plank = (v / width).floor();
                let lane = plank as i64;
                let shift = f64::from(hash(lane, 0, *seed)) * 2.0;
                let length = ((u + shift) / 1.3).floor();
                let tint = hash(lane, length as i64, seed + 1);
                let own = u + f64::from(tint) * 17.0;
                let wave = f64::from(clouds(own, v, 0.25, 1, footprint, seed + 6)) * 0.02;
                let grain = clouds(own * 0.12, v + wave, 0.016, 3, footprint, seed + 2)
                    + 0.5 * clouds(own * 0.3, v, 0.07, 2, footprint, seed + 3);
                let colour = mixed(
                    *light,
                    *dark,
                    (0.25 + 0.4 * tint + 0.45 * grain).clamp(0.0, 1.0),
                );
                let gap = 0.0025;
                let joint = between(v - plank * width, 0.0, gap, footprint)
                    + between(u + shift - length * 1.3, 0.0, gap, footprint);
                scaled(colour, 1.0 - 0.65 * joint.min(1.0))
            }
            Self::Wallpaper {
                ground,
                figure,
                seed,
            } => {
                let (column, row) = ((u / 0.16).floor(), (v / 0.2).floor());
                let odd = (column as i64).rem_euclid(2) as f64;
                let row = if odd > 0.0 {
                    ((v - 0.1) / 0.2).floor()
                } else {
                    row
                };
                let du = u - (column + 0.5) * 0.16;
                let dv = v - (row + 0.5) * 0.2 - odd * 0.1;
                let radius = (du * du + 0.64 * dv * dv).sqrt();
                // Its longest petals reach 57 mm.
                let shape = if radius < 0.057 + footprint {
                    let angle = dv.atan2(du);
                    let tilt = f64::from(hash(column as i64, row as i64, *seed)) * 6.0;
                    let edge =
                        0.035 + 0.016 * (5.0 * angle + tilt).cos() + 0.006 * (9.0 * angle).sin();
                    between(radius, 0.012, edge, footprint)
                } else {
                    0.0
                };
                let stalk = if du.abs() < 0.015 + footprint {
                    between(du + 0.012 * (dv * 40.0).sin(), -0.003, 0.003, footprint)
                } else {
                    0.0
                };
                let colour = mixed(*ground, *figure, (0.75 * shape + 0.4 * stalk).min(0.85));
                let grain = 1.0
                    + 0.05 * clouds(u, v, 0.03, 2, footprint, seed + 2)
                    + 0.09 * clouds(u, v, 0.5, 2, footprint, seed + 3);
                scaled(colour, grain)
            }
            Self::Mottled { a, b, size, seed } => {
                let share = 0.5 + 0.7 * clouds(u, v, *size, 3, footprint, *seed);
                mixed(*a, *b, share.clamp(0.0, 1.0))
            }
            Self::Rings {
                a,
                b,
                period,
                share_of_b,
            } => {
                let x = spot.v.rem_euclid(*period);
                let width = f64::from(*share_of_b) * period;
                mixed(
                    *a,
                    *b,
                    between(x, (period - width) * 0.5, (period + width) * 0.5, footprint),
                )
            }
            Self::Knit { a, b, period } => {
                let x = (v + 0.3 * period * f64::from(noise(u / period, v / period, 5)))
                    .rem_euclid(*period);
                let line = between(x, 0.0, period * 0.4, footprint);
                let grain = 1.0
                    + 0.16 * clouds(u, v, 0.012, 2, footprint, 31)
                    + 0.2 * clouds(u, v, 0.09, 2, footprint, 32);
                scaled(mixed(*a, *b, line), grain)
            }
            Self::Picture {
                width,
                height,
                seed,
            } => picture(spot, *width, *height, *seed),
            Self::Spine { ground, ink, seed } => {
                let title = f32::from(
                    hash(
                        (v / 0.006).floor() as i64,
                        (u / 0.004).floor() as i64,
                        seed + 1,
                    ) > 0.45,
                ) * between(v, 0.05, 0.13, footprint)
                    * between(u, -0.007, 0.007, footprint)
                    * kept(0.008, footprint);
                let bands =
                    between(v, 0.018, 0.026, footprint) + between(v, 0.150, 0.156, footprint);
                let grain = 1.0 + 0.12 * clouds(u, v, 0.03, 2, footprint, *seed);
                scaled(mixed(*ground, *ink, (title + bands).min(1.0) * 0.85), grain)
            }
            Self::Label(label) => label.colour(spot),
        }
    }
}

/// A painted landscape: sky, sun, hills and a field.
fn picture(spot: &Spot, width: f64, height: f64, seed: u32) -> Rgb {
    let Spot {
        u, v, footprint, ..
    } = *spot;
    let (x, y) = (u / width, v / height);
    let border = 0.025;
    if u.abs() > width * 0.5 - border || v < border || v > height - border {
        return mixed(
            rgb(0x4a2f1a),
            rgb(0x8a6237),
            0.5 + 0.5 * noise(u / 0.01, v / 0.05, seed),
        );
    }
    let sky = mixed(
        rgb(0xf0d9a8),
        rgb(0x5f93b8),
        (y as f32 * 1.4 - 0.4).clamp(0.0, 1.0),
    );
    let sun = 1.0
        - above(
            (x - 0.18).hypot((y - 0.72) * height / width),
            0.07,
            footprint / width,
        );
    let mut colour = mixed(sky, rgb(0xfff3c4), sun);
    let brush = 1.0 + 0.25 * clouds(u, v * 2.5, 0.03, 2, footprint, seed + 7);
    for (layer, (level, paint)) in [
        (0.55, 0x6d7fa0),
        (0.42, 0x4f7a58),
        (0.28, 0x9aa04a),
        (0.14, 0xb8763a),
    ]
    .into_iter()
    .enumerate()
    {
        let hill = level
            + 0.10 * f64::from(noise(x * 3.1, layer as f64 * 7.3, seed))
            + 0.03 * f64::from(noise(x * 11.0, layer as f64 * 3.7, seed + 1));
        colour = mixed(rgb(paint), colour, above(y, hill, footprint / height));
    }
    scaled(colour, brush)
}

impl Label {
    fn colour(&self, spot: &Spot) -> Rgb {
        let Spot {
            u, v, footprint, ..
        } = *spot;
        let cell = (u / self.repeat).round();
        let x = u - cell * self.repeat;
        let wave = 0.004 * (x / self.repeat * std::f64::consts::TAU * 2.0).sin();
        let band = between(v, self.band_v.0 + wave, self.band_v.1 + wave, footprint);
        let rim = between(
            v,
            self.band_v.1 + wave + 0.003,
            self.band_v.1 + wave + 0.006,
            footprint,
        );
        let mut colour = mixed(self.ground, self.band, (band + rim).min(1.0));
        // Small print and a round emblem below the name.
        let emblem_v = self.text_v - self.letter * 1.5;
        let emblem = x.hypot(v - emblem_v);
        let ring = between(emblem, self.letter * 0.45, self.letter * 0.6, footprint) + 1.0
            - above(emblem, self.letter * 0.25, footprint);
        colour = mixed(colour, self.ink, ring.min(1.0) * 0.9);
        let line = ((v - 0.01) / 0.006).floor();
        let print = f32::from(hash((u / 0.004).floor() as i64, line as i64, self.seed) > 0.4)
            * f32::from((0.0..4.0).contains(&line))
            * between((v - 0.01).rem_euclid(0.006), 0.0015, 0.0045, footprint)
            * between(x, -self.repeat * 0.3, self.repeat * 0.3, footprint);
        colour = mixed(colour, self.ink, print * 0.7);
        let ink = text_cover(self.text, x, v - self.text_v, self.letter, footprint);
        mixed(colour, self.ink, ink)
    }
}

/// Share of the pixel that letters cover; `(x, y)` metres from the text's middle.
fn text_cover(text: &str, x: f64, y: f64, letter: f64, footprint: f64) -> f32 {
    let dot = letter / 7.0;
    let width = text.len() as f64 * 6.0 * dot;
    if x.abs() > width * 0.5 + footprint || y.abs() > letter * 0.5 + footprint {
        return 0.0;
    }
    let set = |x: f64, y: f64| {
        let column = ((x + width * 0.5) / dot).floor() as i64;
        let row = ((letter * 0.5 - y) / dot).floor() as i64;
        if column < 0 || !(0..7).contains(&row) {
            return false;
        }
        let Some(character) = text.as_bytes().get(column as usize / 6) else {
            return false;
        };
        let within = column % 6;
        within < 5 && glyph(*character)[row as usize] >> (4 - within) & 1 == 1
    };
    // Sixteen samples of the footprint.
    let hits = (0..16)
        .filter(|i| {
            let offset = |k: i32| (f64::from(k) + 0.5) / 4.0 - 0.5;
            set(x + offset(i % 4) * footprint, y + offset(i / 4) * footprint)
        })
        .count();
    hits as f32 / 16.0
}

/// Five by seven dots, most significant of five bits on the left.
fn glyph(character: u8) -> [u8; 7] {
    match character {
        b'A' => [0x0e, 0x11, 0x11, 0x1f, 0x11, 0x11, 0x11],
        b'C' => [0x0e, 0x11, 0x10, 0x10, 0x10, 0x11, 0x0e],
        b'E' => [0x1f, 0x10, 0x10, 0x1e, 0x10, 0x10, 0x1f],
        b'F' => [0x1f, 0x10, 0x10, 0x1e, 0x10, 0x10, 0x10],
        b'I' => [0x0e, 0x04, 0x04, 0x04, 0x04, 0x04, 0x0e],
        b'K' => [0x11, 0x12, 0x14, 0x18, 0x14, 0x12, 0x11],
        b'L' => [0x10, 0x10, 0x10, 0x10, 0x10, 0x10, 0x1f],
        b'M' => [0x11, 0x1b, 0x15, 0x15, 0x11, 0x11, 0x11],
        b'O' => [0x0e, 0x11, 0x11, 0x11, 0x11, 0x11, 0x0e],
        b'S' => [0x0f, 0x10, 0x10, 0x0e, 0x01, 0x01, 0x1e],
        b'T' => [0x1f, 0x04, 0x04, 0x04, 0x04, 0x04, 0x04],
        b'J' => [0x01, 0x01, 0x01, 0x01, 0x11, 0x11, 0x0e],
        _ => [0; 7],
    }
}
