//! Gathers the records that each pixel comes from and merges the covering views (section III-D, last sentence).
//!
//! Samples of up to sixteen views -> one row of [`super::prior`] planes. The paper takes the mean of the four
//! parameters over the covering views; here views may first be outvoted on depth and on colour, those written during
//! this visit count little, disagreement adds to the variance, and what the outvoted remember becomes the earlier
//! appearance. Each of these is a switch.

use crate::{
    lanes::{LANES, Lanes, bits, members, prefetch, reciprocal},
    model::{
        belief::{Belief, CHANNELS, LEVEL_OFFSET, LEVEL_SCALE, Record, f32_from_f16},
        viewpoint::VIEWS_MAX,
    },
};

use super::{
    gather::{Gather, GatherView, LEVEL_UNITS, Source, Sums},
    prior,
    sample::Sample,
};

/// Channels together must differ by more than this, grey levels, before views vote on colour: below it the mean is as
/// good, and cheaper.
const COLOUR_CONFLICT: f32 = 40.0;
/// Views farther than this from the medoid, grey levels summed over the channels, are outvoted.
const COLOUR_TOLERANCE: f32 = 40.0;
/// Where the distance to the medoid stops counting: an outlier is an outlier.
const COLOUR_CAP: f32 = 80.0;
/// What was there before is never certain.
const P2_MAX: f32 = 0.95;
/// A fresh view that weighs less speaks for what was there before the visit: the robot only passes.
const SETTLED_WEIGHT: f32 = 0.5;
/// The last write of a record with at least this weight of its earlier appearance replaced its appearance (step 6 gives
/// 0.5, and each later one halves it).
const P2_REPLACED: f32 = 0.49;

/// Which of the steps are on.
#[derive(Debug, Clone, Copy)]
pub struct MergeRules {
    /// Views whose depth differs from the median by more than this share are outvoted; `None`: no vote.
    pub depth_vote_tolerance: Option<f32>,
    pub colour_vote: bool,
    pub view_variance: bool,
    pub earlier_appearance: bool,
}

impl MergeRules {
    /// Whether a view's values are held against the others'.
    fn compares(&self) -> bool {
        self.depth_vote_tolerance.is_some()
            || self.colour_vote
            || self.view_variance
            || self.earlier_appearance
    }
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

    /// What it said before its last write.
    fn before(mut self) -> Self {
        self.level.copy_within(3..6, 0);
        self.spread[7] = 0.0;
        self
    }
}

/// Working memory of one thread.
pub struct MergeScratch {
    sources: [Source; VIEWS_MAX],
    sums: Sums,
    merged: Merged,
    pixel: Pixel,
}

impl Default for MergeScratch {
    fn default() -> Self {
        Self {
            sources: [Source::NONE; VIEWS_MAX],
            sums: Sums::ZERO,
            merged: Merged([[0.0; LANES]; prior::PLANES]),
            pixel: Pixel::default(),
        }
    }
}

/// Merges one row of the target. `maps[i]` is the row of the map of `views[i]`; `row` takes [`prior::PLANES`] planes of
/// `width`.
#[inline(always)]
pub fn merge_row<G: Gather>(
    views: &[MergeView],
    maps: &[&[Sample]],
    rules: MergeRules,
    width: usize,
    row: &mut [f32],
    scratch: &mut MergeScratch,
) {
    assert!(views.len() <= VIEWS_MAX && views.len() == maps.len());
    for view in views {
        assert_eq!(
            view.records.len(),
            view.width * view.height,
            "a record a pixel"
        );
    }
    // A smaller view has no triangle.
    let has_triangles = |view: &MergeView| view.width >= 2 && view.height >= 2;
    let comparing = rules.compares() || views.iter().any(|view| view.weight != 1.0);
    let mut gather_views = [GatherView {
        records: &[],
        width: 0,
        weight: 0.0,
    }; VIEWS_MAX];
    for (gather_view, view) in gather_views.iter_mut().zip(views) {
        *gather_view = GatherView {
            records: view.records,
            width: view.width,
            weight: view.weight,
        };
    }
    let gather_views = &gather_views[..views.len()];
    let MergeScratch {
        sources,
        sums,
        merged,
        pixel,
    } = scratch;
    for (source, _) in sources
        .iter_mut()
        .zip(views)
        .filter(|(_, view)| !has_triangles(view))
    {
        *source = Source::NONE;
    }
    for start in (0..width).step_by(LANES) {
        let count = LANES.min(width - start);
        let mut step = Step::default();
        for (index, (view, map)) in views.iter().zip(maps).enumerate() {
            if has_triangles(view) {
                let mut padded = [0; LANES];
                let samples = match map[start..].first_chunk::<LANES>() {
                    Some(samples) => samples,
                    None => {
                        padded[..count].copy_from_slice(&map[start..start + count]);
                        &padded
                    }
                };
                let source = &mut sources[index];
                source.locate(
                    samples,
                    (view.width as u32, view.height as u32),
                    view.weight,
                );
                step.see(index, view.weight, &source.inverse_depth);
                if rules.depth_vote_tolerance.is_some() {
                    step.range(&source.inverse_depth);
                }
            }
        }
        let mut apart = 0;
        if let Some(tolerance) = rules.depth_vote_tolerance {
            apart = step.depths_apart(tolerance);
        }
        for lane in members(apart) {
            step.seen[lane] = 0;
        }
        if comparing {
            // SAFETY: only views that have triangles are seen, all located above; their records were counted.
            unsafe { G::sum::<true>(gather_views, sources, &step.seen, sums) };
            step.finish(sums, true, rules.view_variance, merged);
            if rules.colour_vote {
                apart |= merged.colours_apart(sums);
            }
            if rules.earlier_appearance {
                apart |= merged.remembering();
            }
        } else {
            // SAFETY: as above.
            unsafe { G::sum::<false>(gather_views, sources, &step.seen, sums) };
            step.finish(sums, false, false, merged);
        }
        merged.write(row, width, start, count);
        for lane in members(apart).take_while(|&lane| lane < count) {
            pixel.clear();
            for (view, (gather_view, source)) in
                views.iter().zip(gather_views.iter().zip(&*sources))
            {
                if source.inverse_depth[lane] > 0.0 {
                    pixel.push(
                        1.0 / source.inverse_depth[lane],
                        interpolate(gather_view, source, lane),
                        view,
                        rules,
                    );
                }
            }
            let (belief, depth_m) = pixel.merge(rules);
            prior::put(
                row,
                width,
                start + lane,
                &belief,
                depth_m,
                pixel.count as f32,
            );
        }
    }
}

/// What is known of sixteen pixels before their records are fetched.
#[derive(Default)]
#[repr(align(64))]
struct Step {
    /// Views that see a pixel, a bit mask.
    seen: [u32; LANES],
    coverage: Lanes,
    weight: Lanes,
    weighted_depth_m: Lanes,
    /// Of the views' inverse depths; 0 where unseen.
    nearest: Lanes,
    farthest: Lanes,
}

impl Step {
    #[inline(always)]
    fn see(&mut self, index: usize, weight: f32, inverse_depth: &Lanes) {
        for lane in 0..LANES {
            let inverse = inverse_depth[lane];
            // By bits, because choices between sums become stores of some lanes, which the next view must wait for.
            let seen = (inverse.to_bits().wrapping_neg() as i32 >> 31) as u32;
            let if_seen = |value: f32| f32::from_bits(value.to_bits() & seen);
            // Of any positive number where unseen, so that nothing is infinite.
            let positive = f32::from_bits(inverse.to_bits() | (1.0f32.to_bits() & !seen));
            let near = reciprocal(positive);
            let depth_m = near * (2.0 - positive * near);
            self.seen[lane] |= seen & (1 << index);
            self.coverage[lane] += if_seen(1.0);
            self.weight[lane] += if_seen(weight);
            self.weighted_depth_m[lane] += if_seen(weight * depth_m);
        }
    }

    /// Nearest and farthest are needed for the vote on depth alone.
    #[inline(always)]
    fn range(&mut self, inverse_depth: &Lanes) {
        for lane in 0..LANES {
            let inverse = inverse_depth[lane];
            let nearest = self.nearest[lane];
            self.nearest[lane] = if inverse > nearest { inverse } else { nearest };
            let farthest = self.farthest[lane];
            let farther = (inverse > 0.0) & ((inverse < farthest) | (farthest == 0.0));
            self.farthest[lane] = if farther { inverse } else { farthest };
        }
    }

    /// Pixels, a bit mask, whose views must vote on depth: the farthest is not within the tolerance of the nearest.
    #[inline(always)]
    fn depths_apart(&self, tolerance: f32) -> u32 {
        bits(|lane| self.nearest[lane] - self.farthest[lane] > tolerance * self.farthest[lane])
    }

    /// Weighted means of all that was summed; with `view_variance` beta grows by alpha times their variance in tau.
    #[inline(always)]
    fn finish(&self, sums: &Sums, comparing: bool, view_variance: bool, merged: &mut Merged) {
        let planes = &mut merged.0;
        for lane in 0..LANES {
            let seen = self.coverage[lane] > 0.0;
            let scale = if seen { 1.0 / self.weight[lane] } else { 0.0 };
            let or = |value: f32, unseen: f32| if seen { value } else { unseen };
            let alpha = sums.spread[0][lane] * scale;
            planes[prior::ALPHA][lane] = or(alpha, UNSEEN.alpha);
            for c in 0..CHANNELS {
                let mean = sums.level[c][lane] * scale;
                let mut beta = sums.spread[1 + c][lane] * scale;
                let mut level = mean;
                if comparing {
                    level += sums.range[c][lane];
                    if view_variance {
                        let square = sums.level[4 + c][lane] * scale - mean * mean;
                        let variance = if square > 0.0 { square } else { 0.0 };
                        beta += alpha * (variance * (1.0 / (LEVEL_UNITS * LEVEL_UNITS)));
                    }
                }
                let tau = level * (1.0 / LEVEL_UNITS) + LEVEL_OFFSET[c];
                planes[prior::BETA + c][lane] = or(beta, UNSEEN.beta[c]);
                planes[prior::TAU + c][lane] = or(tau, UNSEEN.tau[c]);
                planes[prior::SIGMA + c][lane] =
                    or(sums.spread[4 + c][lane] * scale, UNSEEN.sigma[c]);
            }
            // Where there is something to remember it is replaced.
            planes[prior::P2][lane] = or(sums.spread[7][lane], 0.0);
            planes[prior::DEPTH][lane] = self.weighted_depth_m[lane] * scale;
            planes[prior::COVERAGE][lane] = self.coverage[lane];
        }
    }
}

/// Sixteen pixels of the prior; nothing earlier is remembered yet.
#[repr(align(64))]
struct Merged([Lanes; prior::PLANES]);

impl Merged {
    /// Pixels, a bit mask, whose views must vote on colour.
    #[inline(always)]
    fn colours_apart(&self, sums: &Sums) -> u32 {
        let [_, _, _, _, y, cb, cr, _] = &sums.range;
        bits(|lane| {
            (y[lane] + cb[lane] + cr[lane] > COLOUR_CONFLICT * LEVEL_UNITS)
                & (self.0[prior::COVERAGE][lane] > 1.0)
        })
    }

    /// Pixels, a bit mask, for which some view remembers an earlier appearance.
    #[inline(always)]
    fn remembering(&self) -> u32 {
        bits(|lane| self.0[prior::P2][lane] > 0.0)
    }

    #[inline(always)]
    fn write(&mut self, row: &mut [f32], width: usize, start: usize, count: usize) {
        self.0[prior::P2] = [0.0; LANES];
        for index in 0..prior::PLANES {
            // The next row of the same planes.
            prefetch(row, width * (prior::PLANES + index) + start);
        }
        for (plane, lanes) in row.chunks_exact_mut(width).zip(&self.0) {
            match plane[start..].first_chunk_mut() {
                Some(slot) => *slot = *lanes,
                None => plane[start..].copy_from_slice(&lanes[..count]),
            }
        }
    }
}

/// Interpolates the three records of a lane's triangle.
#[inline(always)]
fn interpolate(view: &GatherView, source: &Source, lane: usize) -> Gathered {
    let records = source.records(lane, view);
    let w = source.shares(lane);
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
    fn push(&mut self, depth_m: f32, gathered: Gathered, view: &MergeView, rules: MergeRules) {
        let index = self.count;
        let unsettled = rules.earlier_appearance && view.fresh && view.weight < SETTLED_WEIGHT;
        let gathered = if unsettled && gathered.p2() >= P2_REPLACED {
            gathered.before()
        } else {
            gathered
        };
        self.depth_m[index] = depth_m;
        self.weight[index] = view.weight;
        self.fresh |= u32::from(view.fresh) << index;
        self.gathered[index] = gathered;
        self.count += 1;
    }

    /// Belief and depth, metres, of a pixel that some view sees.
    fn merge(&self, rules: MergeRules) -> (Belief, f32) {
        let mut kept = self.all();
        if let Some(tolerance) = rules.depth_vote_tolerance {
            kept = self.vote_on_depth(tolerance);
        }
        if rules.colour_vote {
            kept = self.vote_on_colour(kept);
        }
        let mut belief = self.mean(kept, rules.view_variance);
        if rules.earlier_appearance {
            (belief.tau2, belief.p2) = self.earlier_appearance(kept);
        }
        (belief, self.mean_depth_m(kept))
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

fn distance(a: [f32; CHANNELS], b: [f32; CHANNELS]) -> f32 {
    (0..CHANNELS).map(|c| (a[c] - b[c]).abs()).sum()
}
