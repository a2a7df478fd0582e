//! What is handed over to the shaders, field by field as in `shaders/layout.wgsl`. A test compares the offsets.

use bytemuck::{Pod, Zeroable};

use crate::{
    config::{Settings, UnseenStart},
    model::{
        camera::Intrinsics,
        pose::{Pose, PoseNoise},
        viewpoint::Mesh,
    },
    stages::{
        attend::BLOCK,
        interpolate::reach::homography,
        refine::{LEVELS_MAX, discount, precision},
        surprise::GammaTerm,
        update::UpdateRules,
    },
};

/// The image that is recalled or scored, pixels.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Frame {
    pub width: u32,
    pub height: u32,
    pub view_count: u32,
    /// Whole blocks of the evidence map.
    pub blocks_wide: u32,
    pub blocks_high: u32,
}

impl Frame {
    pub fn new(width: usize, height: usize, view_count: usize) -> Self {
        Self {
            width: width as u32,
            height: height as u32,
            view_count: view_count as u32,
            blocks_wide: (width / BLOCK) as u32,
            blocks_high: (height / BLOCK) as u32,
        }
    }

    pub fn pixels(&self) -> u64 {
        u64::from(self.width) * u64::from(self.height)
    }

    pub fn blocks(&self) -> u64 {
        u64::from(self.blocks_wide) * u64::from(self.blocks_high)
    }
}

/// A viewpoint to recall from. A vertex `(column, row)` of depth z lands at `z * (H * (column, row, 1)) + h`,
/// homogeneous target pixels; a row of H and h is `[H0, H1, H2, h]`.
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub struct View {
    pub h_x: [f32; 4],
    pub h_y: [f32; 4],
    pub h_z: [f32; 4],
    pub width: u32,
    pub height: u32,
    /// Its first pixel in the arenas.
    pub first: u32,
    pub fresh: u32,
    /// In votes and means.
    pub weight: f32,
    _padding: [u32; 3],
}

impl View {
    /// `mesh` is the viewpoint's, or its coarse one's.
    pub fn new(
        mesh: &Mesh,
        world_from_view: &Pose,
        intrinsics: &Intrinsics,
        world_from_camera: &Pose,
        first: u32,
        weight: f32,
        fresh: bool,
    ) -> Self {
        let (h_matrix, h_offset) = homography(mesh, world_from_view, intrinsics, world_from_camera);
        let row = |axis: usize| {
            [
                h_matrix[(axis, 0)] as f32,
                h_matrix[(axis, 1)] as f32,
                h_matrix[(axis, 2)] as f32,
                h_offset[axis] as f32,
            ]
        };
        Self {
            h_x: row(0),
            h_y: row(1),
            h_z: row(2),
            width: mesh.intrinsics.width as u32,
            height: mesh.intrinsics.height as u32,
            first,
            fresh: u32::from(fresh),
            weight,
            _padding: [0; 3],
        }
    }
}

/// What the settings say; switches are 0 or 1.
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub struct Rules {
    pub forgetting: f32,
    pub xi: f32,
    pub sigma_min: f32,
    pub sigma_max: f32,
    pub unseen_variance: f32,
    /// Squared pixel error at edges; 0 = edges are not widened.
    pub edge_variance_px: f32,
    pub surprise_threshold: f32,
    pub depth_vote_tolerance: f32,
    pub gamma_center: f32,
    pub gamma_scale: f32,
    pub second_look: u32,
    pub starts_at_observation: u32,
    pub depth_vote: u32,
    pub colour_vote: u32,
    pub view_variance: u32,
    pub earlier_appearance: u32,
    pub exposure_gain: u32,
    _padding: [u32; 3],
    /// Lowest power first, padded with zeros.
    pub gamma_coefficients: [[f32; 4]; 4],
}

impl Rules {
    pub fn new(settings: &Settings) -> Self {
        let gamma = GammaTerm::new(&UpdateRules::new(settings));
        let mut gamma_coefficients = [[0.0; 4]; 4];
        for (power, coefficient) in gamma.coefficients.into_iter().enumerate() {
            gamma_coefficients[power / 4][power % 4] = coefficient;
        }
        Self {
            forgetting: settings.forgetting,
            xi: settings.xi,
            sigma_min: settings.sigma_min,
            sigma_max: settings.sigma_max,
            unseen_variance: settings.unseen_variance,
            edge_variance_px: settings.edge_error_px * settings.edge_error_px,
            surprise_threshold: settings.surprise_threshold,
            depth_vote_tolerance: settings.depth_vote_tolerance,
            gamma_center: gamma.center,
            gamma_scale: gamma.scale,
            second_look: settings.second_look.into(),
            starts_at_observation: (settings.unseen_start == UnseenStart::Observation).into(),
            depth_vote: settings.depth_vote.into(),
            colour_vote: settings.colour_vote.into(),
            view_variance: settings.view_variance.into(),
            earlier_appearance: settings.earlier_appearance.into(),
            exposure_gain: settings.exposure_gain.into(),
            _padding: [0; 3],
            gamma_coefficients,
        }
    }
}

/// What the exposure pass found out.
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub struct Exposure {
    pub gain: f32,
    pub inverse_gain: f32,
    /// Pixels that some viewpoint saw.
    pub seen: u32,
}

/// A level of the pyramid that refinement looks at, and what holds for all of them. Level 0 is half the image.
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub struct Level {
    pub focal: [f32; 2],
    pub center: [f32; 2],
    /// Inverse variances of translation, rotation, gain and offset, as the noise of the pose says.
    pub certainty: [[f32; 4]; 2],
    pub width: u32,
    pub height: u32,
    /// Its first pixel in the pyramid.
    pub first: u32,
    pub index: u32,
    /// Of the level before.
    pub finer_width: u32,
    pub finer_first: u32,
    pub image_width: u32,
    /// Correlated pixels count less.
    pub inverse_discount: f32,
    /// Of the image, pixels.
    pub image_focal: [f32; 2],
    pub image_center: [f32; 2],
    pub position_sd_m: f32,
    pub rotation_sd_rad: f32,
    _padding: [u32; 2],
}

impl Level {
    pub fn pixels(&self) -> u64 {
        u64::from(self.width) * u64::from(self.height)
    }

    pub fn pyramid(intrinsics: &Intrinsics, noise: PoseNoise) -> [Self; LEVELS_MAX] {
        let precision = precision(noise).map(|precision| precision as f32);
        let mut camera = intrinsics.half();
        let (mut first, mut finer_width, mut finer_first) = (0, 0, 0);
        std::array::from_fn(|index| {
            let level = Self {
                focal: [camera.fx as f32, camera.fy as f32],
                center: [camera.cx as f32, camera.cy as f32],
                certainty: [
                    std::array::from_fn(|axis| precision[axis]),
                    std::array::from_fn(|axis| precision[4 + axis]),
                ],
                width: camera.width as u32,
                height: camera.height as u32,
                first,
                index: index as u32,
                finer_width,
                finer_first,
                image_width: intrinsics.width as u32,
                inverse_discount: (1.0 / discount(intrinsics.pixels(), index)) as f32,
                image_focal: [intrinsics.fx as f32, intrinsics.fy as f32],
                image_center: [intrinsics.cx as f32, intrinsics.cy as f32],
                position_sd_m: noise.position_m as f32,
                rotation_sd_rad: noise.rotation_rad as f32,
                _padding: [0; 2],
            };
            (finer_width, finer_first) = (level.width, first);
            first += level.pixels() as u32;
            camera = camera.half();
            level
        })
    }
}

/// What refinement has found so far: the real camera is `given * given_from_real`, and Y = gain * tau + offset.
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub struct Estimate {
    /// Of `given_from_real`, a unit quaternion, its real part last.
    pub rotation: [f32; 4],
    pub translation: [f32; 3],
    pub gain: f32,
    /// Sum of the capped residuals and their number: at the last look, and at the one before.
    pub mismatch: [f32; 2],
    pub mismatch_before: [f32; 2],
    pub offset: f32,
    /// 0 where too little is predicted.
    pub level_count: u32,
    /// Comparable pixels of the finest level.
    pub point_count: u32,
    /// Whether it is better than the given pose; 0 or 1.
    pub accepted: u32,
}
