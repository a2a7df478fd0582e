//! A script: a story on the table, the robots that drive around it, and what their cameras and the tracker deliver at
//! any frame, with the truth beside it. Every value is a function of the script, the robot and the frame, so frames may
//! be asked for in any order and by several threads.

use nalgebra::Point3;

use super::{
    random::wander,
    rig::{Arc, Drive, Rig},
    room::{TABLE_HEIGHT_M, room},
    scene::{ObjectId, Primitive, Scene},
    sensor::Sensor,
    story::{Item, Moment, PERSON, Story, furnishings},
    texture::Rgb,
    tracer::{Lighting, LitView, Rendering, Tracer, depth_alone},
    tracker::{Marker, TRACKER_HZ, Tracker},
};
use crate::{
    model::{
        camera::Intrinsics,
        frame::{RgbImage, RigFrame, SideView, Sides},
        pose::Pose,
    },
    stages::localise::{LocaliseError, PlateFit, TOLERANCE_M, fit_plate},
};

pub const FRAMES_PER_SECOND: f64 = 7.0;
/// Capture time of frame 0, seconds.
pub const START_SECS: f64 = 1000.0;
/// Frames of one pass of a robot that drives for ever, and of its stop at the turning point.
const ENDLESS_DRIVE: Drive = Drive::Endless {
    driving: 154.0,
    standing: 4.0,
};
/// Instants that one blurred exposure is made of.
const SHUTTER_SAMPLES: usize = 4;

/// One camera head on its way; several may belong to one robot.
#[derive(Debug, Clone, PartialEq)]
pub struct Station {
    pub robot: String,
    pub camera: String,
    pub rig: Rig,
    pub arc: Arc,
    pub drive: Drive,
    /// Its own share in all random numbers.
    pub key: u64,
}

#[derive(Debug, Clone)]
pub struct Script {
    pub seed: u64,
    pub story: Story,
    pub stations: Vec<Station>,
    /// `None`: endless.
    pub frames: Option<u64>,
    pub sensor: Sensor,
    pub tracker: Tracker,
    pub lighting: Lighting,
    furnishings: Vec<Item>,
}

/// A change of so many levels of 255 in a channel stands out of the sensor's noise, about one level.
const TOUCHED_LEVELS: u8 = 4;

/// Which of the three cameras are rendered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Views {
    /// The middle one; its depth is given.
    Middle,
    /// All, so that depth can be computed from them.
    Triple,
}

/// What one camera saw, and what was there.
#[derive(Debug, Clone, PartialEq)]
pub struct Shot {
    pub image: RgbImage,
    /// True depth along the optical axis to the first surface, metres; 0 = none.
    pub depth_m: Vec<f32>,
    /// True depth to the first surface that is not glass, metres; 0 = none.
    pub depth_through_glass_m: Vec<f32>,
    /// The object in every pixel.
    pub object: Vec<ObjectId>,
    /// For every item that comes and goes, in the story's order: 255 where it is seen, or would be seen if it stood
    /// where it stands at other times.
    pub masks: Vec<Vec<u8>>,
}

impl Shot {
    /// 255 where this object is seen.
    pub fn mask_of(&self, object: ObjectId) -> Vec<u8> {
        self.object
            .iter()
            .map(|&seen| if seen == object { 255 } else { 0 })
            .collect()
    }
}

/// Everything about one frame of one station.
#[derive(Debug, Clone)]
pub struct Capture {
    pub stamp_ns: i64,
    /// Index of the frame, from 0.
    pub sequence: u64,
    pub middle: Shot,
    /// `(left, right)` with [`Views::Triple`].
    pub sides: Option<(Shot, Shot)>,
    /// As a depth camera in the middle's place measures it, metres: noisy, and blind to glass.
    pub depth_m: Vec<f32>,
    pub markers: Vec<Marker>,
    /// Of the middle camera; true.
    pub world_from_camera: Pose,
    pub moment: Moment,
    /// Of the station's pass, from 0; even ones go from Q1 to Q2.
    pub pass: u64,
}

impl Capture {
    /// `fwd` from Q1 to Q2, `back` the other way.
    pub fn direction(&self) -> &'static str {
        if self.pass.is_multiple_of(2) {
            "fwd"
        } else {
            "back"
        }
    }

    /// What the robot sends; `None` with [`Views::Middle`].
    pub fn rig_frame(&self) -> Option<RigFrame> {
        let (left, right) = self.sides.as_ref()?;
        Some(RigFrame {
            stamp_ns: self.stamp_ns,
            sequence: self.sequence,
            image: self.middle.image.clone(),
            left: left.image.grey(),
            right: right.image.grey(),
            marker_in_world: self.markers.iter().map(Marker::tracked).collect(),
        })
    }
}

fn station(index: u64, drive: Drive) -> Station {
    // The first arc is the paper's; the others lie to the right of it, farther out and higher.
    let turn = [0.0, 34f64, 12.0][index as usize % 3].to_radians();
    let ring = index as f64;
    Station {
        robot: format!("robot{index}"),
        camera: "front".into(),
        rig: Rig::default(),
        arc: Arc {
            looked_at: Point3::new(0.0, 0.0, TABLE_HEIGHT_M + 0.07),
            radius_m: 1.0 + 0.14 * ring,
            height_m: 0.40 + 0.10 * ring,
            from_rad: 35f64.to_radians() + turn,
            to_rad: -35f64.to_radians() + turn,
            stray_m: 0.015,
            stray_rad: 0.012,
        },
        drive,
        key: index,
    }
}

impl Script {
    fn new(seed: u64, story: Story, drive: Drive, frames: Option<u64>) -> Self {
        Self {
            seed,
            story,
            stations: vec![station(0, drive)],
            frames,
            sensor: Sensor::default(),
            tracker: Tracker::default(),
            lighting: Lighting::default(),
            furnishings: furnishings(),
        }
    }

    /// The paper's sequence I1 (Table I): 1283 frames, a glass is added, a black cup is added and removed. The turning
    /// points lie where section V-A has them: Q2 at frame 520, Q1 where a phase begins.
    pub fn tabletop(seed: u64) -> Self {
        let legs = vec![
            (1.0, 170.0),
            (173.0, 340.0),
            (352.0, 520.0),
            (523.0, 675.0),
            (687.0, 828.0),
            (831.0, 980.0),
            (990.0, 1132.0),
            (1135.0, 1283.0),
        ];
        Self::new(seed, Story::tabletop(), Drive::Legs(legs), Some(1283))
    }

    /// The paper's sequences I2 (316 frames) and I3 (1100 frames) of section V-C, one after the other.
    pub fn objects(seed: u64) -> Self {
        Self::new(seed, Story::objects(), ENDLESS_DRIVE, Some(316 + 1100))
    }

    /// Endless; things come and go as the seed says.
    pub fn patrol(seed: u64) -> Self {
        Self::new(seed, Story::patrol(seed), ENDLESS_DRIVE, None)
    }

    /// The same story seen by `count` robots on arcs of their own.
    pub fn with_robots(mut self, count: usize) -> Self {
        let drive = self.stations[0].drive.clone();
        self.stations = (0..count as u64)
            .map(|index| station(index, drive.clone()))
            .collect();
        self
    }

    /// Gives every robot a second camera head, `mast`, 0.3 m above the first.
    pub fn with_masts(mut self) -> Self {
        let masts: Vec<_> = self
            .stations
            .iter()
            .map(|front| {
                let mut mast = front.clone();
                mast.camera = "mast".into();
                mast.arc.height_m += 0.3;
                // The same key keeps the same path.
                mast
            })
            .collect();
        self.stations.extend(masts);
        self
    }

    /// Capture time, nanoseconds.
    pub fn stamp_ns(&self, frame: u64) -> i64 {
        (START_SECS * 1e9) as i64 + (frame as f64 / FRAMES_PER_SECOND * 1e9).round() as i64
    }

    /// True pose of the middle camera at a frame; fractions are times in between.
    pub fn world_from_camera(&self, station: usize, frame: f64) -> Pose {
        let station = &self.stations[station];
        let odometer = station.drive.odometer(frame + 1.0);
        station
            .arc
            .world_from_camera(odometer, self.seed, station.key)
    }

    /// The tracker's own sample number `tick` (25 a second since frame 0): time in seconds, and the LEDs.
    pub fn tracker_sample(&self, station: usize, tick: u64) -> (f64, Vec<Marker>) {
        let since_start = tick as f64 / TRACKER_HZ;
        let markers = self.observe(station, since_start * FRAMES_PER_SECOND);
        (START_SECS + since_start, markers)
    }

    fn observe(&self, station: usize, frame: f64) -> Vec<Marker> {
        let pose = self.world_from_camera(station, frame);
        let at = &self.stations[station];
        let time = START_SECS + frame / FRAMES_PER_SECOND;
        // Two heads of one robot carry plates of their own.
        self.tracker
            .observe(&at.rig, &pose, time, self.seed, 0x7_0000 + station as u64)
    }

    /// The scene at a frame, for whoever wants to look from elsewhere.
    pub fn scene(&self, frame: f64) -> Scene {
        self.scene_of(&self.story.moment(frame + 1.0))
    }

    fn scene_of(&self, moment: &Moment) -> Scene {
        let mut primitives = room();
        for item in &self.furnishings {
            primitives.extend(item.kind.build(&item.placement, item.id));
        }
        for &index in &moment.standing {
            let item = &self.story.items[index];
            primitives.extend(item.kind.build(&item.placement, item.id));
        }
        if let Some((index, placement)) = &moment.carried {
            primitives.extend(self.story.items[*index].kind.build(placement, PERSON));
        }
        if let Some(person) = &moment.person {
            primitives.extend(person.build(PERSON));
        }
        Scene::new(primitives)
    }

    /// Names of everything that masks can be had of.
    pub fn names(&self) -> impl Iterator<Item = (&'static str, ObjectId)> {
        self.furnishings
            .iter()
            .chain(&self.story.items)
            .map(|item| (item.name, item.id))
            .chain([("person", PERSON)])
    }

    /// What is on the table besides the furnishings, as in `phases.csv`: `glass+cup`, with `person` while one is there.
    pub fn present(&self, moment: &Moment) -> String {
        let mut names: Vec<&str> = moment
            .standing
            .iter()
            .map(|&index| self.story.items[index].name)
            .collect();
        if moment.person.is_some() {
            names.push("person");
        }
        names.join("+")
    }

    /// Frame `frame` (from 0) of a station.
    pub fn capture(&self, station: usize, frame: u64, views: Views) -> Capture {
        let at = &self.stations[station];
        let number = frame as f64 + 1.0;
        let moment = self.story.moment(number);
        let scene = self.scene_of(&moment);
        let tracer = Tracer {
            scene: &scene,
            lighting: &self.lighting,
        };
        let gain = 1.0
            + self.sensor.exposure_drift
                * wander(self.seed, 0xe0 + station as u64, frame as f64 / 40.0);
        let key = |camera: u64| [station as u64, frame, camera];
        let shot = |middle_from_camera: Option<&Pose>, camera: u64, beside: Option<&LitView>| {
            let pose_at = |frame: f64| {
                let world_from_middle = self.world_from_camera(station, frame);
                middle_from_camera.map_or(world_from_middle, |offset| world_from_middle * offset)
            };
            let intrinsics = &at.rig.intrinsics;
            let pose = pose_at(frame as f64);
            let (rendering, view) = tracer.render_beside(intrinsics, &pose, beside);
            let blurred = self.blurred(&tracer, intrinsics, &rendering, frame as f64, pose_at);
            let image = self.sensor.expose(
                blurred.as_ref().unwrap_or(&rendering.radiance),
                intrinsics.width,
                gain,
                self.seed,
                &key(camera),
            );
            let masks = self
                .story
                .items
                .iter()
                .enumerate()
                .map(|(index, item)| {
                    let stands = moment.standing.contains(&index);
                    self.mask(item, stands, intrinsics, &pose, &rendering)
                })
                .collect();
            let shot = Shot {
                image,
                depth_m: rendering.depth_m,
                depth_through_glass_m: rendering.depth_through_glass_m,
                object: rendering.object,
                masks,
            };
            (shot, view)
        };
        let (middle, view) = shot(None, 0, None);
        let side =
            |middle_from_side: &Pose, camera| shot(Some(middle_from_side), camera, Some(&view)).0;
        Capture {
            stamp_ns: self.stamp_ns(frame),
            sequence: frame,
            depth_m: self
                .sensor
                .measure_depth(&middle.depth_through_glass_m, self.seed, &key(3)),
            middle,
            sides: (views == Views::Triple).then(|| {
                (
                    side(&at.rig.middle_from_left, 1),
                    side(&at.rig.middle_from_right, 2),
                )
            }),
            markers: self.observe(station, frame as f64),
            world_from_camera: self.world_from_camera(station, frame as f64),
            moment,
            pass: at.drive.pass(number),
        }
    }

    /// Where whatever comes and goes changes what the middle camera sees, be it its surface, shade, mirror image or
    /// refraction, or a person: 255, else 0. Of all items in their places at once, so that it holds for those that are
    /// yet to come or were taken away.
    pub fn touched(&self, station: usize, capture: &Capture) -> Vec<u8> {
        let intrinsics = &self.stations[station].rig.intrinsics;
        let seen = |moment: &Moment| {
            let scene = self.scene_of(moment);
            let tracer = Tracer {
                scene: &scene,
                lighting: &self.lighting,
            };
            let rendering = tracer.render(intrinsics, &capture.world_from_camera);
            // The same noise in both.
            self.sensor.expose(
                &rendering.radiance,
                intrinsics.width,
                1.0,
                self.seed,
                &[station as u64, capture.sequence],
            )
        };
        let bare = Moment {
            standing: Vec::new(),
            carried: None,
            person: None,
            ..capture.moment.clone()
        };
        let crowded = Moment {
            standing: (0..self.story.items.len()).collect(),
            ..capture.moment.clone()
        };
        let (bare, crowded) = (seen(&bare), seen(&crowded));
        bare.data
            .chunks_exact(3)
            .zip(crowded.data.chunks_exact(3))
            .map(|(a, b)| {
                let differs = a
                    .iter()
                    .zip(b)
                    .any(|(a, b)| a.abs_diff(*b) >= TOUCHED_LEVELS);
                if differs { 255 } else { 0 }
            })
            .collect()
    }

    /// Mean radiance while the shutter is open; `None` without motion blur.
    fn blurred(
        &self,
        tracer: &Tracer,
        intrinsics: &Intrinsics,
        middle: &Rendering,
        frame: f64,
        pose_at: impl Fn(f64) -> Pose,
    ) -> Option<Vec<Rgb>> {
        if self.sensor.shutter_secs == 0.0 {
            return None;
        }
        let open = self.sensor.shutter_secs * FRAMES_PER_SECOND;
        let share = 1.0 / (SHUTTER_SAMPLES + 1) as f32;
        let mut sum: Vec<Rgb> = middle
            .radiance
            .iter()
            .map(|colour| colour.map(|value| value * share))
            .collect();
        for index in 0..SHUTTER_SAMPLES {
            let offset = ((index as f64 + 0.5) / SHUTTER_SAMPLES as f64 - 0.5) * open;
            let rendering = tracer.render(intrinsics, &pose_at(frame + offset));
            for (sum, colour) in sum.iter_mut().zip(&rendering.radiance) {
                for (sum, value) in sum.iter_mut().zip(colour) {
                    *sum += value * share;
                }
            }
        }
        Some(sum)
    }

    /// An item's visible silhouette: where it is the first thing seen, or would be.
    fn mask(
        &self,
        item: &Item,
        stands: bool,
        intrinsics: &Intrinsics,
        pose: &Pose,
        rendering: &Rendering,
    ) -> Vec<u8> {
        if stands {
            return rendering
                .object
                .iter()
                .map(|&seen| if seen == item.id { 255 } else { 0 })
                .collect();
        }
        let Item {
            kind,
            placement,
            id,
            ..
        } = item;
        let alone: Vec<Primitive> = kind.build(placement, *id);
        depth_alone(&alone, intrinsics, pose)
            .iter()
            .zip(&rendering.depth_m)
            .map(|(&own, &scene)| {
                let hidden = scene > 0.0 && scene < own;
                if own.is_finite() && !hidden { 255 } else { 0 }
            })
            .collect()
    }

    /// The rig's side images of a capture with [`Views::Triple`], as the service gets them; `None` with another.
    pub fn sides(&self, station: usize, capture: &Capture) -> Option<Sides> {
        let rig = &self.stations[station].rig;
        let (left, right) = capture.sides.as_ref()?;
        let view = |shot: &Shot, middle_from_side| SideView {
            image: shot.image.grey(),
            intrinsics: rig.intrinsics,
            middle_from_side,
        };
        Some(Sides {
            left: view(left, rig.middle_from_left),
            right: view(right, rig.middle_from_right),
        })
    }

    /// The middle camera's pose as a robot gets it: from the tracked LEDs.
    pub fn localised(
        &self,
        station: usize,
        capture: &Capture,
    ) -> Result<(Pose, PlateFit), LocaliseError> {
        let rig = &self.stations[station].rig;
        let tracked: Vec<_> = capture.markers.iter().map(Marker::tracked).collect();
        let fit = fit_plate(&rig.marker_in_plate, &tracked, TOLERANCE_M)?;
        Ok((fit.world_from_plate * rig.camera_from_plate.inverse(), fit))
    }
}
