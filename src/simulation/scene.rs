//! What there is to see: shapes with materials, sorted into a tree of bounding boxes.

use super::{
    casters::Casters,
    shapes::{Bounds, Crossing, Ray, Shape},
    texture::Pattern,
};

/// What a shape belongs to; the room itself is 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct ObjectId(pub u16);

impl ObjectId {
    pub const ROOM: Self = Self(0);
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Finish {
    Matte,
    /// Varnished, glazed or polished: mirrors `reflectance` at right angles (more at grazing ones).
    Glossy {
        reflectance: f32,
        sharpness: f32,
    },
    /// Clear, with this index of refraction; normals point out of the material.
    Glass {
        index: f64,
    },
}

#[derive(Debug, Clone)]
pub struct Material {
    pub pattern: Pattern,
    pub finish: Finish,
}

#[derive(Debug, Clone)]
pub struct Primitive {
    pub shape: Shape,
    pub material: Material,
    pub object: ObjectId,
    /// The material lies outside of the shape: the shape is the inner wall of a vessel.
    pub hollow: bool,
    /// Walls and floors throw no shadow that could be seen.
    pub casts_shadow: bool,
}

impl Primitive {
    pub fn is_glass(&self) -> bool {
        matches!(self.material.finish, Finish::Glass { .. })
    }

    /// Big enough to keep a noticeable part of the sky from what is beside it; the table itself and the like count as
    /// ground instead, which is darker anyway.
    fn dims_sky(&self) -> bool {
        let mut half: [f64; 3] = self.shape.bounds().half().into();
        half.sort_by(f64::total_cmp);
        let [thin, broad, long] = half;
        self.casts_shadow
            && !self.hollow
            && !self.is_glass()
            && thin > 0.010
            && broad > 0.028
            && long < 0.5
    }

    fn hides(&self, light: Light) -> bool {
        match light {
            Light::Lamp => self.casts_shadow,
            Light::Sky => self.dims_sky(),
        }
    }
}

/// What light a primitive may hide.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Light {
    Lamp,
    Sky,
}

/// The nearest thing on a ray.
#[derive(Debug, Clone, Copy)]
pub struct Hit {
    pub crossing: Crossing,
    pub primitive: usize,
}

#[derive(Debug, Clone)]
pub struct Scene {
    primitives: Vec<Primitive>,
    /// Of each primitive.
    bounds: Vec<Bounds>,
    /// Of the lamp, and of the sky.
    casters: [Casters; 2],
    nodes: Vec<Node>,
}

#[derive(Debug, Clone)]
struct Node {
    bounds: Bounds,
    /// Leaf: its primitives. Branch: `count` is 0, the left child follows, `start` is the right one.
    start: u32,
    count: u32,
    /// Branch: the left child lies lower along it.
    axis: u8,
}

/// What the tree needs to know of a primitive, and which it is.
struct Boxed {
    bounds: Bounds,
    index: usize,
}

const LEAF: usize = 2;

impl Scene {
    pub fn new(primitives: Vec<Primitive>) -> Self {
        let mut boxed: Vec<Boxed> = primitives
            .iter()
            .zip(0..)
            .map(|(primitive, index)| Boxed {
                bounds: primitive.shape.bounds(),
                index,
            })
            .collect();
        let mut nodes = Vec::with_capacity(boxed.len() * 2);
        if !boxed.is_empty() {
            build(&mut boxed, 0, &mut nodes);
        }
        let mut unsorted: Vec<_> = primitives.into_iter().map(Some).collect();
        let primitives: Vec<_> = boxed
            .iter()
            .filter_map(|boxed| unsorted[boxed.index].take())
            .collect();
        Self {
            casters: [Light::Lamp, Light::Sky].map(|light| {
                let casters = primitives.iter().zip(0..);
                Casters::new(
                    casters
                        .filter(|(primitive, _)| primitive.hides(light))
                        .map(|(primitive, index)| (index, primitive.shape.ball())),
                )
            }),
            bounds: boxed.iter().map(|boxed| boxed.bounds).collect(),
            primitives,
            nodes,
        }
    }

    pub fn primitives(&self) -> &[Primitive] {
        &self.primitives
    }

    /// Of each primitive.
    pub fn bounds(&self) -> &[Bounds] {
        &self.bounds
    }

    /// Of the primitives that `seen` allows.
    pub fn nearest(
        &self,
        ray: &Ray,
        t_min: f64,
        t_max: f64,
        seen: impl Fn(&Primitive) -> bool,
    ) -> Option<Hit> {
        // Finite also for a ray along an axis: 0 * infinity would be undefined.
        let inverse = ray
            .direction
            .map(|d| if d.abs() < 1e-12 { 1e12 } else { d.recip() });
        let mut best: Option<Hit> = None;
        let mut t_max = t_max;
        self.walk(
            |node, t_max: f64| enters(&node.bounds, ray, &inverse, t_max),
            // The nearer half first: what it holds may hide the other.
            |axis| ray.direction[axis] >= 0.0,
            &mut t_max,
            |index, t_max| {
                let primitive = &self.primitives[index];
                if let Some(crossing) = primitive.shape.crossing(ray, t_min, *t_max)
                    && seen(primitive)
                {
                    *t_max = crossing.t;
                    best = Some(Hit {
                        crossing,
                        primitive: index,
                    });
                }
            },
        );
        best
    }

    /// What may hide this light.
    pub fn casters(&self, light: Light) -> &Casters {
        &self.casters[light as usize]
    }

    fn walk<S: Copy>(
        &self,
        enter: impl Fn(&Node, S) -> bool,
        left_first: impl Fn(usize) -> bool,
        state: &mut S,
        mut visit: impl FnMut(usize, &mut S),
    ) {
        let mut stack = [0u32; 64];
        let mut depth = usize::from(!self.nodes.is_empty());
        while depth > 0 {
            depth -= 1;
            let index = stack[depth];
            let node = &self.nodes[index as usize];
            if !enter(node, *state) {
                continue;
            }
            if node.count > 0 {
                for primitive in node.start..node.start + node.count {
                    visit(primitive as usize, state);
                }
            } else {
                let (left, right) = (index + 1, node.start);
                let (next, later) = if left_first(usize::from(node.axis)) {
                    (left, right)
                } else {
                    (right, left)
                };
                stack[depth] = later;
                stack[depth + 1] = next;
                depth += 2;
            }
        }
    }
}

/// A part has at least an eighth of the whole: with 64 open branches there is room for ten thousand primitives.
fn build(primitives: &mut [Boxed], offset: u32, nodes: &mut Vec<Node>) {
    let bounds = primitives
        .iter()
        .fold(Bounds::EMPTY, |bounds, boxed| bounds.joined(&boxed.bounds));
    let index = nodes.len();
    nodes.push(Node {
        bounds,
        start: offset,
        count: primitives.len() as u32,
        axis: 0,
    });
    if primitives.len() <= LEAF {
        return;
    }
    let (axis, middle) = best_split(primitives);
    sort_along(primitives, axis);
    let (left, right) = primitives.split_at_mut(middle);
    build(left, offset, nodes);
    nodes[index].start = nodes.len() as u32;
    nodes[index].count = 0;
    nodes[index].axis = axis as u8;
    build(right, offset + middle as u32, nodes);
}

fn sort_along(primitives: &mut [Boxed], axis: usize) {
    // Twice the centre.
    let place = |boxed: &Boxed| boxed.bounds.min[axis] + boxed.bounds.max[axis];
    primitives.sort_by(|a, b| place(a).total_cmp(&place(b)));
}

/// The axis and the number of primitives on its lower side for which a ray is expected to meet the fewest: a part is
/// entered in proportion to its surface.
fn best_split(primitives: &mut [Boxed]) -> (usize, usize) {
    let count = primitives.len();
    let least = (count / 8).max(1);
    let mut best = (f64::INFINITY, 0, count / 2);
    for axis in 0..3 {
        sort_along(primitives, axis);
        let mut above = vec![0.0; count];
        let mut bounds = Bounds::EMPTY;
        for index in (1..count).rev() {
            bounds = bounds.joined(&primitives[index].bounds);
            above[index] = bounds.surface() * (count - index) as f64;
        }
        let mut bounds = Bounds::EMPTY;
        for middle in 1..=count - least {
            bounds = bounds.joined(&primitives[middle - 1].bounds);
            let cost = bounds.surface() * middle as f64 + above[middle];
            if middle >= least && cost < best.0 {
                best = (cost, axis, middle);
            }
        }
    }
    (best.1, best.2)
}

#[inline]
fn enters(bounds: &Bounds, ray: &Ray, inverse: &nalgebra::Vector3<f64>, t_max: f64) -> bool {
    let (mut near, mut far) = (0.0, t_max);
    for axis in 0..3 {
        let one = (bounds.min[axis] - ray.origin[axis]) * inverse[axis];
        let two = (bounds.max[axis] - ray.origin[axis]) * inverse[axis];
        let (low, high) = if one < two { (one, two) } else { (two, one) };
        near = if low > near { low } else { near };
        far = if high < far { high } else { far };
    }
    // A touch of slack, so that flat shapes are not lost to rounding.
    near <= far + 1e-9
}
