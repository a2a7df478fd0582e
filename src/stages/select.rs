//! Which viewpoints a pose is recalled from (section III-D).
//!
//! Poses -> indices of the nearest by view distance (metres), nearest first.
//! The paper says "closest in terms of distance and viewing direction": D = |c - c_i| + 1 m/rad * angle here.

use arrayvec::ArrayVec;

use crate::{
    model::pose::{Pose, view_distance_m},
    stages::interpolate::merge::VIEWS_MAX,
};

/// So many are recalled however far they are: a robot that comes back on another path has no others.
const NEAREST_KEPT: usize = 3;

/// The `count` poses nearest to `world_from_camera`, nearest first, ties to the earlier index; of those beyond
/// `distance_max_m` only the nearest three.
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
    // Sorted by distance; the earlier index stays before an equal distance.
    let mut nearest = ArrayVec::<(f64, usize), VIEWS_MAX>::new();
    let count = count.min(VIEWS_MAX);
    for (index, world_from_view) in world_from_views.enumerate() {
        let distance_m = view_distance_m(world_from_view, world_from_camera, metres_per_radian);
        if nearest.len() == count {
            if nearest.last().is_none_or(|last| last.0 <= distance_m) {
                continue;
            }
            nearest.pop();
        }
        let rank = nearest.partition_point(|held| held.0 <= distance_m);
        nearest.insert(rank, (distance_m, index));
    }
    selected.clear();
    selected.extend(
        nearest
            .into_iter()
            .enumerate()
            .filter(|(rank, (distance_m, _))| *rank < NEAREST_KEPT || *distance_m <= distance_max_m)
            .map(|(_, (_, index))| index),
    );
}
