//! Selection among very many viewpoints: a k-d tree over position and viewing direction.
//!
//! Poses -> the same indices as [`super::select`] gives, to the last tie. View distance is at least the distance of the
//! positions plus the weighted chord between the directions (an angle is never shorter than its chord), and both are
//! bounded from below by the box of a node: what is pruned cannot be near.

use crate::model::pose::{Pose, view_distance_m};

use super::select::Nearest;

/// Poses of a leaf: looking at so many costs no more than splitting them.
const LEAF: usize = 16;
/// Bounds are rounded otherwise than distances.
const ROUNDING: f64 = 1e-9;

/// Position in metres and viewing direction, a unit vector.
type Point = [f64; 6];

fn point(world_from_view: &Pose) -> Point {
    let position = world_from_view.translation.vector;
    let direction = world_from_view.rotation * nalgebra::Vector3::z();
    [
        position.x,
        position.y,
        position.z,
        direction.x,
        direction.y,
        direction.z,
    ]
}

/// Poses as they were when the tree was built, and which have changed since.
#[derive(Debug, Default)]
pub struct ViewTree {
    nodes: Vec<Node>,
    /// The poses of the leaves, one after the other.
    poses: Vec<(Point, Pose, usize)>,
    /// By index: no longer where the tree thinks.
    moved: Vec<bool>,
    /// Those, and what came later.
    loose: Vec<usize>,
}

#[derive(Debug)]
struct Node {
    low: Point,
    high: Point,
    /// Of [`ViewTree::poses`].
    start: usize,
    end: usize,
    /// Of [`ViewTree::nodes`]: the second child, the first follows its parent; 0 for a leaf.
    second: usize,
}

impl ViewTree {
    /// Forgets the poses it had.
    pub fn build<'a>(&mut self, world_from_views: impl Iterator<Item = &'a Pose>) {
        self.nodes.clear();
        self.loose.clear();
        let mut points: Vec<(Point, Pose, usize)> = world_from_views
            .enumerate()
            .map(|(index, pose)| (point(pose), *pose, index))
            .collect();
        self.moved.clear();
        self.moved.resize(points.len(), false);
        self.split(&mut points, 0);
        self.poses = points;
    }

    fn split(&mut self, points: &mut [(Point, Pose, usize)], start: usize) {
        let (mut low, mut high) = ([f64::INFINITY; 6], [f64::NEG_INFINITY; 6]);
        for (point, _, _) in points.iter() {
            for axis in 0..6 {
                low[axis] = low[axis].min(point[axis]);
                high[axis] = high[axis].max(point[axis]);
            }
        }
        let node = self.nodes.len();
        self.nodes.push(Node {
            low,
            high,
            start,
            end: start + points.len(),
            second: 0,
        });
        if points.len() <= LEAF {
            return;
        }
        let extent = |axis: &usize| high[*axis] - low[*axis];
        let axis = (0..6)
            .max_by(|a, b| extent(a).total_cmp(&extent(b)))
            .expect("there are six");
        let middle = points.len() / 2;
        points.select_nth_unstable_by(middle, |a, b| a.0[axis].total_cmp(&b.0[axis]));
        let (first, second) = points.split_at_mut(middle);
        self.split(first, start);
        self.nodes[node].second = self.nodes.len();
        self.split(second, start + middle);
    }

    /// Says that the pose at this index has changed or is new.
    pub fn changed(&mut self, index: usize) {
        if index >= self.moved.len() {
            self.moved.resize(index + 1, false);
        }
        if !std::mem::replace(&mut self.moved[index], true) {
            self.loose.push(index);
        }
    }

    /// How many poses are looked at one by one.
    pub fn loose(&self) -> usize {
        self.loose.len()
    }

    /// Offers every pose that may be among the nearest; `pose_at` is what stands at an index now.
    pub fn offer<'a>(
        &self,
        pose_at: impl Fn(usize) -> &'a Pose,
        world_from_camera: &Pose,
        metres_per_radian: f64,
        nearest: &mut Nearest,
    ) {
        for &index in &self.loose {
            let distance_m = view_distance_m(pose_at(index), world_from_camera, metres_per_radian);
            nearest.offer(distance_m, index);
        }
        let query = Query {
            world_from_camera,
            point: point(world_from_camera),
            metres_per_radian,
        };
        if !self.nodes.is_empty() {
            self.visit(0, &query, nearest);
        }
    }

    fn visit(&self, node: usize, query: &Query, nearest: &mut Nearest) {
        let at = &self.nodes[node];
        if at.second == 0 {
            for (point, pose, index) in &self.poses[at.start..at.end] {
                // An angle takes several times as long as its chord.
                if Query::may_hold(query.bound(point, point), nearest) && !self.moved[*index] {
                    let distance_m =
                        view_distance_m(pose, query.world_from_camera, query.metres_per_radian);
                    nearest.offer(distance_m, *index);
                }
            }
            return;
        }
        let mut children = [node + 1, at.second].map(|child| {
            let Node { low, high, .. } = &self.nodes[child];
            (query.bound(low, high), child)
        });
        if children[1].0 < children[0].0 {
            children.swap(0, 1);
        }
        for (bound, child) in children {
            if Query::may_hold(bound, nearest) {
                self.visit(child, query, nearest);
            }
        }
    }
}

struct Query<'a> {
    world_from_camera: &'a Pose,
    point: Point,
    metres_per_radian: f64,
}

impl Query<'_> {
    /// Whether a pose that is no nearer than this may still be among the nearest.
    fn may_hold(bound: f64, nearest: &Nearest) -> bool {
        bound * (1.0 - ROUNDING) - ROUNDING <= nearest.farthest_m()
    }

    /// No pose between these corners is nearer.
    fn bound(&self, low: &Point, high: &Point) -> f64 {
        let outside = |axis: usize| {
            let at = self.point[axis];
            (low[axis] - at).max(at - high[axis]).max(0.0)
        };
        let norm = |axes: [usize; 3]| {
            axes.into_iter()
                .map(|axis| outside(axis) * outside(axis))
                .sum::<f64>()
                .sqrt()
        };
        norm([0, 1, 2]) + self.metres_per_radian * norm([3, 4, 5])
    }
}
