//! Worlds of flat panels, looked at by casting rays: depth and colour are exact.

use std::sync::Arc;

use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
use surprised::model::{
    belief::{Belief, CHANNELS, Record, rgb_from_ycbcr},
    camera::Intrinsics,
    frame::{DepthSource, Frame, RgbImage, Source},
    pose::Pose,
    viewpoint::{Coarse, Mesh, Viewpoint},
};

/// Y, Cb, Cr at a place on a panel, metres from its centre.
pub type Texture = Box<dyn Fn(f64, f64) -> [f64; CHANNELS]>;

/// A rectangle; `right` and `down` are unit vectors as seen from its front.
pub struct Panel {
    pub center: Point3<f64>,
    pub right: Vector3<f64>,
    pub down: Vector3<f64>,
    pub half_size_m: (f64, f64),
    pub texture: Texture,
}

/// What a ray meets.
#[derive(Debug, Clone, Copy)]
pub struct Hit {
    pub panel: usize,
    pub depth_m: f64,
    pub point_in_world: Point3<f64>,
    pub colour: [f64; CHANNELS],
}

#[derive(Default)]
pub struct Scene {
    pub panels: Vec<Panel>,
}

pub struct Picture {
    pub depth_m: Vec<f32>,
    pub colour: Vec<[f64; CHANNELS]>,
    /// Index of the panel; `None` where there is nothing.
    pub panel: Vec<Option<usize>>,
}

impl Scene {
    /// What lies behind pixel `(u, v)`, nearest first.
    pub fn hits(&self, camera: &Intrinsics, world_from_camera: &Pose, u: f64, v: f64) -> Vec<Hit> {
        let ray = world_from_camera.rotation * camera.unproject(u, v, 1.0).coords;
        let start = Point3::from(world_from_camera.translation.vector);
        let mut hits: Vec<Hit> = Vec::new();
        for (index, panel) in self.panels.iter().enumerate() {
            let normal = panel.right.cross(&panel.down);
            // The ray's third coordinate in the camera is 1, so its length is the depth.
            let depth_m = (panel.center - start).dot(&normal) / ray.dot(&normal);
            let point_in_world = start + ray * depth_m;
            let (a, b) = (
                (point_in_world - panel.center).dot(&panel.right),
                (point_in_world - panel.center).dot(&panel.down),
            );
            let inside = a.abs() <= panel.half_size_m.0 && b.abs() <= panel.half_size_m.1;
            if depth_m > 0.0 && inside {
                hits.push(Hit {
                    panel: index,
                    depth_m,
                    point_in_world,
                    colour: (panel.texture)(a, b),
                });
            }
        }
        hits.sort_by(|a, b| a.depth_m.total_cmp(&b.depth_m));
        hits
    }

    pub fn picture(&self, camera: &Intrinsics, world_from_camera: &Pose) -> Picture {
        let mut picture = Picture {
            depth_m: Vec::new(),
            colour: Vec::new(),
            panel: Vec::new(),
        };
        for v in 0..camera.height {
            for u in 0..camera.width {
                let hits = self.hits(camera, world_from_camera, u as f64, v as f64);
                let hit = hits.first();
                picture
                    .depth_m
                    .push(hit.map_or(0.0, |hit| hit.depth_m as f32));
                picture
                    .colour
                    .push(hit.map_or([0.0; CHANNELS], |hit| hit.colour));
                picture.panel.push(hit.map(|hit| hit.panel));
            }
        }
        picture
    }

    /// A viewpoint that has settled on what it sees.
    pub fn viewpoint(&self, camera: &Intrinsics, world_from_camera: &Pose) -> Viewpoint {
        let picture = self.picture(camera, world_from_camera);
        let records = picture
            .colour
            .iter()
            .map(|colour| Record::pack(&settled(colour.map(|value| value as f32))))
            .collect();
        viewpoint(*camera, world_from_camera, picture.depth_m, records)
    }

    pub fn frame(&self, camera: &Intrinsics, world_from_camera: &Pose, sequence: u64) -> Frame {
        let picture = self.picture(camera, world_from_camera);
        let rgb = |colour: &[f64; CHANNELS]| rgb_from_ycbcr(colour.map(|value| value as f32));
        Frame {
            source: source(),
            stamp_ns: sequence as i64 * 100_000_000,
            sequence,
            image: RgbImage {
                width: camera.width,
                height: camera.height,
                data: picture.colour.iter().flat_map(rgb).collect(),
            },
            depth: DepthSource::Given(picture.depth_m),
            intrinsics: *camera,
            world_from_camera: *world_from_camera,
            pose_noise: None,
        }
    }
}

pub fn settled(tau: [f32; CHANNELS]) -> Belief {
    Belief {
        alpha: 2.5,
        beta: [25.0; CHANNELS],
        tau,
        sigma: [0.1; CHANNELS],
        tau2: [0.0; CHANNELS],
        p2: 0.0,
    }
}

pub fn source() -> Source {
    Source {
        robot: Arc::from("robot"),
        camera: Arc::from("front"),
    }
}

pub fn viewpoint(
    camera: Intrinsics,
    world_from_camera: &Pose,
    depth_m: Vec<f32>,
    records: Vec<Record>,
) -> Viewpoint {
    let mesh = Mesh::new(camera, depth_m, 0.05);
    Viewpoint {
        id: 0,
        world_from_camera: *world_from_camera,
        world_from_home: *world_from_camera,
        coarse: Coarse::new(&mesh, &records, 0.05),
        mesh,
        records,
        source: source(),
        stamp_ns: 0,
        updates: 1,
    }
}

/// A camera of the given size that sees 53 degrees in x.
pub fn camera(width: usize, height: usize) -> Intrinsics {
    Intrinsics {
        width,
        height,
        fx: width as f64,
        fy: width as f64,
        cx: (width as f64 - 1.0) / 2.0,
        cy: (height as f64 - 1.0) / 2.0,
    }
}

/// Position, metres, and rotation vector, radians.
pub fn pose(position_m: [f64; 3], rotation_rad: [f64; 3]) -> Pose {
    Isometry3::from_parts(
        Translation3::from(Vector3::from(position_m)),
        UnitQuaternion::from_scaled_axis(Vector3::from(rotation_rad)),
    )
}
