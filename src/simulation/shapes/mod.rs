//! The solids and surfaces of which everything in the simulated world is made, in closed form.
//!
//! Metres, world coordinates, z up. Double precision: depth is used as ground truth. Every shape but a [`Frustum`] seen
//! from inside is convex, so a shape cannot shade itself.

mod packet;

use nalgebra::{Matrix3, Point3, Rotation3, Vector3};

pub use self::packet::{Directions, PLAIN, within};

/// Half a line; `direction` has unit length.
#[derive(Debug, Clone, Copy)]
pub struct Ray {
    pub origin: Point3<f64>,
    pub direction: Vector3<f64>,
}

impl Ray {
    pub fn at(&self, t: f64) -> Point3<f64> {
        self.origin + self.direction * t
    }
}

/// Axis-aligned bounds.
#[derive(Debug, Clone, Copy)]
pub struct Bounds {
    pub min: Point3<f64>,
    pub max: Point3<f64>,
}

impl Bounds {
    pub const EMPTY: Self = Self {
        min: Point3::new(f64::INFINITY, f64::INFINITY, f64::INFINITY),
        max: Point3::new(f64::NEG_INFINITY, f64::NEG_INFINITY, f64::NEG_INFINITY),
    };

    pub fn of(points: impl IntoIterator<Item = Point3<f64>>) -> Self {
        points.into_iter().fold(Self::EMPTY, |bounds, point| Self {
            min: bounds.min.inf(&point),
            max: bounds.max.sup(&point),
        })
    }

    pub fn joined(&self, other: &Self) -> Self {
        Self {
            min: self.min.inf(&other.min),
            max: self.max.sup(&other.max),
        }
    }

    pub fn contains(&self, point: &Point3<f64>) -> bool {
        (0..3).all(|axis| (self.min[axis]..=self.max[axis]).contains(&point[axis]))
    }

    pub fn center(&self) -> Point3<f64> {
        nalgebra::center(&self.min, &self.max)
    }

    pub fn half(&self) -> Vector3<f64> {
        (self.max - self.min) * 0.5
    }

    /// Square metres.
    pub fn surface(&self) -> f64 {
        let size = self.max - self.min;
        2.0 * (size.x * size.y + size.y * size.z + size.z * size.x)
    }
}

/// A sphere that holds a shape.
#[derive(Debug, Clone, Copy)]
pub struct Ball {
    pub center: Point3<f64>,
    pub radius: f64,
}

/// Where a ray met a shape. `part` is the face: of a frustum 0 side, 1 base, 2 top; of a solid the number of its plane.
#[derive(Debug, Clone, Copy)]
pub struct Crossing {
    pub t: f64,
    pub part: usize,
}

/// The surface at a point: outward normal and texture coordinates in metres (right and up as seen from outside).
#[derive(Debug, Clone, Copy)]
pub struct Surface {
    pub normal: Vector3<f64>,
    /// The direction in which u grows, of unit length.
    pub right: Vector3<f64>,
    pub u: f64,
    pub v: f64,
}

#[derive(Debug, Clone)]
pub enum Shape {
    Sphere(Sphere),
    Ellipsoid(Ellipsoid),
    Frustum(Frustum),
    Disc(Disc),
    Solid(Solid),
}

#[derive(Debug, Clone)]
pub struct Sphere {
    pub center: Point3<f64>,
    pub radius: f64,
}

#[derive(Debug, Clone)]
pub struct Ellipsoid {
    center: Point3<f64>,
    unit_from_world: Matrix3<f64>,
    half: Vector3<f64>,
}

impl Ellipsoid {
    /// Semi-axes along the turned x, y, z.
    pub fn new(center: Point3<f64>, semi_axes: Vector3<f64>, rotation: Rotation3<f64>) -> Self {
        let world_from_unit = rotation.matrix() * Matrix3::from_diagonal(&semi_axes);
        let unit_from_world =
            Matrix3::from_diagonal(&semi_axes.map(f64::recip)) * rotation.matrix().transpose();
        Self {
            center,
            unit_from_world,
            half: Vector3::from_fn(|row, _| world_from_unit.row(row).norm()),
        }
    }
}

/// A truncated cone or a cylinder, with or without its two lids.
#[derive(Debug, Clone)]
pub struct Frustum {
    base: Point3<f64>,
    axis: Vector3<f64>,
    height: f64,
    base_radius: f64,
    top_radius: f64,
    /// Of the radius, for each metre along the axis.
    taper: f64,
    closed_base: bool,
    closed_top: bool,
    right: Vector3<f64>,
    forward: Vector3<f64>,
}

impl Frustum {
    /// Around the line from `base` to `top`.
    pub fn new(base: Point3<f64>, top: Point3<f64>, base_radius: f64, top_radius: f64) -> Self {
        let along = top - base;
        let height = along.norm();
        let axis = along / height;
        let helper = if axis.z.abs() < 0.9 {
            Vector3::z()
        } else {
            Vector3::x()
        };
        let right = (helper - axis * helper.dot(&axis)).normalize();
        Self {
            base,
            axis,
            height,
            base_radius,
            top_radius,
            taper: (top_radius - base_radius) / height,
            closed_base: false,
            closed_top: false,
            right,
            forward: axis.cross(&right),
        }
    }

    /// Turns the direction in which texture coordinate `u` begins, radians about the axis.
    pub fn turned(mut self, angle_rad: f64) -> Self {
        let (sin, cos) = angle_rad.sin_cos();
        (self.right, self.forward) = (
            self.right * cos + self.forward * sin,
            self.forward * cos - self.right * sin,
        );
        self
    }

    pub fn with_base(mut self) -> Self {
        self.closed_base = true;
        self
    }

    pub fn with_top(mut self) -> Self {
        self.closed_top = true;
        self
    }
}

/// A flat ring; a whole disc if `inner_radius` is 0.
#[derive(Debug, Clone)]
pub struct Disc {
    pub center: Point3<f64>,
    pub normal: Vector3<f64>,
    pub inner_radius: f64,
    pub radius: f64,
}

/// A convex solid between planes.
#[derive(Debug, Clone)]
pub struct Solid {
    /// Outward normal and offset: inside is `normal . p <= offset`. The first six are three pairs of opposite faces.
    planes: Vec<(Vector3<f64>, f64)>,
    /// Of each face: the directions of its texture's u and v.
    axes: Vec<[Vector3<f64>; 2]>,
    origin: Point3<f64>,
    right: Vector3<f64>,
    bounds: Bounds,
}

impl Solid {
    /// Outward normal and offset of each face: inside is `normal . p <= offset`.
    pub fn planes(&self) -> &[(Vector3<f64>, f64)] {
        &self.planes
    }

    /// Of a face: where its texture begins, and the directions in which u and v grow.
    pub fn texture(&self, part: usize) -> (&Point3<f64>, &[Vector3<f64>; 2]) {
        (&self.origin, &self.axes[part])
    }

    /// Where a ray meets the plane of a face, metres along the ray.
    pub fn on_plane_of(&self, part: usize, ray: &Ray) -> f64 {
        let (normal, offset) = &self.planes[part];
        (offset - normal.dot(&ray.origin.coords)) / normal.dot(&ray.direction)
    }

    fn axes_of(&self, normal: &Vector3<f64>) -> [Vector3<f64>; 2] {
        if normal.z.abs() > 0.99 {
            [self.right, Vector3::z().cross(&self.right)]
        } else {
            [Vector3::z().cross(normal).normalize(), Vector3::z()]
        }
    }

    /// A box standing on `origin` (the middle of its base), `size` along its own axes, turned about z.
    pub fn cuboid(origin: Point3<f64>, size: Vector3<f64>, yaw_rad: f64) -> Self {
        let (right, forward) = turned_axes(yaw_rad);
        let up = Vector3::z();
        let corners = [-0.5, 0.5].into_iter().flat_map(|x| {
            [-0.5, 0.5].into_iter().flat_map(move |y| {
                [0.0, 1.0].map(|z| {
                    origin + right * (x * size.x) + forward * (y * size.y) + up * (z * size.z)
                })
            })
        });
        let planes = [
            (right, size.x * 0.5),
            (-right, size.x * 0.5),
            (forward, size.y * 0.5),
            (-forward, size.y * 0.5),
            (up, size.z),
            (-up, 0.0),
        ];
        let mut solid = Self {
            planes: Vec::new(),
            axes: Vec::new(),
            origin,
            right,
            bounds: Bounds::of(corners),
        };
        for (normal, reach) in planes {
            solid.cut(normal, normal.dot(&origin.coords) + reach);
        }
        solid
    }

    /// Leaves what lies below a plane.
    fn cut(&mut self, normal: Vector3<f64>, offset: f64) {
        self.axes.push(self.axes_of(&normal));
        self.planes.push((normal, offset));
    }

    /// A cuboid whose top is a roof: two slopes (parts 6 and 7) that fall `drop` towards its front and back.
    pub fn gabled(origin: Point3<f64>, size: Vector3<f64>, drop: f64, yaw_rad: f64) -> Self {
        let mut solid = Self::cuboid(origin, size, yaw_rad);
        let (_, forward) = turned_axes(yaw_rad);
        let ridge = origin + Vector3::z() * size.z;
        for side in [-1.0, 1.0] {
            let normal = (forward * (side * drop) + Vector3::z() * (size.y * 0.5)).normalize();
            solid.cut(normal, normal.dot(&ridge.coords));
        }
        solid
    }
}

fn turned_axes(yaw_rad: f64) -> (Vector3<f64>, Vector3<f64>) {
    let (sin, cos) = yaw_rad.sin_cos();
    (Vector3::new(cos, sin, 0.0), Vector3::new(-sin, cos, 0.0))
}

/// The first root of `a t^2 + 2 b t + c` in `(t_min, t_max)` that `accept` allows.
fn first_root(
    a: f64,
    b: f64,
    c: f64,
    t_min: f64,
    t_max: f64,
    accept: impl Fn(f64) -> bool,
) -> Option<f64> {
    let discriminant = b * b - a * c;
    if discriminant < 0.0 || a == 0.0 {
        return None;
    }
    // The root of larger size first, the other from their product: no cancellation.
    let q = -(b + discriminant.sqrt().copysign(b));
    let (one, two) = (q / a, c / q);
    [one.min(two), one.max(two)]
        .into_iter()
        .find(|&t| t > t_min && t < t_max && accept(t))
}

impl Shape {
    /// The nearest crossing with `t_min < t < t_max`, metres along the ray.
    #[inline]
    pub fn crossing(&self, ray: &Ray, t_min: f64, t_max: f64) -> Option<Crossing> {
        match self {
            Self::Sphere(sphere) => {
                let from_center = ray.origin - sphere.center;
                let along = from_center.dot(&ray.direction);
                // The distance of the ray from the centre, instead of a difference of squares.
                let beside = (from_center - ray.direction * along).norm_squared();
                let square = sphere.radius * sphere.radius - beside;
                if square < 0.0 {
                    return None;
                }
                let half = square.sqrt();
                [-along - half, -along + half]
                    .into_iter()
                    .find(|&t| t > t_min && t < t_max)
                    .map(|t| Crossing { t, part: 0 })
            }
            Self::Ellipsoid(ellipsoid) => {
                let origin = ellipsoid.unit_from_world * (ray.origin - ellipsoid.center);
                let direction = ellipsoid.unit_from_world * ray.direction;
                first_root(
                    direction.norm_squared(),
                    origin.dot(&direction),
                    origin.norm_squared() - 1.0,
                    t_min,
                    t_max,
                    |_| true,
                )
                .map(|t| Crossing { t, part: 0 })
            }
            Self::Frustum(frustum) => frustum.crossing(ray, t_min, t_max),
            Self::Disc(disc) => {
                let slope = disc.normal.dot(&ray.direction);
                let t = disc.normal.dot(&(disc.center - ray.origin)) / slope;
                // A parallel ray gives an infinite or undefined t, which fails here.
                if !(t > t_min && t < t_max) {
                    return None;
                }
                let square = (ray.at(t) - disc.center).norm_squared();
                (square <= disc.radius * disc.radius
                    && square >= disc.inner_radius * disc.inner_radius)
                    .then_some(Crossing { t, part: 0 })
            }
            Self::Solid(solid) => {
                let (mut enter, mut leave) = (f64::NEG_INFINITY, f64::INFINITY);
                let (mut enter_part, mut leave_part) = (0, 0);
                let (slabs, slopes) = solid.planes.split_at(6);
                for (slab, planes) in slabs.chunks_exact(2).enumerate() {
                    let (normal, above) = planes[0];
                    let below = -planes[1].1;
                    let slope = normal.dot(&ray.direction);
                    let height = normal.dot(&ray.origin.coords);
                    if slope == 0.0 {
                        if height > above || height < below {
                            return None;
                        }
                        continue;
                    }
                    let inverse = slope.recip();
                    let (up, down) = ((above - height) * inverse, (below - height) * inverse);
                    let rising = slope > 0.0;
                    let (near, far) = if rising { (down, up) } else { (up, down) };
                    if near > enter {
                        (enter, enter_part) = (near, 2 * slab + usize::from(rising));
                    }
                    if far < leave {
                        (leave, leave_part) = (far, 2 * slab + usize::from(!rising));
                    }
                    if enter > leave {
                        return None;
                    }
                }
                for (part, (normal, offset)) in slopes.iter().enumerate() {
                    let part = part + 6;
                    let slope = normal.dot(&ray.direction);
                    let distance = offset - normal.dot(&ray.origin.coords);
                    if slope == 0.0 {
                        if distance < 0.0 {
                            return None;
                        }
                        continue;
                    }
                    let t = distance / slope;
                    if slope < 0.0 {
                        if t > enter {
                            (enter, enter_part) = (t, part);
                        }
                    } else if t < leave {
                        (leave, leave_part) = (t, part);
                    }
                    if enter > leave {
                        return None;
                    }
                }
                if enter > t_min {
                    (enter < t_max).then_some(Crossing {
                        t: enter,
                        part: enter_part,
                    })
                } else {
                    (leave > t_min && leave < t_max).then_some(Crossing {
                        t: leave,
                        part: leave_part,
                    })
                }
            }
        }
    }

    /// The outward normal at a point that [`Self::crossing`] found: [`Self::surface`] without its texture.
    pub fn normal(&self, point: &Point3<f64>, part: usize) -> Vector3<f64> {
        match self {
            Self::Sphere(sphere) => (point - sphere.center) / sphere.radius,
            Self::Ellipsoid(ellipsoid) => {
                let on_unit = ellipsoid.unit_from_world * (point - ellipsoid.center);
                (ellipsoid.unit_from_world.transpose() * on_unit).normalize()
            }
            Self::Frustum(frustum) => frustum.normal(point, part),
            Self::Disc(disc) => disc.normal,
            Self::Solid(solid) => solid.planes[part].0,
        }
    }

    /// The surface at a point that [`Self::crossing`] found.
    pub fn surface(&self, point: &Point3<f64>, part: usize) -> Surface {
        match self {
            Self::Sphere(sphere) => around(self.normal(point, part), sphere.radius),
            Self::Ellipsoid(ellipsoid) => {
                let on_unit = ellipsoid.unit_from_world * (point - ellipsoid.center);
                Surface {
                    normal: self.normal(point, part),
                    ..around(on_unit, ellipsoid.half.max())
                }
            }
            Self::Frustum(frustum) => frustum.surface(point, part),
            Self::Disc(disc) => {
                let offset = point - disc.center;
                Surface {
                    normal: disc.normal,
                    right: Vector3::x(),
                    u: offset.x,
                    v: offset.y,
                }
            }
            Self::Solid(solid) => {
                let offset = point - solid.origin;
                let [right, up] = &solid.axes[part];
                Surface {
                    normal: solid.planes[part].0,
                    right: *right,
                    u: offset.dot(right),
                    v: offset.dot(up),
                }
            }
        }
    }

    pub fn ball(&self) -> Ball {
        match self {
            Self::Sphere(sphere) => Ball {
                center: sphere.center,
                radius: sphere.radius,
            },
            Self::Frustum(frustum) => Ball {
                center: frustum.base + frustum.axis * (frustum.height * 0.5),
                radius: (frustum.height * 0.5).hypot(frustum.base_radius.max(frustum.top_radius)),
            },
            _ => {
                let bounds = self.bounds();
                Ball {
                    center: bounds.center(),
                    radius: bounds.half().norm(),
                }
            }
        }
    }

    pub fn bounds(&self) -> Bounds {
        let about = |center: Point3<f64>, half: Vector3<f64>| Bounds {
            min: center - half,
            max: center + half,
        };
        // Half the extent of a disc along each axis.
        let ring = |normal: &Vector3<f64>, radius: f64| {
            normal.map(|n| radius * (1.0 - n * n).max(0.0).sqrt())
        };
        match self {
            Self::Sphere(sphere) => about(sphere.center, Vector3::from_element(sphere.radius)),
            Self::Ellipsoid(ellipsoid) => about(ellipsoid.center, ellipsoid.half),
            Self::Frustum(frustum) => about(frustum.base, ring(&frustum.axis, frustum.base_radius))
                .joined(&about(
                    frustum.base + frustum.axis * frustum.height,
                    ring(&frustum.axis, frustum.top_radius),
                )),
            Self::Disc(disc) => about(disc.center, ring(&disc.normal, disc.radius)),
            Self::Solid(solid) => solid.bounds,
        }
    }
}

/// Longitude and latitude on a sphere, in metres at its equator.
fn around(normal: Vector3<f64>, radius: f64) -> Surface {
    let beside = normal.x.hypot(normal.y).max(1e-9);
    Surface {
        normal,
        right: Vector3::new(-normal.y, normal.x, 0.0) / beside,
        u: normal.y.atan2(normal.x) * radius,
        v: normal.z.clamp(-1.0, 1.0).asin() * radius,
    }
}

impl Frustum {
    fn crossing(&self, ray: &Ray, t_min: f64, t_max: f64) -> Option<Crossing> {
        let from_base = ray.origin - self.base;
        let height = from_base.dot(&self.axis);
        let climb = ray.direction.dot(&self.axis);
        let beside = from_base - self.axis * height;
        let across = ray.direction - self.axis * climb;
        // |beside + t across|^2 = (radius + t widening)^2
        let radius = self.base_radius + self.taper * height;
        let widening = self.taper * climb;
        let within = |t: f64| {
            let z = height + t * climb;
            (0.0..=self.height).contains(&z)
        };
        let (a, b, c) = (
            across.norm_squared() - widening * widening,
            beside.dot(&across) - radius * widening,
            beside.norm_squared() - radius * radius,
        );
        // Never within the whole cone, so within neither lid.
        if a > 0.0 && b * b < a * c {
            return None;
        }
        let side = first_root(a, b, c, t_min, t_max, within).map(|t| Crossing { t, part: 0 });
        let lid = |closed: bool, level: f64, lid_radius: f64, part: usize| {
            if !closed {
                return None;
            }
            let t = (level - height) / climb;
            (t > t_min
                && t < t_max
                && (beside + across * t).norm_squared() <= lid_radius * lid_radius)
                .then_some(Crossing { t, part })
        };
        [
            side,
            lid(self.closed_base, 0.0, self.base_radius, 1),
            lid(self.closed_top, self.height, self.top_radius, 2),
        ]
        .into_iter()
        .flatten()
        .min_by(|a, b| a.t.total_cmp(&b.t))
    }

    fn normal(&self, point: &Point3<f64>, part: usize) -> Vector3<f64> {
        match part {
            0 => {
                let offset = point - self.base;
                let outward = offset - self.axis * offset.dot(&self.axis);
                (outward / outward.norm() - self.axis * self.taper).normalize()
            }
            1 => -self.axis,
            _ => self.axis,
        }
    }

    fn surface(&self, point: &Point3<f64>, part: usize) -> Surface {
        let offset = point - self.base;
        let (x, y) = (offset.dot(&self.right), offset.dot(&self.forward));
        let normal = self.normal(point, part);
        let (right, u, v) = if part == 0 {
            (
                (self.forward * x - self.right * y) / x.hypot(y),
                y.atan2(x) * 0.5 * (self.base_radius + self.top_radius),
                offset.dot(&self.axis),
            )
        } else {
            (self.right, x, y)
        };
        Surface {
            normal,
            right,
            u,
            v,
        }
    }
}
