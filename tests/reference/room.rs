//! A room with enough to see everywhere that a pose can be told from it.

use nalgebra::{Point3, Vector3};

use super::{
    Random,
    scene::{Panel, Scene, Texture, pose},
};

/// Many waves of 4 to 60 cm in all directions, as a table full of things has.
fn texture(seed: u64) -> Texture {
    let mut random = Random(seed);
    let waves: Vec<[f64; 4]> = (0..10)
        .map(|_| {
            let wavelength_m = random.log_uniform(0.06, 0.8);
            let direction = random.uniform(0.0, std::f64::consts::TAU);
            let k = std::f64::consts::TAU / wavelength_m;
            let phase = random.uniform(0.0, std::f64::consts::TAU);
            [
                k * direction.cos(),
                k * direction.sin(),
                phase,
                random.uniform(6.0, 18.0),
            ]
        })
        .collect();
    Box::new(move |a, b| {
        let y: f64 = waves
            .iter()
            .map(|[ka, kb, phase, size]| size * (ka * a + kb * b + phase).sin())
            .sum();
        [(125.0 + y).clamp(5.0, 235.0), 0.0, 0.0]
    })
}

pub fn panel(
    seed: u64,
    center: [f64; 3],
    yaw_rad: f64,
    tilt_rad: f64,
    half_size_m: (f64, f64),
) -> Panel {
    let turn = pose([0.0; 3], [0.0, yaw_rad, 0.0]).rotation
        * pose([0.0; 3], [tilt_rad, 0.0, 0.0]).rotation;
    Panel {
        center: Point3::from(Vector3::from(center)),
        right: turn * Vector3::x(),
        down: turn * Vector3::y(),
        half_size_m,
        texture: texture(seed),
    }
}

/// A table before a wall, with three things on it.
pub fn room() -> Scene {
    Scene {
        panels: vec![
            panel(1, [0.0, -0.5, 2.4], 0.15, 0.0, (3.0, 2.0)),
            panel(2, [0.0, 0.35, 1.5], 0.0, -1.1, (2.0, 1.2)),
            panel(3, [-0.3, 0.1, 1.3], 0.4, 0.0, (0.12, 0.16)),
            panel(4, [0.25, 0.05, 1.5], -0.3, 0.0, (0.15, 0.2)),
            panel(5, [0.05, 0.25, 1.1], 0.1, -0.3, (0.08, 0.08)),
        ],
    }
}
