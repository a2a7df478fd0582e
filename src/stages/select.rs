//! Which viewpoints a pose is recalled from (section III-D).
//!
//! Poses -> indices of the nearest by view distance (metres), nearest first.
//! The paper says "closest in terms of distance and viewing direction": D = |c - c_i| + 1 m/rad * angle here.

use arrayvec::ArrayVec;

use crate::{
    model::pose::{Pose, view_distance_m},
    model::viewpoint::VIEWS_MAX,
};

/// So many are recalled however far they are: a robot that comes back on another path has no others.
const NEAREST_KEPT: usize = 3;
/// But a robot that comes where another one looked from afar, and has seen little itself so far, is better off with its
/// own two views: what the far one saw from aside surprises along every edge. In a kitchen with six views, four lose
/// every twentieth object, ten to thirty none.
const FAR_RATIO: f64 = 30.0;

/// The `count` poses nearest to `world_from_camera`, nearest first, ties to the earlier index; of those beyond
/// `distance_max_m` only the nearest three, and none that is thirty times as far as the nearest.
pub fn select_nearest<'a>(
    world_from_views: impl Iterator<Item = &'a Pose>,
    world_from_camera: &Pose,
    metres_per_radian: f64,
    count: usize,
    distance_max_m: f64,
) -> Vec<usize> {
    let mut selected = Vec::new();
    select_into(
        world_from_views,
        world_from_camera,
        metres_per_radian,
        count,
        distance_max_m,
        &mut selected,
    );
    selected
}

/// As [`select_nearest`], into a vector whose memory is used again.
pub fn select_into<'a>(
    world_from_views: impl Iterator<Item = &'a Pose>,
    world_from_camera: &Pose,
    metres_per_radian: f64,
    count: usize,
    distance_max_m: f64,
    selected: &mut Vec<usize>,
) {
    let mut nearest = Nearest::new(count);
    for (index, world_from_view) in world_from_views.enumerate() {
        let distance_m = view_distance_m(world_from_view, world_from_camera, metres_per_radian);
        nearest.offer(distance_m, index);
    }
    nearest.within(distance_max_m, selected);
}

/// The nearest of what was offered: sorted by distance, the earlier index before an equal distance.
pub struct Nearest {
    held: ArrayVec<(f64, usize), VIEWS_MAX>,
    count: usize,
}

impl Nearest {
    /// Holds at most `count`.
    pub fn new(count: usize) -> Self {
        Self {
            held: ArrayVec::new(),
            count: count.min(VIEWS_MAX),
        }
    }

    /// What is farther than this is not held; infinite while there is room.
    pub fn farthest_m(&self) -> f64 {
        if self.held.len() < self.count {
            return f64::INFINITY;
        }
        self.held.last().map_or(f64::NEG_INFINITY, |last| last.0)
    }

    /// In any order.
    pub fn offer(&mut self, distance_m: f64, index: usize) {
        let before = |held: &(f64, usize)| (held.0, held.1) < (distance_m, index);
        if self.held.len() == self.count {
            if self.held.last().is_none_or(before) {
                return;
            }
            self.held.pop();
        }
        let rank = self.held.partition_point(before);
        self.held.insert(rank, (distance_m, index));
    }

    /// Their indices; of those beyond `distance_max_m` only the nearest three, and none that is [`FAR_RATIO`] times as
    /// far as the nearest.
    pub fn within(self, distance_max_m: f64, selected: &mut Vec<usize>) {
        let nearest_m = self.held.first().map_or(0.0, |held| held.0);
        let far_m = distance_max_m.max(FAR_RATIO * nearest_m);
        let near = self.closer_than(distance_max_m);
        let kept = near.max(self.closer_than(far_m).min(NEAREST_KEPT));
        selected.clear();
        selected.extend(self.held.into_iter().take(kept).map(|(_, index)| index));
    }

    fn closer_than(&self, distance_m: f64) -> usize {
        self.held.partition_point(|held| held.0 <= distance_m)
    }
}
