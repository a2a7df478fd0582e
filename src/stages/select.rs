//! Which viewpoints a pose is recalled from (section III-D).
//!
//! Poses -> indices of the nearest by view distance (metres), nearest first.
//! The paper says "closest in terms of distance and viewing direction": D = |c - c_i| + 1 m/rad * angle here.

use crate::model::pose::{Pose, view_distance_m};

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
    let mut nearest: Vec<(f64, usize)> = world_from_views
        .map(|world_from_view| {
            view_distance_m(world_from_view, world_from_camera, metres_per_radian)
        })
        .enumerate()
        .map(|(index, distance_m)| (distance_m, index))
        .collect();
    let by_distance = |a: &(f64, usize), b: &(f64, usize)| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1));
    if nearest.len() > count {
        nearest.select_nth_unstable_by(count, by_distance);
        nearest.truncate(count);
    }
    nearest.sort_unstable_by(by_distance);
    nearest
        .into_iter()
        .enumerate()
        .filter(|(rank, (distance_m, _))| *rank < NEAREST_KEPT || *distance_m <= distance_max_m)
        .map(|(_, (_, index))| index)
        .collect()
}
