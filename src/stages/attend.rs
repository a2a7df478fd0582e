//! Where to look: block means, evidence and regions (sections V-A, V-C).
//!
//! Surprise map (nats a pixel) -> evidence map (one value a 4x4 block) -> regions with boxes, peaks and centres in the
//! world, followed from frame to frame. The paper does not give the flood's tolerance: here a region reaches to where
//! the 4x4 box-filtered map falls below 0.3 of the seed block. Its box of random noise is not reported: no block above
//! the threshold, no region.

use nalgebra::Point3;

use crate::{
    config::{Evidence, Settings},
    model::{
        camera::Intrinsics,
        pose::Pose,
        report::{PixelBox, Region},
    },
};

/// Side of the blocks of section V-A, pixels.
pub const BLOCK: usize = 4;

/// One value for each whole block; right and lower remainders are left out.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct BlockMap {
    pub width: usize,
    pub height: usize,
    pub data: Vec<f32>,
}

impl BlockMap {
    /// Means over 4x4 pixels of a map of the given width.
    fn average(&mut self, map: &[f32], width: usize) {
        let blocks = width / BLOCK;
        self.width = blocks;
        self.height = map.len() / width / BLOCK;
        self.data.clear();
        for rows in map.chunks_exact(width * BLOCK) {
            self.data.extend((0..blocks).map(|block| {
                let sum: f32 = (0..BLOCK)
                    .flat_map(|y| &rows[y * width + block * BLOCK..][..BLOCK])
                    .sum();
                sum / (BLOCK * BLOCK) as f32
            }));
        }
    }

    /// The median over 3x3 blocks of another map; beyond the border the nearest block stands in.
    fn median(&mut self, of: &Self) {
        (self.width, self.height) = (of.width, of.height);
        self.data.resize(of.data.len(), 0.0);
        let (width, height) = (of.width, of.height);
        for (y, medians) in self.data.chunks_exact_mut(width.max(1)).enumerate() {
            let row = |y: usize| &of.data[y * width..][..width];
            let rows = [
                row(y.saturating_sub(1)),
                row(y),
                row((y + 1).min(height - 1)),
            ];
            for (x, median) in medians.iter_mut().enumerate() {
                let columns = [x.saturating_sub(1), x, (x + 1).min(width - 1)];
                let sorted = columns.map(|x| sort3([rows[0][x], rows[1][x], rows[2][x]]));
                // The middle of the least's greatest, the middles' middle and the greatest's least.
                let [a, b, c] = sorted;
                let low = a[0].max(b[0]).max(c[0]);
                let middle = sort3([a[1], b[1], c[1]])[1];
                let high = a[2].min(b[2]).min(c[2]);
                *median = sort3([low, middle, high])[1];
            }
        }
    }

    /// The map that seeds regions.
    pub fn evidence(map: &[f32], width: usize, evidence: Evidence) -> Self {
        let mut blocks = Self::default();
        blocks.find(map, width, evidence, &mut Self::default());
        blocks
    }

    /// The same; `means` is working memory.
    pub fn find(&mut self, map: &[f32], width: usize, evidence: Evidence, means: &mut Self) {
        match evidence {
            Evidence::Blocks => self.average(map, width),
            Evidence::BlockMedian => {
                means.average(map, width);
                self.median(means);
            }
        }
    }

    /// Blocks that lie whole inside the image without its border strip: `(x, y, value)`.
    pub fn inside(&self, border_px: usize) -> impl Iterator<Item = (usize, usize, f32)> {
        let first = border_px.div_ceil(BLOCK);
        let end_row = self.height.saturating_sub(first);
        let end_column = self.width.saturating_sub(first);
        (first..end_row).flat_map(move |y| {
            (first..end_column).map(move |x| (x, y, self.data[y * self.width + x]))
        })
    }
}

fn sort3([a, b, c]: [f32; 3]) -> [f32; 3] {
    let (a, b) = (a.min(b), a.max(b));
    let (b, c) = (b.min(c), b.max(c));
    [a.min(b), a.max(b), c]
}

/// What a region's place in the world is computed from.
pub struct Scene<'a> {
    /// Metres; 0 = none.
    pub depth_m: &'a [f32],
    pub intrinsics: &'a Intrinsics,
    pub world_from_camera: &'a Pose,
}

/// Regions by seeded flood fill, the most surprising first; their ids are 0 until [`Follower::follow`] gives them.
pub fn regions(
    map: &[f32],
    evidence: &BlockMap,
    scene: &Scene,
    settings: &Settings,
) -> Vec<Region> {
    let width = scene.intrinsics.width;
    let height = scene.intrinsics.height;
    let mut seeds: Vec<(usize, usize, f32)> = evidence
        .inside(settings.border_px)
        .filter(|&(_, _, value)| value > settings.surprise_threshold)
        .collect();
    if seeds.is_empty() {
        return Vec::new();
    }
    seeds.sort_by(|a, b| b.2.total_cmp(&a.2));
    let smooth = box_filtered(map, width, height);
    let mut taken = vec![false; map.len()];
    let mut regions = Vec::new();
    for (block_x, block_y, seed) in seeds {
        if regions.len() == settings.regions_max {
            break;
        }
        let in_block = (0..BLOCK * BLOCK).map(|index| {
            (block_y * BLOCK + index / BLOCK) * width + block_x * BLOCK + index % BLOCK
        });
        // Blocks beside a region that is already found belong to it.
        if in_block.clone().any(|pixel| taken[pixel]) {
            continue;
        }
        let level = settings.region_fraction * seed;
        let start = in_block
            .max_by(|&a, &b| smooth[a].total_cmp(&smooth[b]))
            .expect("a block has pixels");
        let members = flood(&smooth, width, start, level, &mut taken);
        regions.push(region(&members, map, seed, settings.border_px, scene));
    }
    regions
}

/// Means over 4x4 pixels around each pixel (two before, one after), cut off at the border.
fn box_filtered(map: &[f32], width: usize, height: usize) -> Vec<f32> {
    let window = |at: usize, end: usize| at.saturating_sub(BLOCK / 2)..(at + BLOCK / 2).min(end);
    let mut rows = vec![0.0; map.len()];
    for (row, out) in map.chunks_exact(width).zip(rows.chunks_exact_mut(width)) {
        for (x, out) in out.iter_mut().enumerate() {
            let values = &row[window(x, width)];
            *out = values.iter().sum::<f32>() / values.len() as f32;
        }
    }
    let mut smooth = vec![0.0; map.len()];
    for (y, out) in smooth.chunks_exact_mut(width).enumerate() {
        let range = window(y, height);
        let scale = 1.0 / range.len() as f32;
        for row in range {
            for (out, value) in out.iter_mut().zip(&rows[row * width..][..width]) {
                *out += value * scale;
            }
        }
    }
    smooth
}

/// The pixels connected to `start` (up, down, left, right) whose value reaches `level`; they are marked as taken.
fn flood(map: &[f32], width: usize, start: usize, level: f32, taken: &mut [bool]) -> Vec<usize> {
    taken[start] = true;
    let mut members = vec![start];
    let mut next = 0;
    while next < members.len() {
        let pixel = members[next];
        next += 1;
        let x = pixel % width;
        let neighbours = [
            (x > 0).then(|| pixel - 1),
            (x + 1 < width).then(|| pixel + 1),
            pixel.checked_sub(width),
            Some(pixel + width).filter(|&below| below < map.len()),
        ];
        for neighbour in neighbours.into_iter().flatten() {
            if !taken[neighbour] && map[neighbour] >= level {
                taken[neighbour] = true;
                members.push(neighbour);
            }
        }
    }
    members
}

fn region(members: &[usize], map: &[f32], seed: f32, border_px: usize, scene: &Scene) -> Region {
    let Intrinsics { width, height, .. } = *scene.intrinsics;
    let (mut x_min, mut y_min, mut x_max, mut y_max) = (width, height, 0, 0);
    let mut peak = members[0];
    let mut sum = 0.0;
    for &pixel in members {
        let (x, y) = (pixel % width, pixel / width);
        (x_min, x_max) = (x_min.min(x), x_max.max(x + 1));
        (y_min, y_max) = (y_min.min(y), y_max.max(y + 1));
        sum += f64::from(map[pixel]);
        if map[pixel] > map[peak] {
            peak = pixel;
        }
    }
    Region {
        id: 0,
        pixel_box: PixelBox {
            x_min: x_min as u32,
            y_min: y_min as u32,
            x_max: x_max as u32,
            y_max: y_max as u32,
        },
        peak_x: (peak % width) as u32,
        peak_y: (peak / width) as u32,
        peak_surprise: seed,
        mean_surprise: (sum / members.len() as f64) as f32,
        area: members.len() as u32,
        center_in_world: center_in_world(members, scene),
        touches_border: x_min < border_px
            || y_min < border_px
            || x_max + border_px > width
            || y_max + border_px > height,
        event_id: 0,
    }
}

/// The members' centroid at their median depth.
fn center_in_world(members: &[usize], scene: &Scene) -> Option<Point3<f64>> {
    let width = scene.intrinsics.width;
    let mut depths: Vec<f32> = members
        .iter()
        .map(|&pixel| scene.depth_m[pixel])
        .filter(|&z| z > 0.0)
        .collect();
    if depths.is_empty() {
        return None;
    }
    let middle = depths.len() / 2;
    let (_, &mut median, _) = depths.select_nth_unstable_by(middle, f32::total_cmp);
    let count = members.len() as f64;
    let (u, v) = members.iter().fold((0.0, 0.0), |(u, v), &pixel| {
        (u + (pixel % width) as f64, v + (pixel / width) as f64)
    });
    let in_camera = scene
        .intrinsics
        .unproject(u / count, v / count, f64::from(median));
    Some(scene.world_from_camera * in_camera)
}

/// Frames a region may be missing and still be the same when it is back: a person's hand passes by in that time.
const MISSED_MAX: u32 = 7;
/// Regions whose centres are this close in the world are the same, metres: the size of a tabletop object.
pub const SAME_WITHIN_M: f64 = 0.12;
/// Without depth, boxes that overlap this much are.
const SAME_IOU: f64 = 0.3;

/// Gives regions of one camera ids that stay while a region is followed.
#[derive(Debug, Clone, Default)]
pub struct Follower {
    followed: Vec<Followed>,
}

#[derive(Debug, Clone)]
struct Followed {
    region: Region,
    missed: u32,
}

impl Follower {
    /// Regions are matched best first; `next_id` is counted up for each one that was not followed before.
    pub fn follow(&mut self, regions: &mut [Region], next_id: &mut u64) {
        let mut pairs: Vec<(f64, usize, usize)> = Vec::new();
        for (old, followed) in self.followed.iter().enumerate() {
            for (new, region) in regions.iter().enumerate() {
                if let Some(cost) = mismatch(&followed.region, region) {
                    pairs.push((cost, old, new));
                }
            }
        }
        pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut old_used = vec![false; self.followed.len()];
        let mut new_used = vec![false; regions.len()];
        for (_, old, new) in pairs {
            if !old_used[old] && !new_used[new] {
                (old_used[old], new_used[new]) = (true, true);
                regions[new].id = self.followed[old].region.id;
            }
        }
        let mut index = 0;
        self.followed.retain_mut(|followed| {
            followed.missed += 1;
            index += 1;
            !old_used[index - 1] && followed.missed <= MISSED_MAX
        });
        for (region, matched) in regions.iter_mut().zip(new_used) {
            if !matched {
                *next_id += 1;
                region.id = *next_id;
            }
            self.followed.push(Followed {
                region: region.clone(),
                missed: 0,
            });
        }
    }
}

/// 0 = surely the same, `None` = another.
fn mismatch(old: &Region, new: &Region) -> Option<f64> {
    match (old.center_in_world, new.center_in_world) {
        (Some(a), Some(b)) => {
            let distance_m = (a - b).norm();
            (distance_m < SAME_WITHIN_M).then(|| distance_m / SAME_WITHIN_M)
        }
        _ => {
            let iou = old.pixel_box.iou(&new.pixel_box);
            (iou > SAME_IOU).then_some(1.0 - iou)
        }
    }
}
