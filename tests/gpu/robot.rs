//! A robot that looks at a wall from a few places, and what two such robots must agree about.

use nalgebra::{Point3, Vector3};
use surprised::{
    config::Settings,
    engine::Engines,
    model::{frame::FrameError, report::Report},
    pipeline::Pipeline,
};

use super::reference::scene::{Panel, Scene, Texture, camera, pose};

pub const PIXELS: u64 = 165 * 123;

/// A wall with a pattern, and a box that may stand before it.
pub fn place(with_box: bool) -> Scene {
    let texture = |base: f64| -> Texture {
        Box::new(move |a, b| {
            let wave =
                30.0 * (9.0 * a).sin() * (7.0 * b).cos() + 15.0 * (31.0 * a + 17.0 * b).sin();
            [base + wave, 10.0 * a, -12.0 * b]
        })
    };
    let panel = |x: f64, z: f64, half: f64, base: f64| Panel {
        center: Point3::new(x, 0.05, z),
        right: Vector3::x(),
        down: Vector3::y(),
        half_size_m: (half, half),
        texture: texture(base),
    };
    let mut scene = Scene {
        panels: vec![panel(0.0, 2.0, 4.0, 120.0)],
    };
    if with_box {
        scene.panels.push(panel(0.1, 1.7, 0.22, 205.0));
    }
    scene
}

pub struct Robot {
    pub pipeline: Pipeline,
    sequence: u64,
}

impl Robot {
    pub fn new(engines: &Engines) -> Self {
        Self {
            pipeline: Pipeline::on(engines, Settings::robust()),
            sequence: 0,
        }
    }

    pub fn see(&mut self, scene: &Scene, step: usize) -> Report {
        self.try_see(scene, step).expect("the frame is good")
    }

    pub fn try_see(&mut self, scene: &Scene, step: usize) -> Result<Report, FrameError> {
        self.sequence += 1;
        let world_from_camera = pose(
            // No whole number of steps is as far as views are looked for.
            [0.033 * step as f64, 0.0, 0.0],
            [0.0, -0.01 * step as f64, 0.0],
        );
        let frame = scene.frame(&camera(165, 123), &world_from_camera, self.sequence);
        self.pipeline.process(&frame)
    }
}

/// Reports of one frame by two engines; returns how many regions were found.
pub fn assert_same_report(got: &Report, expected: &Report) -> usize {
    // Refined poses differ by up to a fiftieth of a pixel, and what is learnt follows them from frame to frame.
    let tolerance = 0.05 * expected.max_surprise.max(0.5);
    assert!(
        (got.max_surprise - expected.max_surprise).abs() <= tolerance,
        "{} instead of {}",
        got.max_surprise,
        expected.max_surprise
    );
    let mean_tolerance = 0.05 * expected.mean_surprise.max(0.5);
    assert!((got.mean_surprise - expected.mean_surprise).abs() <= mean_tolerance);
    assert!((got.coverage - expected.coverage).abs() < 0.005);
    // Views lie in equal steps, so the last digits of the refined pose say which of two is nearer.
    let sorted = |report: &Report| {
        let mut ids = report.viewpoints_used.clone();
        ids.sort_unstable();
        ids
    };
    assert_eq!(sorted(got), sorted(expected));
    assert_eq!(got.regions.len(), expected.regions.len());
    for (got, expected) in got.regions.iter().zip(&expected.regions) {
        assert!(got.pixel_box.iou(&expected.pixel_box) > 0.9);
    }
    got.regions.len()
}
