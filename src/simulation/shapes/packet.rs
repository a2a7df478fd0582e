//! Whether, and where, rays from one point meet a shape: many rays at once, in single precision, for light. What is
//! known of the point alone is taken in double precision, so that a point on a surface is on it.

use nalgebra::{Point3, Vector3};

use super::{Disc, Frustum, Shape, Solid};
use crate::{
    isa::for_each_isa,
    lanes::{LANES, Lanes, bits},
};

/// Directions of rays, of any length: x, y, z.
pub type Directions = [Lanes; 3];

/// Nearer crossings, in lengths of the direction, are the surface that a ray leaves.
const LIFT: f32 = 1e-6;
/// Whether also what single precision cannot tell from met counts as met.
pub type Caution = bool;
pub const CAUTIOUS: Caution = true;
pub const PLAIN: Caution = false;
/// More than lengths and places are wrong in single precision, even where a ray only just meets a shape: metres.
const SLACK: f32 = 2e-3;
/// More than differences of squares are wrong, of the greater.
const SQUARE_SLACK: f32 = 2e-5;

#[inline(always)]
fn single(vector: &Vector3<f64>) -> [f32; 3] {
    [vector.x as f32, vector.y as f32, vector.z as f32]
}

#[inline(always)]
fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline(always)]
fn least(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

#[inline(always)]
fn greatest(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

#[inline(always)]
fn spare<const CAUTION: Caution>() -> f32 {
    if CAUTION { SLACK } else { 0.0 }
}

/// Both roots of `a t^2 + 2 b t + c`, the lesser first; meaningless where there is none, which comes third.
#[inline(always)]
fn roots<const CAUTION: Caution>(a: f32, b: f32, c: f32) -> (f32, f32, bool) {
    let discriminant = b * b - a * c;
    let root = greatest(discriminant, 0.0).sqrt();
    let q = -(b + root.copysign(b));
    let (one, two) = (q / a, c / q);
    (
        least(one, two),
        greatest(one, two),
        (discriminant >= if CAUTION { -SQUARE_SLACK * b * b } else { 0.0 }) & (a != 0.0),
    )
}

for_each_isa! {
    /// Bits of the lanes whose ray from `origin` may meet the shape nearer than `nearest`; no other does.
    pub fn within(shape: &Shape, origin: &Point3<f64>, directions: &Directions, nearest: &Lanes, lanes: &mut u32) = within_kernel;
}

/// A root is no farther off than this, of itself.
const ROOT_SLACK: f32 = 5e-3;

#[inline(always)]
fn within_kernel(
    shape: &Shape,
    origin: &Point3<f64>,
    directions: &Directions,
    nearest: &Lanes,
    lanes: &mut u32,
) {
    let mut met = [f32::INFINITY; LANES];
    shape.approach::<CAUTIOUS>(origin, directions, &mut met);
    *lanes = bits(|lane| met[lane] * (1.0 - ROOT_SLACK) < nearest[lane]);
}

impl Shape {
    /// Lessens `nearest`, in lengths of each direction, to where the ray from `origin` meets this shape.
    #[inline(always)]
    pub fn approach<const CAUTION: Caution>(
        &self,
        origin: &Point3<f64>,
        directions: &Directions,
        nearest: &mut Lanes,
    ) {
        let [xs, ys, zs] = directions;
        match self {
            Self::Sphere(sphere) => {
                let from_center = origin - sphere.center;
                let beyond = from_center.norm_squared() - sphere.radius * sphere.radius;
                round::<CAUTION>(single(&from_center), beyond as f32, directions, nearest);
            }
            Self::Ellipsoid(ellipsoid) => {
                let from_center = ellipsoid.unit_from_world * (origin - ellipsoid.center);
                let rows: [[f32; 3]; 3] = std::array::from_fn(|row| {
                    single(&ellipsoid.unit_from_world.row(row).transpose())
                });
                let mut unit = [[0.0; LANES]; 3];
                for (unit, row) in unit.iter_mut().zip(&rows) {
                    for lane in 0..LANES {
                        unit[lane] = dot(*row, [xs[lane], ys[lane], zs[lane]]);
                    }
                }
                let beyond = from_center.norm_squared() - 1.0;
                round::<CAUTION>(single(&from_center), beyond as f32, &unit, nearest);
            }
            Self::Frustum(frustum) => frustum.approach::<CAUTION>(origin, directions, nearest),
            Self::Disc(disc) => disc.approach::<CAUTION>(origin, directions, nearest),
            Self::Solid(solid) => solid.approach::<CAUTION>(origin, directions, nearest),
        }
    }
}

/// A sphere around the origin; `beyond`: of the point `from_center`, the square of its distance less that of the radius.
#[inline(always)]
fn round<const CAUTION: Caution>(
    from_center: [f32; 3],
    beyond: f32,
    directions: &Directions,
    nearest: &mut Lanes,
) {
    let [xs, ys, zs] = directions;
    for lane in 0..LANES {
        let direction = [xs[lane], ys[lane], zs[lane]];
        let (near, far, any) = roots::<CAUTION>(
            dot(direction, direction),
            dot(from_center, direction),
            beyond,
        );
        let t = if near > LIFT { near } else { far };
        let met = any & (t > LIFT) & (t < nearest[lane]);
        nearest[lane] = if met { t } else { nearest[lane] };
    }
}

impl Frustum {
    #[inline(always)]
    fn approach<const CAUTION: Caution>(
        &self,
        origin: &Point3<f64>,
        directions: &Directions,
        nearest: &mut Lanes,
    ) {
        let [xs, ys, zs] = directions;
        let from_base = origin - self.base;
        let height = from_base.dot(&self.axis);
        let beside = from_base - self.axis * height;
        let radius = self.base_radius + self.taper * height;
        let beyond = (beside.norm_squared() - radius * radius) as f32;
        let beside2 = beside.norm_squared() as f32;
        let (axis, beside) = (single(&self.axis), single(&beside));
        let (taper, length) = (self.taper as f32, self.height as f32);
        let (radius, above, below) = (radius as f32, height as f32, (height - self.height) as f32);
        let lids = [
            (self.closed_base, above, self.base_radius),
            (self.closed_top, below, self.top_radius),
        ];
        let spare = spare::<CAUTION>();
        // Without lids: of the infinite cone between the two levels.
        for lane in 0..LANES {
            let direction = [xs[lane], ys[lane], zs[lane]];
            let climb = dot(direction, axis);
            let across = [
                direction[0] - axis[0] * climb,
                direction[1] - axis[1] * climb,
                direction[2] - axis[2] * climb,
            ];
            let widening = taper * climb;
            let (near, far, any) = roots::<CAUTION>(
                dot(across, across) - widening * widening,
                dot(beside, across) - radius * widening,
                beyond,
            );
            let met = |t: f32| {
                let level = above + t * climb;
                any & (t > LIFT)
                    & (t < nearest[lane])
                    & (level >= -spare)
                    & (level <= length + spare)
            };
            let (first, second) = (met(near), met(far));
            let t = if first { near } else { far };
            nearest[lane] = if first | second { t } else { nearest[lane] };
        }
        for (closed, above, radius) in lids {
            if !closed {
                continue;
            }
            let radius2 = (radius as f32 + spare) * (radius as f32 + spare);
            for lane in 0..LANES {
                let direction = [xs[lane], ys[lane], zs[lane]];
                let climb = dot(direction, axis);
                let across = [
                    direction[0] - axis[0] * climb,
                    direction[1] - axis[1] * climb,
                    direction[2] - axis[2] * climb,
                ];
                let t = -above / climb;
                let aside2 = beside2 + t * (2.0 * dot(beside, across) + t * dot(across, across));
                let met = (t > LIFT) & (t < nearest[lane]) & (aside2 <= radius2);
                nearest[lane] = if met { t } else { nearest[lane] };
            }
        }
    }
}

impl Disc {
    #[inline(always)]
    fn approach<const CAUTION: Caution>(
        &self,
        origin: &Point3<f64>,
        directions: &Directions,
        nearest: &mut Lanes,
    ) {
        let [xs, ys, zs] = directions;
        let from_center = origin - self.center;
        let above = self.normal.dot(&from_center) as f32;
        let (normal, from_center) = (single(&self.normal), single(&from_center));
        let spare = spare::<CAUTION>();
        let (inner, outer) = (self.inner_radius as f32 - spare, self.radius as f32 + spare);
        let (inner2, outer2) = (greatest(inner, 0.0) * inner, outer * outer);
        for lane in 0..LANES {
            let direction = [xs[lane], ys[lane], zs[lane]];
            // A parallel ray gives an infinite or undefined t, which fails.
            let t = -above / dot(normal, direction);
            let offset = [
                from_center[0] + t * direction[0],
                from_center[1] + t * direction[1],
                from_center[2] + t * direction[2],
            ];
            let aside2 = dot(offset, offset);
            let met = (t > LIFT) & (t < nearest[lane]) & (aside2 <= outer2) & (aside2 >= inner2);
            nearest[lane] = if met { t } else { nearest[lane] };
        }
    }
}

impl Solid {
    #[inline(always)]
    fn approach<const CAUTION: Caution>(
        &self,
        origin: &Point3<f64>,
        directions: &Directions,
        nearest: &mut Lanes,
    ) {
        let [xs, ys, zs] = directions;
        let (mut enter, mut leave) = ([f32::NEG_INFINITY; LANES], [f32::INFINITY; LANES]);
        let (slabs, slopes) = self.planes.split_at(6);
        // Of a parallel ray: so little that it is far inside or far outside.
        let steep = |slope: f32| {
            if slope.abs() < 1e-12 { 1e-12 } else { slope }
        };
        for planes in slabs.as_chunks::<2>().0 {
            let [(normal, above), (_, below)] = planes;
            let height = normal.dot(&origin.coords);
            let (up, down) = ((above - height) as f32, (-below - height) as f32);
            let normal = single(normal);
            for lane in 0..LANES {
                let slope = steep(dot(normal, [xs[lane], ys[lane], zs[lane]]));
                let inverse = 1.0 / slope;
                let (one, two) = (up * inverse, down * inverse);
                enter[lane] = greatest(enter[lane], least(one, two));
                leave[lane] = least(leave[lane], greatest(one, two));
            }
        }
        for (normal, offset) in slopes {
            let below = (offset - normal.dot(&origin.coords)) as f32;
            let normal = single(normal);
            for lane in 0..LANES {
                let slope = steep(dot(normal, [xs[lane], ys[lane], zs[lane]]));
                let t = below / slope;
                let falling = slope < 0.0;
                enter[lane] = if falling {
                    greatest(enter[lane], t)
                } else {
                    enter[lane]
                };
                leave[lane] = if falling {
                    leave[lane]
                } else {
                    least(leave[lane], t)
                };
            }
        }
        let spare = spare::<CAUTION>();
        for lane in 0..LANES {
            let t = if enter[lane] > LIFT {
                enter[lane]
            } else {
                leave[lane]
            };
            let met = (enter[lane] <= leave[lane] + spare) & (t > LIFT) & (t < nearest[lane]);
            nearest[lane] = if met { t } else { nearest[lane] };
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Rotation3;

    use super::*;
    use crate::{
        isa::Isa,
        simulation::{
            random::Stream,
            shapes::{Ellipsoid, Ray, Sphere},
        },
    };

    fn shapes(stream: &mut Stream) -> Vec<Shape> {
        let mut point = || {
            Point3::new(
                stream.between(-0.3, 0.3),
                stream.between(-0.3, 0.3),
                stream.between(0.0, 0.3),
            )
        };
        let [a, b, c, d, e, f] = std::array::from_fn(|_| point());
        vec![
            Shape::Sphere(Sphere {
                center: a,
                radius: 0.09,
            }),
            Shape::Ellipsoid(Ellipsoid::new(
                b,
                Vector3::new(0.006, 0.024, 0.09),
                Rotation3::from_axis_angle(&Vector3::x_axis(), a.x * 9.0),
            )),
            Shape::Frustum(Frustum::new(c, d, 0.03, 0.05).with_base().with_top()),
            Shape::Frustum(Frustum::new(d, e, 0.02, 0.02)),
            Shape::Disc(Disc {
                center: e,
                normal: Vector3::z(),
                inner_radius: 0.02,
                radius: 0.1,
            }),
            Shape::Solid(Solid::cuboid(f, Vector3::new(0.2, 0.004, 0.1), a.y * 9.0)),
            Shape::Solid(Solid::gabled(
                f,
                Vector3::new(0.1, 0.1, 0.2),
                0.04,
                a.y * 9.0,
            )),
        ]
    }

    /// As a camera looks: from a metre or two away, every ray towards somewhere among the shapes.
    fn rays(stream: &mut Stream) -> (Vec<Ray>, Directions) {
        let origin = Point3::new(stream.between(-1.0, 1.0), -1.2, stream.between(0.2, 1.5));
        let mut directions = [[0.0; LANES]; 3];
        let rays = (0..LANES)
            .map(|lane| {
                let mut place = || stream.between(-0.35, 0.35);
                let towards = Point3::new(place(), place(), place() + 0.15) - origin;
                let direction = towards.normalize();
                for axis in 0..3 {
                    directions[axis][lane] = direction[axis] as f32;
                }
                Ray { origin, direction }
            })
            .collect();
        (rays, directions)
    }

    #[test]
    fn many_rays_leave_out_nothing_that_one_meets() {
        let mut stream = Stream::new(5, &[1]);
        let (mut met, mut named) = (0, 0);
        for _ in 0..3000 {
            let (rays, directions) = rays(&mut stream);
            for shape in shapes(&mut stream) {
                for isa in Isa::available() {
                    let mut lanes = 0;
                    let far = [f32::INFINITY; LANES];
                    within(isa, &shape, &rays[0].origin, &directions, &far, &mut lanes);
                    named += lanes.count_ones();
                    for (lane, ray) in rays.iter().enumerate() {
                        if let Some(crossing) = shape.crossing(ray, 1e-7, f64::INFINITY) {
                            met += 1;
                            assert!(lanes >> lane & 1 == 1, "{shape:?} {ray:?} {crossing:?}");
                            let mut lanes = 0;
                            let nearest = [crossing.t as f32; LANES];
                            let origin = &ray.origin;
                            within(isa, &shape, origin, &directions, &nearest, &mut lanes);
                            assert!(lanes >> lane & 1 == 1, "at its own distance: {shape:?}");
                        }
                    }
                }
            }
        }
        assert!(met > 10_000, "the rays meet something: {met}");
        // So that leaving out is worth it.
        assert!(named < met + met / 4, "{named} named for {met} met");
    }

    #[test]
    fn many_rays_meet_what_one_meets() {
        let mut stream = Stream::new(6, &[1]);
        let (mut met, mut differ) = (0, 0);
        for _ in 0..3000 {
            let (rays, directions) = rays(&mut stream);
            for shape in shapes(&mut stream) {
                let mut nearest = [f32::INFINITY; LANES];
                shape.approach::<PLAIN>(&rays[0].origin, &directions, &mut nearest);
                for (ray, &there) in rays.iter().zip(&nearest) {
                    let here = shape.crossing(ray, 1e-7, f64::INFINITY);
                    met += usize::from(here.is_some());
                    let same = match here {
                        Some(here) => (here.t as f32 - there).abs() < 1e-3,
                        None => there == f32::INFINITY,
                    };
                    differ += usize::from(!same);
                }
            }
        }
        assert!(met > 10_000, "the rays meet something: {met}");
        // Rays that only just meet a shape, or miss it.
        assert!(differ < met / 500, "{differ} of {met} differ");
    }
}
