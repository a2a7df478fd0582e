//! Where a memory may still expect the person: the places of the world in which cameras saw one, until a camera has come
//! back there and passed.
//!
//! In: frames with their true poses, true depth and what is seen in them. Out: the squares of an image in which what is
//! gone would be seen.

use std::collections::{BTreeSet, VecDeque};

use nalgebra::Point3;

use crate::{
    model::{
        camera::Intrinsics,
        pose::{Pose, view_distance_m},
        report::PixelBox,
    },
    simulation::{script::Shot, story::PERSON},
};

/// Of turning a camera, as viewpoints are compared.
const METRES_PER_RADIAN: f64 = 1.0;
/// Viewpoints this close together are selected together, metres: from there the expectation is made.
const EXPECTED_WITHIN_M: f64 = 0.10;
/// A robot that comes back along its arc passes this close to where it was, metres.
const SEEN_AGAIN_WITHIN_M: f64 = 0.05;
/// Every so many columns and rows the person's surface is noted, pixels.
const STEP_PX: usize = 4;
/// Side of the squares, pixels.
const SQUARE_PX: u32 = 8;
/// Sights that are kept; the oldest give way.
const SIGHTS_MAX: usize = 512;

/// Of the person, from one pose.
struct Sight {
    /// Whose.
    station: usize,
    /// That station has gone elsewhere since.
    left: bool,
    /// The station that is passing there again.
    passing: Option<usize>,
    world_from_camera: Pose,
    surface_in_world: Vec<Point3<f64>>,
}

#[derive(Default)]
pub struct Afterimages {
    sights: VecDeque<Sight>,
}

impl Afterimages {
    /// The squares of an image in which the person was seen, from about here, before anybody came back.
    pub fn squares(&self, camera: &Intrinsics, world_from_camera: &Pose) -> Squares {
        let camera_from_world = world_from_camera.inverse();
        let inside = |(u, v): &(f64, f64)| {
            (0.0..camera.width as f64).contains(u) && (0.0..camera.height as f64).contains(v)
        };
        Squares(
            self.sights
                .iter()
                .filter(|sight| distance_m(sight, world_from_camera) <= EXPECTED_WITHIN_M)
                .flat_map(|sight| &sight.surface_in_world)
                .filter_map(|point| camera.project(&(camera_from_world * point)))
                .filter(inside)
                .map(|(u, v)| (u as u32 / SQUARE_PX, v as u32 / SQUARE_PX))
                .collect(),
        )
    }

    /// A station's camera looked: what was seen from a place that it comes back to is gone when it has passed, and a
    /// person who is there is noted.
    pub fn look(
        &mut self,
        station: usize,
        camera: &Intrinsics,
        world_from_camera: &Pose,
        shot: &Shot,
    ) {
        self.sights.retain_mut(|sight| {
            let apart = distance_m(sight, world_from_camera);
            sight.left |= sight.station == station && apart > EXPECTED_WITHIN_M;
            let near = apart <= SEEN_AGAIN_WITHIN_M;
            let passed = sight.passing == Some(station) && !near;
            if sight.left && near && sight.passing.is_none() {
                sight.passing = Some(station);
            }
            !passed
        });
        let places = (0..camera.height)
            .step_by(STEP_PX)
            .flat_map(|v| (0..camera.width).step_by(STEP_PX).map(move |u| (u, v)));
        let surface_in_world: Vec<_> = places
            .filter(|(u, v)| shot.object[v * camera.width + u] == PERSON)
            .map(|(u, v)| {
                let depth_m = f64::from(shot.depth_m[v * camera.width + u]);
                world_from_camera * camera.unproject(u as f64, v as f64, depth_m)
            })
            .collect();
        if surface_in_world.is_empty() {
            return;
        }
        if self.sights.len() == SIGHTS_MAX {
            self.sights.pop_front();
        }
        self.sights.push_back(Sight {
            station,
            left: false,
            passing: None,
            world_from_camera: *world_from_camera,
            surface_in_world,
        });
    }
}

fn distance_m(sight: &Sight, world_from_camera: &Pose) -> f64 {
    view_distance_m(
        &sight.world_from_camera,
        world_from_camera,
        METRES_PER_RADIAN,
    )
}

/// Column and row of squares of an image.
pub struct Squares(BTreeSet<(u32, u32)>);

impl Squares {
    /// Whether one of them comes within `margin` pixels of the box.
    pub fn touch(&self, region: &PixelBox, margin: u32) -> bool {
        self.0.iter().any(|&(column, row)| {
            let (left, top) = (column * SQUARE_PX, row * SQUARE_PX);
            left < region.x_max + margin
                && region.x_min < left + SQUARE_PX + margin
                && top < region.y_max + margin
                && region.y_min < top + SQUARE_PX + margin
        })
    }
}
