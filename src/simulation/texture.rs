//! Procedural textures: the colour of a surface at a point, averaged over what one pixel covers of it.
//!
//! Colours are linear RGB. Detail finer than the `footprint` (metres on the surface, along u and along v: an oblique view
//! covers more of the one than of the other) fades into its mean, so that textures neither flicker nor alias.
//!
//! Single precision; noise is evaluated for several points side by side.

use std::sync::LazyLock;

use crate::{isa::for_each_isa, lanes::LANES};

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
#[derive(Debug, Clone, Copy, Default)]
pub struct Spot {
    /// Metres, right and up on the surface.
    pub u: f32,
    pub v: f32,
    /// Width of what a pixel covers, along u and along v, metres.
    pub footprint: [f32; 2],
}

/// Several [`Spot`]s on surfaces of one pattern.
pub struct Spots<const N: usize> {
    u: [f32; N],
    v: [f32; N],
    footprint: [[f32; N]; 2],
    /// The least footprints.
    finest: [f32; 2],
}

impl<const N: usize> Spots<N> {
    #[inline(always)]
    pub fn new(u: [f32; N], v: [f32; N], footprint: [[f32; N]; 2]) -> Self {
        Self {
            u,
            v,
            finest: [0, 1]
                .map(|axis: usize| footprint[axis].into_iter().fold(f32::INFINITY, f32::min)),
            footprint,
        }
    }

    #[inline(always)]
    fn of(spots: &[Spot; N]) -> Self {
        Self::new(
            spots.map(|spot| spot.u),
            spots.map(|spot| spot.v),
            [0, 1].map(|axis| spots.map(|spot| spot.footprint[axis])),
        )
    }
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
        width: f32,
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
        size: f32,
        seed: u32,
    },
    /// Rings around an upright object, `period` metres.
    Rings {
        a: Rgb,
        b: Rgb,
        period: f32,
        share_of_b: f32,
    },
    /// Knitted or woven stripes along v.
    Knit {
        a: Rgb,
        b: Rgb,
        period: f32,
    },
    Picture {
        width: f32,
        height: f32,
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
    pub letter: f32,
    /// Height of the text's middle above the base, metres.
    pub text_v: f32,
    /// Between the starts of neighbouring texts around the object, metres.
    pub repeat: f32,
    /// The band lies between these heights; its edges are waves.
    pub band_v: (f32, f32),
    pub seed: u32,
}

/// A coin-like hash of a grid point, 0..1.
#[inline(always)]
fn hash(x: i32, y: i32, seed: u32) -> f32 {
    let mut h = (x as u32)
        .wrapping_mul(0x9e37_79b1)
        .wrapping_add((y as u32).wrapping_mul(0x85eb_ca77))
        .wrapping_add(seed.wrapping_mul(0xc2b2_ae3d));
    h = (h ^ (h >> 15)).wrapping_mul(0x2c1b_3c6d);
    h = (h ^ (h >> 12)).wrapping_mul(0x297a_2d39);
    h ^= h >> 15;
    // Signed: vectors have no quick conversion of unsigned numbers before AVX-512.
    (h >> 8) as i32 as f32 * (1.0 / (1 << 24) as f32)
}

/// Value noise of period 1, -1..1.
#[inline(always)]
fn noise(x: f32, y: f32, seed: u32) -> f32 {
    let (i, j) = (floor(x), floor(y));
    let smooth = |t: f32| t * t * (3.0 - 2.0 * t);
    let (s, t) = (smooth(x - i as f32), smooth(y - j as f32));
    let top = hash(i, j, seed) * (1.0 - s) + hash(i + 1, j, seed) * s;
    let bottom = hash(i, j + 1, seed) * (1.0 - s) + hash(i + 1, j + 1, seed) * s;
    (top * (1.0 - t) + bottom * t) * 2.0 - 1.0
}

/// Without SSE4.1, `f32::floor` is a call into the C library.
#[inline(always)]
fn floor(x: f32) -> i32 {
    let whole = x as i32;
    whole - i32::from(x < whole as f32)
}

/// How much of a detail of this size survives the mean over a pixel of that footprint, 0..1.
#[inline(always)]
fn kept(per_size: f32, footprint: f32) -> f32 {
    let ratio = footprint * per_size;
    let left = (1.0 - KEPT * ratio * ratio).max(0.0);
    left * left
}
const KEPT: f32 = 0.25;

/// Sum of noises from `size` downwards, each half as large and as strong; -1..1 about. `squeeze`: how many times as long
/// the detail is along u and v.
#[inline(always)]
fn clouds<const N: usize>(
    u: &[f32; N],
    v: &[f32; N],
    squeeze: [f32; 2],
    size: f32,
    octaves: u32,
    spots: &Spots<N>,
    seed: u32,
) -> [f32; N] {
    let mut sum = [0.0; N];
    let (mut size, mut strength) = (size, 0.6);
    for octave in 0..octaves {
        let per_metre = squeeze.map(|squeeze| squeeze / size);
        let left = |footprint: [f32; 2]| {
            kept(per_metre[0], footprint[0]) * kept(per_metre[1], footprint[1])
        };
        if left(spots.finest) == 0.0 {
            break;
        }
        for lane in 0..N {
            sum[lane] += strength
                * left([spots.footprint[0][lane], spots.footprint[1][lane]])
                * noise(
                    u[lane] * per_metre[0],
                    v[lane] * per_metre[1],
                    seed + octave,
                );
        }
        size *= 0.5;
        strength *= 0.55;
    }
    sum
}

/// 1 where `x > edge`, 0 where it is less, the covered share in between.
#[inline(always)]
fn above(x: f32, edge: f32, footprint: f32) -> f32 {
    ((x - edge) / footprint + 0.5).clamp(0.0, 1.0)
}

#[inline(always)]
fn between(x: f32, low: f32, high: f32, footprint: f32) -> f32 {
    above(x, low, footprint) - above(x, high, footprint)
}

/// [`between`] of what repeats every `period`.
#[inline(always)]
fn between_each(x: f32, period: f32, low: f32, high: f32, footprint: f32) -> f32 {
    // Of all before a place.
    let covered = |x: f32| {
        let turn = floor(x / period) as f32;
        turn * (high - low) + (x - turn * period - low).clamp(0.0, high - low)
    };
    (covered(x + 0.5 * footprint) - covered(x - 0.5 * footprint)) / footprint
}

/// Stripes of unequal width in a strip pattern of 0.21 m, of strength 0..1.
#[inline(always)]
fn stripes<const N: usize>(x: &[f32; N], footprint: &[f32; N], seed: u32) -> [f32; N] {
    const PERIOD: f32 = 0.21;
    const LINES: [(f32, f32, f32); 6] = [
        (0.010, 0.034, 0.85),
        (0.043, 0.049, 0.60),
        (0.084, 0.092, 0.45),
        (0.118, 0.148, 0.70),
        (0.156, 0.161, 0.90),
        (0.186, 0.191, 0.40),
    ];
    let turn: [i32; N] = std::array::from_fn(|lane| floor(x[lane] * (1.0 / PERIOD)));
    let inside = sums::<N>(|lane| x[lane] - turn[lane] as f32 * PERIOD);
    // Of the footprint, covered.
    let mut covered = [0.0f32; N];
    for (&(low, high, strength), line) in LINES.iter().zip(0..) {
        for lane in 0..N {
            let shifted = inside[lane] - (hash(turn[lane], line, seed) - 0.5) * 0.012;
            let reach = footprint[lane] * 0.5;
            let common = (shifted + reach).min(high) - (shifted - reach).max(low);
            covered[lane] += strength * common.max(0.0);
        }
    }
    sums(|lane| (covered[lane] / footprint[lane]).min(1.0))
}

/// The complex number to this power.
#[inline(always)]
fn power((re, im): (f32, f32), exponent: u32) -> (f32, f32) {
    (1..exponent).fold((re, im), |(a, b), _| (a * re - b * im, a * im + b * re))
}

/// Each spot's own share of work: what has branches that few spots enter.
#[inline(always)]
fn of_each<const N: usize>(spots: &Spots<N>, colour: impl Fn(usize, &Spot) -> Rgb) -> [Rgb; N] {
    std::array::from_fn(|lane| {
        colour(
            lane,
            &Spot {
                u: spots.u[lane],
                v: spots.v[lane],
                footprint: spots.footprint.map(|footprint| footprint[lane]),
            },
        )
    })
}

#[inline(always)]
fn sums<const N: usize>(f: impl Fn(usize) -> f32) -> [f32; N] {
    let mut values = [0.0; N];
    for (lane, value) in values.iter_mut().enumerate() {
        *value = f(lane);
    }
    values
}

for_each_isa! {
    /// Linear RGB reflectance at several places.
    pub fn colours(pattern: &Pattern, spots: &[Spot; LANES], colours: &mut [Rgb; LANES]) = colours_kernel;
}

#[inline(always)]
fn colours_kernel(pattern: &Pattern, spots: &[Spot; LANES], colours: &mut [Rgb; LANES]) {
    *colours = pattern.colours(&Spots::of(spots));
}

impl Pattern {
    /// Linear RGB reflectance.
    pub fn colour(&self, spot: &Spot) -> Rgb {
        let [colour] = self.colours(&Spots::of(&[*spot]));
        colour
    }

    /// [`Self::colour`] at several places.
    #[inline(always)]
    pub fn colours<const N: usize>(&self, spots: &Spots<N>) -> [Rgb; N] {
        let Spots { u, v, .. } = spots;
        match self {
            Self::Plain(colour) => [*colour; N],
            Self::Cloth {
                ground,
                warp,
                weft,
                seed,
            } => {
                let fold = clouds(u, v, EVEN, 0.11, 1, spots, seed + 9);
                let [wide, high] = &spots.footprint;
                let along = stripes(&sums(|i| u[i] + fold[i] * 0.004), wide, *seed);
                let across = stripes(&sums(|i| v[i] + fold[i] * 0.0028 + 0.05), high, seed + 1);
                let fine = clouds(u, v, EVEN, 0.02, 2, spots, seed + 2);
                let broad = clouds(u, v, EVEN, 0.2, 1, spots, seed + 3);
                let dotted: [bool; N] = std::array::from_fn(|lane| {
                    let (_, du, dv) = dot_by(u[lane], v[lane], seed + 4);
                    let reach = DOT + wide[lane].max(high[lane]);
                    du * du + dv * dv < reach * reach
                });
                let mut colours = [[0.0; 3]; N];
                for channel in 0..3 {
                    let [ground, warp, weft] = [ground, warp, weft].map(|yarn| yarn[channel]);
                    for lane in 0..N {
                        let woven = ground + (warp - ground) * along[lane] * 0.8;
                        let woven = woven + (weft - woven) * across[lane] * 0.62;
                        let light = 1.0 + 0.10 * fine[lane] + 0.05 * broad[lane];
                        colours[lane][channel] = woven * light;
                    }
                }
                for lane in 0..N {
                    if dotted[lane] {
                        let light = 1.0 + 0.10 * fine[lane] + 0.05 * broad[lane];
                        let cloth = scaled(colours[lane], light.recip());
                        let footprint = [wide[lane], high[lane]];
                        let (u, v) = (u[lane], v[lane]);
                        let dot = embroidered(cloth, *warp, u, v, footprint, seed + 4);
                        colours[lane] = scaled(dot, light);
                    }
                }
                colours
            }
            Self::Planks {
                light,
                dark,
                width,
                seed,
            } => {
                let plank: [i32; N] = std::array::from_fn(|i| floor(v[i] / width));
                let shift = sums::<N>(|i| hash(plank[i], 0, *seed) * 2.0);
                let length: [i32; N] = std::array::from_fn(|i| floor((u[i] + shift[i]) / 1.3));
                let tint = sums::<N>(|i| hash(plank[i], length[i], seed + 1));
                let own = sums(|i| u[i] + tint[i] * 17.0);
                let wave = clouds(&own, v, EVEN, 0.25, 1, spots, seed + 6);
                let waved = sums(|i| v[i] + wave[i] * 0.02);
                let fine = clouds(&own, &waved, [0.12, 1.0], 0.016, 3, spots, seed + 2);
                let broad = clouds(&own, v, [0.3, 1.0], 0.07, 2, spots, seed + 3);
                of_each(spots, |lane, &Spot { u, v, footprint }| {
                    let grain = fine[lane] + 0.5 * broad[lane];
                    let share = (0.25 + 0.4 * tint[lane] + 0.45 * grain).clamp(0.0, 1.0);
                    let across = v - plank[lane] as f32 * width;
                    let along = u + shift[lane] - length[lane] as f32 * 1.3;
                    let joint = |x: f32, footprint| between(x, 0.0, 0.0025, footprint);
                    let [wide, high] = footprint;
                    let joints = (joint(across, high) + joint(along, wide)).min(1.0);
                    scaled(mixed(*light, *dark, share), 1.0 - 0.65 * joints)
                })
            }
            Self::Wallpaper {
                ground,
                figure,
                seed,
            } => {
                let fine = clouds(u, v, EVEN, 0.03, 2, spots, seed + 2);
                let broad = clouds(u, v, EVEN, 0.5, 2, spots, seed + 3);
                of_each(spots, |lane, spot| {
                    let colour = mixed(*ground, *figure, blossom(spot, *seed));
                    scaled(colour, 1.0 + 0.05 * fine[lane] + 0.09 * broad[lane])
                })
            }
            Self::Mottled { a, b, size, seed } => {
                let cloud = clouds(u, v, EVEN, *size, 3, spots, *seed);
                cloud.map(|cloud| mixed(*a, *b, (0.5 + 0.7 * cloud).clamp(0.0, 1.0)))
            }
            Self::Rings {
                a,
                b,
                period,
                share_of_b,
            } => of_each(spots, |_, &Spot { v, footprint, .. }| {
                let width = share_of_b * period;
                let (low, high) = ((period - width) * 0.5, (period + width) * 0.5);
                mixed(*a, *b, between_each(v, *period, low, high, footprint[1]))
            }),
            Self::Knit { a, b, period } => {
                let sway = sums::<N>(|i| noise(u[i] / period, v[i] / period, 5));
                let fine = clouds(u, v, EVEN, 0.012, 2, spots, 31);
                let broad = clouds(u, v, EVEN, 0.09, 2, spots, 32);
                of_each(spots, |lane, &Spot { v, footprint, .. }| {
                    let x = v + 0.3 * period * sway[lane];
                    let line = between_each(x, *period, 0.0, period * 0.4, footprint[1]);
                    let grain = 1.0 + 0.16 * fine[lane] + 0.2 * broad[lane];
                    scaled(mixed(*a, *b, line), grain)
                })
            }
            Self::Picture {
                width,
                height,
                seed,
            } => {
                let brush = clouds(u, v, [1.0, 2.5], 0.03, 2, spots, seed + 7);
                of_each(spots, |lane, spot| {
                    picture(spot, *width, *height, *seed, brush[lane])
                })
            }
            Self::Spine { ground, ink, seed } => {
                let fine = clouds(u, v, EVEN, 0.03, 2, spots, *seed);
                of_each(spots, |lane, &Spot { u, v, footprint }| {
                    let [wide, high] = footprint;
                    let letter = hash(floor(v / 0.006), floor(u / 0.004), seed + 1) > 0.45;
                    let title = print_of(letter, 0.55, footprint)
                        * between(v, 0.05, 0.13, high)
                        * between(u, -0.007, 0.007, wide);
                    let bands = between(v, 0.018, 0.026, high) + between(v, 0.150, 0.156, high);
                    let inked = (title + bands).min(1.0) * 0.85;
                    scaled(mixed(*ground, *ink, inked), 1.0 + 0.12 * fine[lane])
                })
            }
            Self::Label(label) => of_each(spots, |_, spot| label.colour(spot)),
        }
    }
}

/// Details as long as wide.
const EVEN: [f32; 2] = [1.0; 2];

/// Small print, cells of 4 by 6 mm of which a `share` is inked.
#[inline(always)]
fn print_of(inked: bool, share: f32, [wide, high]: [f32; 2]) -> f32 {
    let kept = kept(1.0 / 0.005, wide) * kept(1.0 / 0.005, high);
    share + (f32::from(inked) - share) * kept
}

/// What a pixel covers in the direction `(u, v)` of length `length`.
#[inline(always)]
fn towards([wide, high]: [f32; 2], u: f32, v: f32, length: f32) -> f32 {
    let (u, v) = (wide * u, high * v);
    (u * u + v * v).sqrt() / length
}

/// Reach of the longest petals of an embroidered dot, metres.
const DOT: f32 = 0.013;

/// The embroidered dot in this one of the tartan's fields: which kind, 0..1, and the way to here from its heart; far away
/// in a field that has none.
#[inline(always)]
fn dot_by(u: f32, v: f32, seed: u32) -> (f32, f32, f32) {
    let (i, j) = (floor(u * (1.0 / 0.07)), floor(v * (1.0 / 0.07)));
    let kind = hash(i, j, seed);
    let du = u - (i as f32 + 0.3 + kind * 0.4) * 0.07;
    let dv = v - (j as f32 + 0.5) * 0.07;
    (kind, du, if kind > 0.55 { dv } else { 1.0 })
}

/// The cloth's colour with what an embroidered dot near by covers of the pixel.
fn embroidered(cloth: Rgb, warp: Rgb, u: f32, v: f32, footprint: [f32; 2], seed: u32) -> Rgb {
    static YARNS: LazyLock<[Rgb; 2]> = LazyLock::new(|| [rgb(0xc98a2b), rgb(0xf4e3b0)]);
    let [gold, cream] = *YARNS;
    let (kind, du, dv) = dot_by(u, v, seed);
    let thread = mixed(warp, gold, f32::from(kind > 0.78));
    // A dot is hardly larger than a pixel's print: by quarters.
    let quarter = footprint.map(|side| side * 0.5);
    let mut sum = [0.0; 3];
    for (right, up) in [(-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)] {
        let (du, dv) = (du + right * footprint[0], dv + up * footprint[1]);
        let away = (du * du + dv * dv).sqrt().max(1e-6);
        let across = towards(quarter, du, dv, away);
        // The cosine of five times the angle.
        let petal = 0.009 + 0.004 * power((du / away, dv / away), 5).0;
        let figure = 1.0 - above(away, petal, across);
        let heart = 1.0 - above(away, 0.004, across);
        let colour = mixed(mixed(cloth, thread, figure * 0.9), cream, heart);
        sum = std::array::from_fn(|i| sum[i] + 0.25 * colour[i]);
    }
    sum
}

/// How much of the wallpaper's figure, a flower on a stalk, is at a place.
fn blossom(&Spot { u, v, footprint }: &Spot, seed: u32) -> f32 {
    let column = floor(u / 0.16);
    let odd = column.rem_euclid(2) as f32;
    let row = floor((v - odd * 0.1) / 0.2);
    let du = u - (column as f32 + 0.5) * 0.16;
    let dv = v - (row as f32 + 0.5) * 0.2 - odd * 0.1;
    let radius = (du * du + 0.64 * dv * dv).sqrt();
    // Its longest petals reach 57 mm.
    let shape = if radius < 0.057 + footprint[0].max(footprint[1]) {
        let away = (du * du + dv * dv).sqrt().max(1e-6);
        let towards = (du / away, dv / away);
        let (tilt_sin, tilt_cos) = (hash(column, row, seed) * 6.0).sin_cos();
        // cos(5 angle + tilt) and sin(9 angle).
        let (cos5, sin5) = power(towards, 5);
        let petals = cos5 * tilt_cos - sin5 * tilt_sin;
        let edge = 0.035 + 0.016 * petals + 0.006 * power(towards, 9).1;
        between(radius, 0.012, edge, self::towards(footprint, du, dv, away)).max(0.0)
    } else {
        0.0
    };
    let stalk = if du.abs() < 0.015 + footprint[0] {
        between(du + 0.012 * (dv * 40.0).sin(), -0.003, 0.003, footprint[0])
    } else {
        0.0
    };
    (0.75 * shape + 0.4 * stalk).min(0.85)
}

/// A painted landscape: sky, sun, hills and a field. `brush` is its strokes, -1..1.
fn picture(
    &Spot { u, v, footprint }: &Spot,
    width: f32,
    height: f32,
    seed: u32,
    brush: f32,
) -> Rgb {
    /// Frame, sky and sun.
    static PAINTS: LazyLock<[Rgb; 5]> =
        LazyLock::new(|| [0x4a2f1a, 0x8a6237, 0xf0d9a8, 0x5f93b8, 0xfff3c4].map(rgb));
    /// The far hills first: how high they reach, and their colours.
    static HILLS: LazyLock<[(f32, Rgb); 4]> = LazyLock::new(|| {
        [
            (0.55, 0x6d7fa0),
            (0.42, 0x4f7a58),
            (0.28, 0x9aa04a),
            (0.14, 0xb8763a),
        ]
        .map(|(level, paint)| (level, rgb(paint)))
    });
    let [dark_wood, light_wood, low_sky, high_sky, sun_paint] = *PAINTS;
    let (x, y) = (u / width, v / height);
    let [wide, high] = footprint;
    let border = 0.025;
    if u.abs() > width * 0.5 - border || v < border || v > height - border {
        return mixed(
            dark_wood,
            light_wood,
            0.5 + 0.5 * noise(u / 0.01, v / 0.05, seed),
        );
    }
    let sky = mixed(low_sky, high_sky, (y * 1.4 - 0.4).clamp(0.0, 1.0));
    let sun = 1.0
        - above(
            (x - 0.18).hypot((y - 0.72) * height / width),
            0.07,
            wide / width,
        );
    let mut colour = mixed(sky, sun_paint, sun);
    for (layer, &(level, paint)) in HILLS.iter().enumerate() {
        let layer = layer as f32;
        let hill = level
            + 0.10 * noise(x * 3.1, layer * 7.3, seed)
            + 0.03 * noise(x * 11.0, layer * 3.7, seed + 1);
        colour = mixed(paint, colour, above(y, hill, high / height));
    }
    scaled(colour, 1.0 + 0.25 * brush)
}

impl Label {
    fn colour(&self, &Spot { u, v, footprint }: &Spot) -> Rgb {
        let cell = floor(u / self.repeat + 0.5);
        let x = u - cell as f32 * self.repeat;
        let wave = 0.004 * (x / self.repeat * std::f32::consts::TAU * 2.0).sin();
        let [wide, high] = footprint;
        let band = between(v, self.band_v.0 + wave, self.band_v.1 + wave, high);
        let rim = between(
            v,
            self.band_v.1 + wave + 0.003,
            self.band_v.1 + wave + 0.006,
            high,
        );
        let mut colour = mixed(self.ground, self.band, (band + rim).min(1.0));
        // Small print and a round emblem below the name.
        let emblem_v = self.text_v - self.letter * 1.5;
        let emblem = x.hypot(v - emblem_v);
        let covered = towards(footprint, x, v - emblem_v, emblem.max(1e-6));
        let ring = between(emblem, self.letter * 0.45, self.letter * 0.6, covered) + 1.0
            - above(emblem, self.letter * 0.25, covered);
        colour = mixed(colour, self.ink, ring.min(1.0) * 0.9);
        let line = floor((v - 0.01) / 0.006);
        let inked = hash(floor(u / 0.004), line, self.seed) > 0.4;
        let print = print_of(inked, 0.6, footprint)
            * f32::from((0..4).contains(&line))
            * between_each(v - 0.01, 0.006, 0.0015, 0.0045, high)
            * between(x, -self.repeat * 0.3, self.repeat * 0.3, wide);
        colour = mixed(colour, self.ink, print * 0.7);
        let ink = text_cover(self.text, x, v - self.text_v, self.letter, footprint);
        mixed(colour, self.ink, ink)
    }
}

/// Share of the pixel that letters cover; `(x, y)` metres from the text's middle.
fn text_cover(text: &str, x: f32, y: f32, letter: f32, [wide, high]: [f32; 2]) -> f32 {
    let dot = letter / 7.0;
    let width = text.len() as f32 * 6.0 * dot;
    if x.abs() > width * 0.5 + wide || y.abs() > letter * 0.5 + high {
        return 0.0;
    }
    let set = |x: f32, y: f32| {
        let column = floor((x + width * 0.5) / dot);
        let row = floor((letter * 0.5 - y) / dot);
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
            let offset = |k: i32| (k as f32 + 0.5) / 4.0 - 0.5;
            set(x + offset(i % 4) * wide, y + offset(i / 4) * high)
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
