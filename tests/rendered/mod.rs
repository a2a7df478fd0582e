//! A room of boxes and a sphere whose image and depth follow from ray casting: exact truth for any rig.

use nalgebra::{Point3, Vector3};
use surprised::model::{camera::Intrinsics, pose::Pose};

/// A surface's texture is a function of the point in the world, so that all cameras agree on it.
#[derive(Clone, Copy)]
pub struct Texture {
    pub seed: u32,
    pub mean: f64,
    /// Grey levels from the mean to the extremes.
    pub contrast: f64,
    /// Metres from one value of the coarsest noise to the next.
    pub grain_m: f64,
}

#[derive(Clone, Copy)]
pub enum Shape {
    /// Opposite corners.
    Box([f64; 3], [f64; 3]),
    Sphere([f64; 3], f64),
}

pub struct Room {
    /// Shapes and textures; a box the camera is in is seen from inside.
    pub things: Vec<(Shape, Texture)>,
}

pub struct View {
    pub luminance: Vec<u8>,
    pub depth_m: Vec<f32>,
}

/// What a camera does to light.
#[derive(Clone, Copy)]
pub struct Sensor {
    pub gain: f64,
    pub offset: f64,
    /// Grey levels, standard deviation.
    pub noise: f64,
    pub seed: u32,
}

fn hash(mut value: u32) -> u32 {
    value = (value ^ (value >> 16)).wrapping_mul(0x7feb_352d);
    value = (value ^ (value >> 15)).wrapping_mul(0x846c_a68b);
    value ^ (value >> 16)
}

fn uniform(value: u32) -> f64 {
    f64::from(hash(value)) / f64::from(u32::MAX)
}

/// Smooth noise in -1..1.
fn noise(seed: u32, point: Vector3<f64>) -> f64 {
    let floor = point.map(f64::floor);
    let part = (point - floor).map(|t| t * t * (3.0 - 2.0 * t));
    let mut sum = 0.0;
    for corner in 0..8_u32 {
        let bit = |axis: usize| f64::from((corner >> axis) & 1);
        let weight: f64 = (0..3)
            .map(|axis| {
                if bit(axis) > 0.0 {
                    part[axis]
                } else {
                    1.0 - part[axis]
                }
            })
            .product();
        let cell = (0..3).fold(seed, |hashed, axis| {
            hash(hashed ^ ((floor[axis] + bit(axis)) as i32) as u32)
        });
        sum += weight * (2.0 * uniform(cell) - 1.0);
    }
    sum
}

impl Texture {
    fn at(&self, point: &Point3<f64>) -> f64 {
        let octaves: f64 = (0..4)
            .map(|octave| {
                let scale = f64::from(1 << octave);
                noise(
                    self.seed.wrapping_add(octave),
                    point.coords / self.grain_m * scale,
                ) / scale.sqrt()
            })
            .sum();
        self.mean + self.contrast * octaves.clamp(-1.0, 1.0)
    }
}

impl Shape {
    /// Distances along the ray in units of `direction`, the first in front of `origin`.
    fn hit(&self, origin: &Point3<f64>, direction: &Vector3<f64>) -> Option<f64> {
        const NEAREST: f64 = 1e-6;
        let (first, last) = match self {
            Self::Box(a, b) => {
                let mut range = (f64::NEG_INFINITY, f64::INFINITY);
                for axis in 0..3 {
                    let t =
                        [a[axis], b[axis]].map(|plane| (plane - origin[axis]) / direction[axis]);
                    range = (range.0.max(t[0].min(t[1])), range.1.min(t[0].max(t[1])));
                }
                (range.0 <= range.1).then_some(range)?
            }
            Self::Sphere(centre, radius) => {
                let to = origin - Point3::from(*centre);
                let (a, b) = (direction.norm_squared(), to.dot(direction));
                let root = (b * b - a * (to.norm_squared() - radius * radius)).sqrt();
                (!root.is_nan()).then_some(((-b - root) / a, (-b + root) / a))?
            }
        };
        [first, last].into_iter().find(|t| *t > NEAREST)
    }
}

impl Room {
    /// Walls 5 m away, a floor, boxes and a sphere between 2 and 4 m, one wall nearly without texture.
    pub fn furnished() -> Self {
        let texture = |seed, mean, contrast, grain_m| Texture {
            seed,
            mean,
            contrast,
            grain_m,
        };
        Self {
            things: vec![
                (
                    Shape::Box([-3.5, -2.5, -1.0], [3.0, 1.0, 5.0]),
                    texture(1, 120.0, 60.0, 0.3),
                ),
                (
                    Shape::Box([-1.6, -0.3, 3.2], [-0.7, 1.0, 3.9]),
                    texture(11, 80.0, 35.0, 0.15),
                ),
                (
                    Shape::Box([-0.2, 0.1, 2.5], [0.5, 1.0, 3.0]),
                    texture(21, 150.0, 50.0, 0.1),
                ),
                (
                    Shape::Box([1.0, -1.2, 3.5], [1.25, 1.0, 3.7]),
                    texture(31, 60.0, 25.0, 0.1),
                ),
                (
                    Shape::Box([-0.9, -0.9, 4.2], [0.6, -0.5, 4.98]),
                    texture(41, 170.0, 8.0, 0.2),
                ),
                (
                    Shape::Sphere([0.75, 0.55, 2.3], 0.25),
                    texture(51, 100.0, 45.0, 0.1),
                ),
                (
                    Shape::Sphere([-0.6, 0.55, 2.2], 0.15),
                    texture(61, 190.0, 40.0, 0.06),
                ),
            ],
        }
    }

    /// The nearest thing on a pixel's ray: depth along the optical axis, metres, and reflected light.
    fn look(&self, camera: &Intrinsics, world_from_camera: &Pose, u: f64, v: f64) -> (f64, f64) {
        let origin = world_from_camera * Point3::origin();
        // Its optical axis component is 1, so distances along it are depths.
        let direction = world_from_camera * camera.unproject(u, v, 1.0).coords;
        let hits = self
            .things
            .iter()
            .filter_map(|(shape, texture)| Some((shape.hit(&origin, &direction)?, texture)));
        let (depth_m, texture) = hits
            .min_by(|a, b| a.0.total_cmp(&b.0))
            .expect("the room has walls");
        (depth_m, texture.at(&(origin + direction * depth_m)))
    }

    /// Mean light of 3x3 rays a pixel; the depth is that of its centre.
    pub fn render(&self, camera: &Intrinsics, world_from_camera: &Pose, sensor: Sensor) -> View {
        let pixels = camera.width * camera.height;
        let mut view = View {
            luminance: Vec::with_capacity(pixels),
            depth_m: Vec::with_capacity(pixels),
        };
        for index in 0..pixels {
            let (x, y) = ((index % camera.width) as f64, (index / camera.width) as f64);
            let mut light = 0.0;
            for ray in 0..9 {
                let (du, dv) = (f64::from(ray % 3 - 1) / 3.0, f64::from(ray / 3 - 1) / 3.0);
                light += self.look(camera, world_from_camera, x + du, y + dv).1 / 9.0;
            }
            // Twelve uniforms have the variance of one normal.
            let random = |part| uniform(hash(sensor.seed) ^ (index as u32 * 12 + part)) - 0.5;
            let noise = sensor.noise * (0..12).map(random).sum::<f64>();
            let value = light * sensor.gain + sensor.offset + noise;
            view.luminance.push(value.round().clamp(0.0, 255.0) as u8);
            view.depth_m
                .push(self.look(camera, world_from_camera, x, y).0 as f32);
        }
        view
    }
}
