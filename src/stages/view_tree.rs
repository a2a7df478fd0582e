//! Selection among very many viewpoints: a k-d tree over position and viewing direction.
//!
//! Poses -> the same indices as [`super::select`] gives, to the last tie. View distance is at least the distance of the
//! positions plus what the chord between the directions says of their angle, and both are bounded from below by the box of a
//! node: what is pruned cannot be near.

use nalgebra::Vector3;

use crate::model::pose::{Pose, angle_rad, view_distance_m, viewing_direction};

use super::select::Nearest;

/// Poses of a leaf: looking at so many costs no more than splitting them.
const LEAF: usize = 8;
/// Bounds are rounded otherwise than distances.
const ROUNDING: f64 = 1e-9;

/// Position in metres and viewing direction, a unit vector.
type Point = [f64; 6];

fn point(world_from_view: &Pose) -> Point {
    let position = world_from_view.translation.vector;
    let direction = viewing_direction(world_from_view);
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
    leaves: Vec<Leaf>,
    /// By index: no longer where the tree thinks.
    moved: Vec<bool>,
    /// Those, and what came later.
    loose: Vec<usize>,
}

#[derive(Debug)]
struct Node {
    low: Point,
    high: Point,
    below: Below,
}

#[derive(Debug, Clone, Copy)]
enum Below {
    /// Of [`ViewTree::nodes`]: the second child; the first follows its parent.
    Nodes(usize),
    /// Of [`ViewTree::leaves`].
    Leaf(usize),
}

/// Points side by side, so that several are looked at in one step.
#[derive(Debug)]
struct Leaf {
    points: [[f64; LEAF]; 6],
    /// Of the poses, as they were given.
    indices: [usize; LEAF],
    count: usize,
}

impl ViewTree {
    /// Forgets the poses it had.
    pub fn build<'a>(&mut self, world_from_views: impl Iterator<Item = &'a Pose>) {
        self.nodes.clear();
        self.leaves.clear();
        self.loose.clear();
        let mut points: Vec<(Point, usize)> = world_from_views
            .enumerate()
            .map(|(index, pose)| (point(pose), index))
            .collect();
        self.moved.clear();
        self.moved.resize(points.len(), false);
        self.split(&mut points);
    }

    fn split(&mut self, points: &mut [(Point, usize)]) {
        let (mut low, mut high) = ([f64::INFINITY; 6], [f64::NEG_INFINITY; 6]);
        for (point, _) in points.iter() {
            for axis in 0..6 {
                low[axis] = low[axis].min(point[axis]);
                high[axis] = high[axis].max(point[axis]);
            }
        }
        let node = self.nodes.len();
        let below = Below::Leaf(self.leaves.len());
        self.nodes.push(Node { low, high, below });
        if points.len() <= LEAF {
            let mut leaf = Leaf {
                points: [[0.0; LEAF]; 6],
                indices: [0; LEAF],
                count: points.len(),
            };
            for (lane, (point, index)) in points.iter().enumerate() {
                leaf.indices[lane] = *index;
                for axis in 0..6 {
                    leaf.points[axis][lane] = point[axis];
                }
            }
            self.leaves.push(leaf);
            return;
        }
        let extent = |axis: &usize| high[*axis] - low[*axis];
        let axis = (0..6)
            .max_by(|a, b| extent(a).total_cmp(&extent(b)))
            .expect("there are six");
        let middle = points.len() / 2;
        points.select_nth_unstable_by(middle, |a, b| a.0[axis].total_cmp(&b.0[axis]));
        let (first, second) = points.split_at_mut(middle);
        self.split(first);
        self.nodes[node].below = Below::Nodes(self.nodes.len());
        self.split(second);
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
            point: point(world_from_camera),
            metres_per_radian,
        };
        if !self.nodes.is_empty() {
            self.visit(0, &query, nearest);
        }
    }

    fn visit(&self, node: usize, query: &Query, nearest: &mut Nearest) {
        let second = match self.nodes[node].below {
            Below::Leaf(leaf) => return self.look_through(&self.leaves[leaf], query, nearest),
            Below::Nodes(second) => second,
        };
        let mut children = [node + 1, second].map(|child| {
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

    fn look_through(&self, leaf: &Leaf, query: &Query, nearest: &mut Nearest) {
        let bounds = query.bounds(&leaf.points);
        for (lane, bound) in bounds.into_iter().enumerate().take(leaf.count) {
            // An angle takes several times as long as its bound.
            let index = leaf.indices[lane];
            if Query::may_hold(bound, nearest) && !self.moved[index] {
                let point = leaf.points.map(|axis| axis[lane]);
                nearest.offer(query.distance_m(&point), index);
            }
        }
    }
}

/// Radians: an angle whose chord, squared, is at least that. The series of `2 asin(c/2)` has positive terms only.
fn angle_at_least(chord_squared: f64) -> f64 {
    let series = 1.0 + chord_squared * (1.0 / 24.0 + chord_squared * (3.0 / 640.0));
    chord_squared.sqrt() * series
}

struct Query {
    point: Point,
    metres_per_radian: f64,
}

impl Query {
    /// Whether a pose that is no nearer than this may still be among the nearest.
    fn may_hold(bound: f64, nearest: &Nearest) -> bool {
        bound * (1.0 - ROUNDING) - ROUNDING <= nearest.farthest_m()
    }

    /// None of these poses is nearer.
    fn bounds(&self, points: &[[f64; LEAF]; 6]) -> [f64; LEAF] {
        let mut squares = [[0.0; LEAF]; 2];
        for (axis, points) in points.iter().enumerate() {
            let (at, squares) = (self.point[axis], &mut squares[axis / 3]);
            for lane in 0..LEAF {
                let apart = points[lane] - at;
                squares[lane] += apart * apart;
            }
        }
        let [position, direction] = squares;
        std::array::from_fn(|lane| {
            position[lane].sqrt() + self.metres_per_radian * angle_at_least(direction[lane])
        })
    }

    /// The same as [`view_distance_m`], to the bit.
    fn distance_m(&self, point: &Point) -> f64 {
        let parts = |[x, y, z, along_x, along_y, along_z]: &Point| {
            (
                Vector3::new(*x, *y, *z),
                Vector3::new(*along_x, *along_y, *along_z),
            )
        };
        let (position, direction) = parts(point);
        let (here, towards) = parts(&self.point);
        (position - here).norm() + self.metres_per_radian * angle_rad(&direction, &towards)
    }

    /// No pose between these corners is nearer.
    fn bound(&self, low: &Point, high: &Point) -> f64 {
        let outside = |axis: usize| {
            let at = self.point[axis];
            (low[axis] - at).max(at - high[axis]).max(0.0)
        };
        let square = |axes: [usize; 3]| {
            let squares = axes.map(|axis| outside(axis) * outside(axis));
            squares.into_iter().sum::<f64>()
        };
        square([0, 1, 2]).sqrt() + self.metres_per_radian * angle_at_least(square([3, 4, 5]))
    }
}
