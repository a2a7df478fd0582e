//! Gathers the records that each pixel comes from and merges the covering views (section III-D, last sentence).
//!
//! Samples of up to sixteen views -> one row of [`super::prior`] planes. The paper takes the mean of the four
//! parameters over the covering views; here views may first be outvoted on depth and on colour, those written during
//! this visit count little, disagreement adds to the variance, and what the outvoted remember becomes the earlier
//! appearance. Each of these is a switch.

use crate::model::belief::{Belief, CHANNELS, LEVEL_OFFSET, LEVEL_SCALE, Record, f32_from_f16};

use super::{
    prior,
    project::{Sample, sample_depth_m, sample_position},
};

/// As [`crate::config::Settings::views`] allows.
pub const VIEWS_MAX: usize = 16;

/// Channels together must differ by more than this, grey levels, before views vote on colour: below it the mean is as
/// good, and cheaper.
const COLOUR_CONFLICT: f32 = 40.0;
/// Views farther than this from the medoid, grey levels summed over the channels, are outvoted.
const COLOUR_TOLERANCE: f32 = 40.0;
/// Where the distance to the medoid stops counting: an outlier is an outlier.
const COLOUR_CAP: f32 = 80.0;
/// What was there before is never certain.
const P2_MAX: f32 = 0.95;

/// Which of the steps are on.
#[derive(Debug, Clone, Copy)]
pub struct MergeRules {
    /// Views whose depth differs from the median by more than this share are outvoted; `None`: no vote.
    pub depth_vote_tolerance: Option<f32>,
    pub colour_vote: bool,
    pub view_variance: bool,
    pub earlier_appearance: bool,
}

/// A view to gather from.
#[derive(Clone, Copy)]
pub struct MergeView<'a> {
    pub records: &'a [Record],
    pub width: usize,
    pub height: usize,
    /// In votes and means.
    pub weight: f32,
    /// Written during this visit: its main appearance is no memory of the past.
    pub fresh: bool,
}

/// The belief of a pixel no view saw, as the paper starts (section V).
pub const UNSEEN: Belief = Belief {
    alpha: 1.0,
    beta: [1.0; CHANNELS],
    tau: [0.0; CHANNELS],
    sigma: [5.0; CHANNELS],
    tau2: [0.0; CHANNELS],
    p2: 0.0,
};

/// A record interpolated inside its triangle, in the lanes of [`Record`].
#[derive(Clone, Copy, Default)]
struct Gathered {
    spread: [f32; 8],
    level: [f32; 8],
}

impl Gathered {
    fn tau(&self) -> [f32; CHANNELS] {
        [self.level[0], self.level[1], self.level[2]]
    }

    fn tau2(&self) -> [f32; CHANNELS] {
        [self.level[3], self.level[4], self.level[5]]
    }

    fn p2(&self) -> f32 {
        self.spread[7]
    }
}

/// Merges one row of the target. `maps[i]` is the row of the map of `views[i]`; `row` takes [`prior::PLANES`] planes of
/// `width`.
#[inline(always)]
pub fn merge_row(
    views: &[MergeView],
    maps: &[&[Sample]],
    rules: MergeRules,
    width: usize,
    row: &mut [f32],
) {
    assert!(views.len() <= VIEWS_MAX && views.len() == maps.len());
    let mut pixel = Pixel::default();
    for x in 0..width {
        pixel.clear();
        for (view, map) in views.iter().zip(maps) {
            let sample = map[x];
            if sample != 0 {
                pixel.push(sample_depth_m(sample), gather(view, sample), view);
            }
        }
        if pixel.count == 0 {
            prior::put(row, width, x, &UNSEEN, 0.0, 0.0);
            continue;
        }
        let mut kept = (1u32 << pixel.count) - 1;
        if let Some(tolerance) = rules.depth_vote_tolerance {
            kept = pixel.vote_on_depth(tolerance);
        }
        if rules.colour_vote {
            kept = pixel.vote_on_colour(kept);
        }
        let mut belief = pixel.mean(kept, rules.view_variance);
        if rules.earlier_appearance {
            (belief.tau2, belief.p2) = pixel.earlier_appearance(kept);
        }
        let depth_m = pixel.mean_depth_m(kept);
        prior::put(row, width, x, &belief, depth_m, pixel.count as f32);
    }
}

/// Interpolates the three records of the triangle around a sample.
#[inline(always)]
fn gather(view: &MergeView, sample: Sample) -> Gathered {
    let (column, row, mut right, mut down) = sample_position(sample);
    // A sample on the last column or row belongs to the quad before it.
    let last_column = view.width - 2;
    let last_row = view.height - 2;
    right += if column > last_column { 1.0 } else { 0.0 };
    down += if row > last_row { 1.0 } else { 0.0 };
    let upper_left = row.min(last_row) * view.width + column.min(last_column);
    let upper_right = upper_left + 1;
    let lower_left = upper_left + view.width;
    let in_upper_left = right + down <= 1.0;
    let (corner, w) = if in_upper_left {
        (upper_left, [1.0 - right - down, right, down])
    } else {
        (
            lower_left + 1,
            [right + down - 1.0, 1.0 - down, 1.0 - right],
        )
    };
    let records = [
        &view.records[corner],
        &view.records[upper_right],
        &view.records[lower_left],
    ];
    let mut gathered = Gathered {
        spread: [0.0; 8],
        level: LEVEL_OFFSET,
    };
    for (record, w) in records.into_iter().zip(w) {
        for lane in 0..8 {
            gathered.spread[lane] += w * f32_from_f16(record.spread[lane]);
            gathered.level[lane] += w * f32::from(record.level[lane]) * (1.0 / LEVEL_SCALE);
        }
    }
    if gathered.spread[7] > 0.0 {
        // tau2 means nothing where p2 is 0, so p2 weighs it.
        let mut level: [f32; CHANNELS] = std::array::from_fn(|c| LEVEL_OFFSET[3 + c]);
        for (record, w) in records.into_iter().zip(w) {
            let w = w * f32_from_f16(record.spread[7]) / gathered.spread[7];
            for (channel, level) in level.iter_mut().enumerate() {
                *level += w * f32::from(record.level[3 + channel]) * (1.0 / LEVEL_SCALE);
            }
        }
        gathered.level[3..6].copy_from_slice(&level);
    }
    gathered
}

/// What the covering views say about one pixel; sets of views are bit masks.
#[derive(Default)]
struct Pixel {
    count: usize,
    depth_m: [f32; VIEWS_MAX],
    weight: [f32; VIEWS_MAX],
    fresh: u32,
    gathered: [Gathered; VIEWS_MAX],
}

impl Pixel {
    /// Forgets the views; what lies beyond `count` is never read.
    fn clear(&mut self) {
        self.count = 0;
        self.fresh = 0;
    }

    #[inline(always)]
    fn push(&mut self, depth_m: f32, gathered: Gathered, view: &MergeView) {
        let index = self.count;
        self.depth_m[index] = depth_m;
        self.weight[index] = view.weight;
        self.fresh |= u32::from(view.fresh) << index;
        self.gathered[index] = gathered;
        self.count += 1;
    }

    fn all(&self) -> u32 {
        (1u32 << self.count) - 1
    }

    /// Views within the tolerance of the weighted lower median depth.
    #[inline(always)]
    fn vote_on_depth(&self, tolerance: f32) -> u32 {
        let depths = &self.depth_m[..self.count];
        let (low, high) = depths
            .iter()
            .fold((f32::INFINITY, 0.0f32), |(low, high), &z| {
                (low.min(z), high.max(z))
            });
        if high - low <= tolerance * low {
            return self.all();
        }
        let median = self.weighted_lower_median_depth_m();
        members(self.all())
            .filter(|&index| (self.depth_m[index] - median).abs() <= tolerance * median)
            .fold(0, |kept, index| kept | (1 << index))
    }

    #[cold]
    fn weighted_lower_median_depth_m(&self) -> f32 {
        let mut order: [usize; VIEWS_MAX] = std::array::from_fn(|index| index);
        let order = &mut order[..self.count];
        order.sort_unstable_by(|&a, &b| self.depth_m[a].total_cmp(&self.depth_m[b]));
        let half = self.weight[..self.count].iter().sum::<f32>() / 2.0;
        let mut below = 0.0;
        for &index in order.iter() {
            below += self.weight[index];
            if below >= half {
                return self.depth_m[index];
            }
        }
        self.depth_m[order[self.count - 1]]
    }

    /// Of the kept views, those near the weighted medoid of tau; all of them where they hardly differ.
    #[inline(always)]
    fn vote_on_colour(&self, kept: u32) -> u32 {
        let mut low = [f32::INFINITY; CHANNELS];
        let mut high = [f32::NEG_INFINITY; CHANNELS];
        for index in members(kept) {
            for channel in 0..CHANNELS {
                low[channel] = low[channel].min(self.gathered[index].level[channel]);
                high[channel] = high[channel].max(self.gathered[index].level[channel]);
            }
        }
        let range: f32 = (0..CHANNELS).map(|c| high[c] - low[c]).sum();
        if range > COLOUR_CONFLICT {
            self.near_medoid(kept)
        } else {
            kept
        }
    }

    #[cold]
    fn near_medoid(&self, kept: u32) -> u32 {
        let cost = |index: usize| -> f32 {
            members(kept)
                .map(|other| {
                    self.weight[other]
                        * distance(self.gathered[index].tau(), self.gathered[other].tau())
                            .min(COLOUR_CAP)
                })
                .sum()
        };
        let Some(medoid) = members(kept).min_by(|&a, &b| cost(a).total_cmp(&cost(b))) else {
            return kept;
        };
        members(kept)
            .filter(|&index| {
                distance(self.gathered[index].tau(), self.gathered[medoid].tau())
                    <= COLOUR_TOLERANCE
            })
            .fold(0, |near, index| near | (1 << index))
    }

    /// Weighted means over the kept views; with `view_variance` beta grows by alpha times their variance in tau.
    #[inline(always)]
    fn mean(&self, kept: u32, view_variance: bool) -> Belief {
        let mut spread = [0.0f32; 8];
        let mut level = [0.0f32; 8];
        let mut total = 0.0;
        for index in members(kept) {
            let weight = self.weight[index];
            total += weight;
            for lane in 0..8 {
                spread[lane] += weight * self.gathered[index].spread[lane];
                level[lane] += weight * self.gathered[index].level[lane];
            }
        }
        let scale = 1.0 / total;
        for lane in 0..8 {
            spread[lane] *= scale;
            level[lane] *= scale;
        }
        let mut variance = [0.0f32; 8];
        if view_variance {
            for index in members(kept) {
                for lane in 0..8 {
                    let difference = self.gathered[index].level[lane] - level[lane];
                    variance[lane] += self.weight[index] * scale * difference * difference;
                }
            }
        }
        Belief {
            alpha: spread[0],
            beta: std::array::from_fn(|c| spread[1 + c] + spread[0] * variance[c]),
            sigma: [spread[4], spread[5], spread[6]],
            tau: [level[0], level[1], level[2]],
            tau2: [level[3], level[4], level[5]],
            p2: 0.0,
        }
    }

    #[inline(always)]
    fn mean_depth_m(&self, kept: u32) -> f32 {
        let (sum, total) = members(kept).fold((0.0, 0.0), |(sum, total), index| {
            let weight = self.weight[index];
            (sum + weight * self.depth_m[index], total + weight)
        });
        sum / total
    }

    /// What was there before, and its weight: the kept views' own earlier appearance, and the main appearance of the
    /// outvoted that were not written during this visit.
    #[inline(always)]
    fn earlier_appearance(&self, kept: u32) -> ([f32; CHANNELS], f32) {
        let outvoted = self.all() & !kept & !self.fresh;
        let remembers = members(kept).any(|index| self.gathered[index].p2() > 0.0);
        if outvoted == 0 && !remembers {
            return ([0.0; CHANNELS], 0.0);
        }
        self.heaviest_earlier(kept, outvoted)
    }

    #[cold]
    fn heaviest_earlier(&self, kept: u32, outvoted: u32) -> ([f32; CHANNELS], f32) {
        let candidate = |index: usize| {
            let gathered = &self.gathered[index];
            if kept & (1 << index) != 0 {
                (gathered.tau2(), self.weight[index] * gathered.p2())
            } else {
                (gathered.tau(), self.weight[index] * (1.0 - gathered.p2()))
            }
        };
        let witnesses = kept | outvoted;
        let Some((heaviest, heaviest_weight)) = members(witnesses)
            .map(candidate)
            .max_by(|a, b| a.1.total_cmp(&b.1))
        else {
            return ([0.0; CHANNELS], 0.0);
        };
        if heaviest_weight <= 0.0 {
            return ([0.0; CHANNELS], 0.0);
        }
        let mut tau2 = [0.0; CHANNELS];
        let mut weight = 0.0;
        for (tau, w) in members(witnesses).map(candidate) {
            if distance(tau, heaviest) <= COLOUR_TOLERANCE {
                weight += w;
                for channel in 0..CHANNELS {
                    tau2[channel] += w * tau[channel];
                }
            }
        }
        let all: f32 = members(witnesses).map(|index| self.weight[index]).sum();
        (tau2.map(|sum| sum / weight), (weight / all).min(P2_MAX))
    }
}

/// Indices of the set bits, ascending.
#[inline(always)]
fn members(mut set: u32) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        (set != 0).then(|| {
            let index = set.trailing_zeros() as usize;
            set &= set - 1;
            index
        })
    })
}

fn distance(a: [f32; CHANNELS], b: [f32; CHANNELS]) -> f32 {
    (0..CHANNELS).map(|c| (a[c] - b[c]).abs()).sum()
}
