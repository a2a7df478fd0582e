//! What may hide a light from a place: bounding balls, many at once.

use nalgebra::{Point3, Vector3};

use super::shapes::Ball;
use crate::{
    isa::{Isa, for_each_isa},
    lanes::{LANES, Lanes, bits, members},
};

/// More than places and lengths in a room are wrong in single precision, metres.
const SLACK_M: f32 = 1e-4;

/// Balls around the primitives that may hide one kind of light.
#[derive(Debug, Clone, Default)]
pub struct Casters {
    balls: Vec<Balls>,
    primitives: Vec<u32>,
}

/// x, y, z and radius, metres. Those that are none have a radius that nothing is within.
type Balls = [Lanes; 4];
const NONE: Balls = [
    [0.0; LANES],
    [0.0; LANES],
    [0.0; LANES],
    [f32::NEG_INFINITY; LANES],
];

/// From all points of a ball to all of a lamp.
pub struct Beam {
    pub from: Point3<f64>,
    pub from_radius: f64,
    /// Of unit length, towards the lamp's middle.
    pub direction: Vector3<f64>,
    pub length: f64,
    pub lamp_radius: f64,
}

for_each_isa! {
    fn in_beam(casters: &Casters, beam: &Beam, found: &mut Vec<u32>) = in_beam_kernel;
}

for_each_isa! {
    fn near(casters: &Casters, place: &Ball, found: &mut Vec<u32>) = near_kernel;
}

#[inline(always)]
fn single(vector: &Vector3<f64>) -> [f32; 3] {
    [vector.x as f32, vector.y as f32, vector.z as f32]
}

#[inline(always)]
fn in_beam_kernel(casters: &Casters, beam: &Beam, found: &mut Vec<u32>) {
    let from = single(&beam.from.coords);
    let direction = single(&beam.direction);
    let spare = beam.from_radius as f32 + SLACK_M;
    let (per_metre, lamp) = (1.0 / beam.length as f32, beam.lamp_radius as f32);
    casters.select(found, |[x, y, z, radius], lane| {
        let offset = [x[lane] - from[0], y[lane] - from[1], z[lane] - from[2]];
        let along = offset[0] * direction[0] + offset[1] * direction[1] + offset[2] * direction[2];
        let square = offset[0] * offset[0] + offset[1] * offset[1] + offset[2] * offset[2];
        let grown = radius[lane] + spare;
        let end = along + grown;
        // The beam is no wider there than at the ball's far end.
        let share = end * per_metre;
        let reach = grown + lamp * if share < 1.0 { share } else { 1.0 };
        (end > 0.0) & (square - along * along < reach * reach)
    });
}

#[inline(always)]
fn near_kernel(casters: &Casters, place: &Ball, found: &mut Vec<u32>) {
    let center = single(&place.center.coords);
    let spare = place.radius as f32 + SLACK_M;
    casters.select(found, |[x, y, z, radius], lane| {
        let offset = [
            x[lane] - center[0],
            y[lane] - center[1],
            z[lane] - center[2],
        ];
        let square = offset[0] * offset[0] + offset[1] * offset[1] + offset[2] * offset[2];
        let reach = radius[lane] + spare;
        (reach > 0.0) & (square < reach * reach)
    });
}

impl Casters {
    pub fn new(casters: impl Iterator<Item = (u32, Ball)>) -> Self {
        let mut own = Self::default();
        for (primitive, ball) in casters {
            let lane = own.primitives.len() % LANES;
            own.primitives.push(primitive);
            if lane == 0 {
                own.balls.push(NONE);
            }
            if let Some([x, y, z, radius]) = own.balls.last_mut() {
                (x[lane], y[lane], z[lane]) = (
                    ball.center.x as f32,
                    ball.center.y as f32,
                    ball.center.z as f32,
                );
                radius[lane] = ball.radius as f32;
            }
        }
        own
    }

    #[inline(always)]
    fn select(&self, found: &mut Vec<u32>, holds: impl Fn(&Balls, usize) -> bool) {
        found.clear();
        for (index, balls) in self.balls.iter().enumerate() {
            for lane in members(bits(|lane| holds(balls, lane))) {
                found.push(self.primitives[index * LANES + lane]);
            }
        }
    }

    /// Finds the primitives whose balls reach into a beam.
    pub fn in_beam(&self, isa: Isa, beam: &Beam, found: &mut Vec<u32>) {
        in_beam(isa, self, beam, found);
    }

    /// Finds the primitives whose balls reach into another.
    pub fn near(&self, isa: Isa, place: &Ball, found: &mut Vec<u32>) {
        near(isa, self, place, found);
    }
}
