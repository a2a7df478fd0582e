//! Looks at a made-up place: a wall two metres ahead of the origin, seen by cameras that may stand anywhere.
#![allow(
    dead_code,
    reason = "each test file is a crate of its own and uses a part of this"
)]

use nalgebra::{Point3, Translation3, UnitQuaternion, Vector3};
use surprised::{
    config::Settings,
    model::{
        camera::Intrinsics,
        event::Event,
        frame::{RgbImage, Source},
        pose::Pose,
        report::{PixelBox, Region},
    },
    stages::{
        attend::{BLOCK, BlockMap, Scene},
        events::{Events, Look},
        interpolate::prior::{COVERAGE, Prior, TAU},
    },
};

pub const WIDTH: usize = 160;
pub const HEIGHT: usize = 120;
pub const WALL_M: f64 = 2.0;

pub const INTRINSICS: Intrinsics = Intrinsics {
    width: WIDTH,
    height: HEIGHT,
    fx: 150.0,
    fy: 150.0,
    cx: 79.5,
    cy: 59.5,
};

pub fn source(robot: &str) -> Source {
    Source {
        robot: robot.into(),
        camera: "front".into(),
    }
}

pub fn at(x: f64, y: f64, z: f64) -> Pose {
    Pose::from_parts(Translation3::new(x, y, z), UnitQuaternion::identity())
}

/// At `position`, turned about the vertical axis so that it looks along `(sin, 0, cos)` of the angle.
pub fn turned(position: [f64; 3], angle_rad: f64) -> Pose {
    Pose::from_parts(
        Translation3::from(Vector3::from(position)),
        UnitQuaternion::from_axis_angle(&Vector3::y_axis(), angle_rad),
    )
}

/// Of everything that is expected.
const GREY: u8 = 90;

/// What a camera sees in one frame.
#[derive(Clone)]
pub struct View {
    pub source: Source,
    pub world_from_camera: Pose,
    pub depth_m: Vec<f32>,
    pub evidence: BlockMap,
    pub prior: Prior,
    pub image: RgbImage,
}

impl View {
    /// Everything as expected, `z_m` away.
    pub fn calm(robot: &str, world_from_camera: Pose, z_m: f64) -> Self {
        let mut prior = Prior::default();
        prior.resize(WIDTH, HEIGHT);
        prior.data.fill(0.0);
        for row in prior.data.chunks_exact_mut(16 * WIDTH) {
            row[TAU * WIDTH..][..WIDTH].fill(f32::from(GREY));
            row[COVERAGE * WIDTH..][..WIDTH].fill(7.0);
        }
        Self {
            image: RgbImage {
                width: WIDTH,
                height: HEIGHT,
                data: vec![GREY; WIDTH * HEIGHT * 3],
            },
            source: source(robot),
            world_from_camera,
            depth_m: vec![z_m as f32; WIDTH * HEIGHT],
            evidence: BlockMap {
                width: WIDTH / BLOCK,
                height: HEIGHT / BLOCK,
                data: vec![0.1; WIDTH / BLOCK * HEIGHT / BLOCK],
            },
            prior,
        }
    }

    /// Something stands before everything.
    pub fn hidden_by(mut self, z_m: f32) -> Self {
        self.depth_m.fill(z_m);
        self
    }

    /// No viewpoint knows these pixels.
    pub fn unseen(mut self, pixel_box: PixelBox) -> Self {
        for y in pixel_box.y_min as usize..pixel_box.y_max as usize {
            for x in pixel_box.x_min as usize..pixel_box.x_max as usize {
                self.prior.data[(y * 16 + COVERAGE) * WIDTH + x] = 0.0;
            }
        }
        self
    }

    /// Something bright is where the region is; with evidence for it if it is not yet expected.
    pub fn showing(mut self, region: &Region, surprising: bool) -> Self {
        let PixelBox {
            x_min,
            y_min,
            x_max,
            y_max,
        } = region.pixel_box;
        for y in y_min as usize..y_max as usize {
            for x in x_min as usize..x_max as usize {
                self.image.data[3 * (y * WIDTH + x)..][..3].fill(200);
                if surprising {
                    let block = y / BLOCK * self.evidence.width + x / BLOCK;
                    self.evidence.data[block] = region.peak_surprise;
                }
            }
        }
        self
    }

    /// A square of `half_m` around a point in the world is surprising, by `surprise`.
    pub fn region(&self, id: u64, center: Point3<f64>, half_m: f64, surprise: f32) -> Region {
        let in_camera = self.world_from_camera.inverse_transform_point(&center);
        let (u, v) = INTRINSICS.project(&in_camera).expect("before the camera");
        let half_px = half_m * INTRINSICS.fx / in_camera.z;
        let clamp = |at: f64, most: usize| at.round().clamp(0.0, most as f64) as u32;
        Region {
            id,
            pixel_box: PixelBox {
                x_min: clamp(u - half_px, WIDTH),
                y_min: clamp(v - half_px, HEIGHT),
                x_max: clamp(u + half_px, WIDTH),
                y_max: clamp(v + half_px, HEIGHT),
            },
            peak_x: clamp(u, WIDTH - 1),
            peak_y: clamp(v, HEIGHT - 1),
            peak_surprise: surprise,
            mean_surprise: surprise / 2.0,
            area: (4.0 * half_px * half_px) as u32,
            center_in_world: Some(center),
            touches_border: false,
            event_id: 0,
        }
    }
}

/// A place and its stamps: ten frames a second.
#[derive(Default)]
pub struct Place {
    pub events: Events,
    pub frames: u64,
}

impl Place {
    pub fn stamp_ns(&self) -> i64 {
        1_700_000_000_000_000_000 + 100_000_000 * self.frames as i64
    }

    pub fn see(&mut self, view: &View, regions: &mut [Region]) -> Vec<Event> {
        self.frames += 1;
        let unseen = view.prior.plane(COVERAGE).filter(|&views| views == 0.0);
        let look = Look {
            source: &view.source,
            stamp_ns: self.stamp_ns(),
            sequence: self.frames,
            image: &view.image,
            scene: Scene {
                depth_m: &view.depth_m,
                intrinsics: &INTRINSICS,
                world_from_camera: &view.world_from_camera,
            },
            evidence: &view.evidence,
            unseen_share: unseen.count() as f32 / (WIDTH * HEIGHT) as f32,
            prior: &|| &view.prior,
        };
        self.events.observe(&look, regions, &Settings::robust())
    }

    /// A view in which nothing is surprising.
    pub fn calm(&mut self, view: &View) -> Vec<Event> {
        self.see(view, &mut [])
    }
}
