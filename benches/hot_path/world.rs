//! A table with five boxes before two walls, seen by a camera that moves by 2 to 20 cm: what is timed.

use nalgebra::{Point3, Vector3};
use surprised::model::{
    camera::Intrinsics,
    frame::{DepthSource, Frame},
    pose::{Pose, PoseNoise},
};

use crate::reference::{
    Random,
    scene::{Panel, Scene, camera, pose},
};

pub struct World {
    camera: Intrinsics,
    scene: Scene,
}

/// Standard deviation of the sensor, grey levels.
const IMAGE_SD: f64 = 1.5;
/// Standard deviation of noisy inverse depth, 1/m.
const INVERSE_DEPTH_SD: f64 = 0.001;

impl World {
    pub fn new(width: usize, height: usize) -> Self {
        let mut panels = vec![
            // The table, the wall behind it, one at its side.
            panel(
                [0.0, 0.45, 1.6],
                [1.0, 0.0, 0.0],
                [0.0, 0.35, -0.94],
                (2.5, 1.4),
                0.0,
            ),
            panel(
                [0.0, -0.5, 3.0],
                [1.0, 0.0, 0.0],
                [0.0, 1.0, 0.0],
                (4.0, 2.5),
                1.0,
            ),
            panel(
                [-1.3, -0.3, 2.2],
                [0.6, 0.0, 0.8],
                [0.0, 1.0, 0.0],
                (1.2, 1.5),
                2.0,
            ),
        ];
        for (index, [x, y, z]) in [
            [-0.45, 0.2, 1.3],
            [-0.15, 0.1, 1.6],
            [0.2, 0.25, 1.2],
            [0.5, 0.1, 1.7],
            [0.35, -0.1, 2.2],
        ]
        .into_iter()
        .enumerate()
        {
            let turn = 0.3 * index as f64 - 0.5;
            let right = [turn.cos(), 0.0, turn.sin()];
            let side = [-turn.sin(), 0.0, turn.cos()];
            let seed = 3.0 + index as f64;
            panels.push(panel([x, y, z], right, [0.0, 1.0, 0.0], (0.1, 0.14), seed));
            let side_x = x + if turn > 0.0 { -0.1 } else { 0.1 } * turn.cos();
            let side_z = z + 0.06;
            panels.push(panel(
                [side_x, y, side_z],
                if turn > 0.0 { side.map(|s| -s) } else { side },
                [0.0, 1.0, 0.0],
                (0.06, 0.14),
                seed + 0.5,
            ));
        }
        Self {
            camera: camera(width, height),
            scene: Scene { panels },
        }
    }

    /// Frames from poses around the origin, the last one in their middle.
    pub fn frames(&self, count: usize, noisy_depth: bool) -> Vec<Frame> {
        let mut random = Random(1);
        (0..count)
            .map(|index| {
                let at = if index + 1 == count {
                    pose([0.005, -0.003, 0.004], [0.002, 0.003, -0.004])
                } else {
                    self.pose(index, &mut random)
                };
                let mut frame = self.scene.frame(&self.camera, &at, index as u64);
                for value in &mut frame.image.data {
                    let noise = IMAGE_SD * random.normal();
                    *value = (f64::from(*value) + noise).round().clamp(0.0, 255.0) as u8;
                }
                if let (true, DepthSource::Given(depth_m)) = (noisy_depth, &mut frame.depth) {
                    for z in depth_m {
                        if *z > 0.0 {
                            let noise = INVERSE_DEPTH_SD * random.normal();
                            *z = (1.0 / (1.0 / f64::from(*z) + noise)) as f32;
                        }
                    }
                }
                frame.pose_noise = Some(PoseNoise {
                    position_m: 0.002,
                    rotation_rad: 0.2f64.to_radians(),
                });
                frame
            })
            .collect()
    }

    fn pose(&self, index: usize, random: &mut Random) -> Pose {
        let distance = 0.02 + 0.18 * (index % 7) as f64 / 6.0;
        let angle = index as f64 * 2.4;
        pose(
            [
                distance * angle.cos(),
                0.5 * distance * angle.sin(),
                random.uniform(-0.05, 0.05),
            ],
            std::array::from_fn(|_| random.uniform(-0.04, 0.04)),
        )
    }
}

fn panel(
    center: [f64; 3],
    right: [f64; 3],
    down: [f64; 3],
    half_size_m: (f64, f64),
    seed: f64,
) -> Panel {
    Panel {
        center: Point3::from(center),
        right: Vector3::from(right).normalize(),
        down: Vector3::from(down).normalize(),
        half_size_m,
        texture: Box::new(move |a, b| {
            let wave = |frequency: f64, phase: f64| {
                ((a * frequency + phase).sin() + (b * frequency * 0.9 + 2.0 * phase).sin()) / 2.0
            };
            let s = seed * 1.7;
            [
                125.0
                    + 35.0 * wave(9.0, s)
                    + 25.0 * wave(31.0, s + 1.0)
                    + 15.0 * wave(83.0, s + 2.0),
                18.0 * wave(5.0, s + 3.0) + 8.0 * wave(23.0, s),
                18.0 * wave(6.0, s + 4.0) + 8.0 * wave(27.0, s + 1.0),
            ]
        }),
    }
}
