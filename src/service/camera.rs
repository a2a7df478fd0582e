//! What a worker knows about one camera: its calibration, its poses, its clock, and the frame that waits for them.

use std::{
    collections::VecDeque,
    sync::Arc,
    time::{Duration, Instant},
};

use nalgebra::Point3;

use super::{
    ask::{Answer, Snapshot},
    inbox::{Arrival, POSES_MAX},
    publish::CameraPublisher,
    status::CameraStatus,
};
use crate::{
    model::{
        camera::{Intrinsics, RigCalibration, SideCalibration},
        frame::{
            DepthSource, Frame, FrameError, GreyImage, MarkersInWorld, RgbImage, SideView, Sides,
            Source,
        },
        pose::{Pose, PoseNoise},
        refusal::Refusal,
    },
    stages::{
        localise,
        pose_track::{PoseTrack, TrackedPose, goes_back},
        rectify::Rectifier,
        stamp_order::{Order, StampOrder},
    },
    wire::{
        decode::{self, Limits, PackedFrame, PicturedDepth},
        keys::CameraPath,
        proto,
    },
};

/// How long a frame waits for the answer of the robot's `calibration` queryable.
pub const CALIBRATION_WAIT: Duration = Duration::from_secs(1);
/// A robot that counts anew, rather than one that lost so many frames.
const SEQUENCE_GAP_MAX: u64 = 100_000;
/// Somebody who asked for a picture may ask again within this time.
const WATCHED: Duration = Duration::from_secs(10);
/// Pictures wanted of the camera's next frame.
const WATCHERS_MAX: usize = 8;

pub struct Camera {
    pub path: CameraPath,
    pub publisher: CameraPublisher,
    pub status: CameraStatus,
    /// When it was served last, in frames of the place.
    pub served: u64,
    pub track: PoseTrack,
    pub waiting: Option<Waiting>,
    calibration: Option<Arc<Lenses>>,
    /// From before a restart: for a robot that does not answer when it is asked, as it may have been changed since.
    remembered: Option<Arc<Lenses>>,
    /// Markers whose plate is not known yet: stamps and positions in the world.
    markers: VecDeque<(i64, MarkersInWorld)>,
    /// Since when the robot is being asked for its calibration, or was in vain.
    calibration_asked: Option<Instant>,
    order: StampOrder,
    /// Sequence of the last frame that could be read, refused or not.
    last_received: Option<u64>,
    last_image: Option<Arc<RgbImage>>,
    last_pose: Option<Pose>,
    snapshot: Option<Arc<Snapshot>>,
    watched_until: Option<Instant>,
    watchers: Vec<Answer<Arc<Snapshot>>>,
}

/// A calibration with the maps that follow from it.
#[derive(Debug)]
pub struct Lenses {
    calibration: RigCalibration,
    middle: Option<Rectifier>,
    /// Left and right.
    sides: [Option<Rectifier>; 2],
}

impl Lenses {
    /// # Errors
    /// `image_too_large`.
    fn new(calibration: RigCalibration, limits: Limits) -> Result<Self, Refusal> {
        check_size(&calibration, limits)?;
        let sides = calibration.sides.as_ref();
        Ok(Self {
            middle: Rectifier::new(&calibration.middle),
            sides: [
                sides.and_then(|sides| Rectifier::new(&sides.left.camera)),
                sides.and_then(|sides| Rectifier::new(&sides.right.camera)),
            ],
            calibration,
        })
    }
}

/// # Errors
/// `image_too_large`.
fn check_size(calibration: &RigCalibration, limits: Limits) -> Result<(), Refusal> {
    let sides = calibration.sides.iter();
    let sides = sides.flat_map(|sides| [&sides.left.camera, &sides.right.camera]);
    for camera in sides.chain([&calibration.middle]) {
        let pixels = camera.intrinsics.pixels();
        if pixels > limits.image_pixels_max {
            return Err(Refusal::new(
                "image_too_large",
                format!(
                    "the calibration is of {pixels} pixels, more than image_pixels_max = {}: send smaller pictures, or raise the setting",
                    limits.image_pixels_max
                ),
            ));
        }
    }
    Ok(())
}

/// A frame whose pose or calibration may still come.
pub struct Waiting {
    pub frame: PackedFrame,
    pub arrived: Instant,
    /// Frames that nobody had time for before it.
    pub replaced: u64,
}

/// Whether a waiting frame's turn can come.
#[expect(
    clippy::large_enum_variant,
    reason = "one is made and taken apart a frame"
)]
pub enum Turn {
    Ready(Pose, Waiting),
    /// Look again then, or when something has come.
    Until(Instant),
    Refused(Refused),
}

/// A refusal with what is known about the frame.
#[derive(Debug)]
pub struct Refused {
    pub refusal: Refusal,
    pub stamp_ns: i64,
    pub sequence: u64,
}

impl Camera {
    pub fn new(path: CameraPath, publisher: CameraPublisher) -> Self {
        let status = CameraStatus {
            robot: path.source.robot.to_string(),
            camera: path.source.camera.to_string(),
            ..CameraStatus::default()
        };
        Self {
            path,
            publisher,
            status,
            served: 0,
            track: PoseTrack::default(),
            waiting: None,
            calibration: None,
            remembered: None,
            markers: VecDeque::new(),
            calibration_asked: None,
            order: StampOrder::default(),
            last_received: None,
            last_image: None,
            last_pose: None,
            snapshot: None,
            watched_until: None,
            watchers: Vec::new(),
        }
    }

    /// # Errors
    /// `image_too_large`.
    pub fn set_calibration(
        &mut self,
        calibration: RigCalibration,
        limits: Limits,
    ) -> Result<(), Refusal> {
        self.calibration = Some(self.lenses(Some(&calibration), limits)?);
        Ok(())
    }

    /// To be used if none comes when the robot is asked for it.
    pub fn remember_calibration(&mut self, calibration: &RigCalibration, limits: Limits) {
        match Lenses::new(calibration.clone(), limits) {
            Ok(lenses) => self.remembered = Some(Arc::new(lenses)),
            Err(refusal) => tracing::warn!("a stored calibration is not used: {refusal}"),
        }
    }

    /// The robot was asked for its calibration, and nobody answers any more.
    pub fn calibration_asked(&mut self) {
        if self.calibration.is_none() {
            self.calibration = self.remembered.take();
        }
    }

    /// The last that came, or is used for want of one.
    pub fn calibration(&self) -> Option<&RigCalibration> {
        Some(&self.calibration.as_ref()?.calibration)
    }

    /// Of the calibration that a frame brings, or else of the one that is known.
    ///
    /// # Errors
    /// `image_too_large`, `no_calibration`.
    pub fn lenses(
        &self,
        brought: Option<&RigCalibration>,
        limits: Limits,
    ) -> Result<Arc<Lenses>, Refusal> {
        match (&self.calibration, brought) {
            (Some(known), None) => Ok(known.clone()),
            (Some(known), Some(brought)) if known.calibration == *brought => Ok(known.clone()),
            (_, Some(brought)) => Ok(Arc::new(Lenses::new(brought.clone(), limits)?)),
            (None, None) => Err(no_calibration()),
        }
    }

    /// Of the last calibration, and where the last frame was.
    pub fn last_seen(&self) -> (Option<Intrinsics>, Option<Pose>) {
        let lenses = self.calibration.as_ref();
        (
            lenses.map(|lenses| lenses.calibration.middle.intrinsics),
            self.last_pose,
        )
    }

    /// The calibration that the waiting frame brings, or else the one that is known.
    fn calibration_at_hand(&self) -> Option<&RigCalibration> {
        let brought = self.waiting.as_ref();
        brought
            .and_then(|waiting| waiting.frame.calibration.as_ref())
            .or_else(|| self.calibration())
    }

    /// Takes a sample of the `markers` key; [`Self::fit_markers`] makes a pose of it.
    pub fn put_markers(&mut self, stamp_ns: i64, marker_in_world: MarkersInWorld) {
        if self.markers.len() == POSES_MAX {
            self.markers.pop_front();
        }
        self.markers.push_back((stamp_ns, marker_in_world));
    }

    /// Fits the plate to the markers that came, as soon as it is known, and returns why some gave no pose.
    pub fn fit_markers(&mut self) -> Vec<Refused> {
        if self.markers.is_empty() {
            return Vec::new();
        }
        let Some(calibration) = self.calibration_at_hand().cloned() else {
            return Vec::new();
        };
        let samples = std::mem::take(&mut self.markers);
        let fits = samples.into_iter().filter_map(|(stamp_ns, markers)| {
            let fit = fitted(&calibration, &markers)
                .and_then(|world_from_camera| self.track.push(stamp_ns, world_from_camera));
            fit.err().map(|refusal| Refused {
                refusal,
                stamp_ns,
                sequence: 0,
            })
        });
        fits.collect()
    }

    /// Reads a frame that came and lets it wait for what it lacks. `replaced`: frames it replaced in its slot.
    ///
    /// # Errors
    /// Everything that is wrong before pictures are unpacked, stamps that go back included.
    pub fn receive(
        &mut self,
        arrival: Arrival,
        replaced: u64,
        limits: Limits,
    ) -> Result<(), Refused> {
        let message: proto::Frame =
            decode::message(&arrival.payload.to_bytes()).map_err(|refusal| Refused {
                refusal,
                stamp_ns: 0,
                sequence: 0,
            })?;
        let (stamp_ns, sequence) = decode::stamp_and_sequence(&message);
        let refused = |refusal| Refused {
            refusal,
            stamp_ns,
            sequence,
        };
        let same =
            (Some(stamp_ns), Some(sequence)) == (self.order.last_ns(), self.status.last_sequence);
        if arrival.pulled && same {
            self.status.frames_repeated += 1;
            return Ok(());
        }
        if let Some(last) = self.last_received.replace(sequence) {
            let gap = sequence.saturating_sub(last).saturating_sub(1);
            if gap < SEQUENCE_GAP_MAX {
                self.status.frames_lost += gap.saturating_sub(replaced);
            }
        }
        let frame = decode::frame(message).map_err(refused)?;
        if let Order::GoesBack { last_ns } = self.order.judge(stamp_ns) {
            return Err(refused(goes_back("frame", stamp_ns, last_ns)));
        }
        if let Some(calibration) = &frame.calibration {
            check_size(calibration, limits).map_err(refused)?;
        }
        self.waiting = Some(Waiting {
            frame,
            arrived: arrival.arrived,
            replaced,
        });
        Ok(())
    }

    /// Whether the waiting frame has what it needs. `ask_calibration` is called when the robot should be asked.
    pub fn turn(
        &mut self,
        now: Instant,
        pose_wait: Duration,
        ask_calibration: impl FnOnce(&CameraPath),
    ) -> Option<Turn> {
        self.waiting.as_ref()?;
        let has_waited = |asked| now.saturating_duration_since(asked) >= CALIBRATION_WAIT;
        if self.calibration_at_hand().is_none() && self.calibration_asked.is_some_and(has_waited) {
            self.calibration = self.remembered.take();
        }
        let Waiting { frame, arrived, .. } = self.waiting.as_ref()?;
        let refuse = |refusal| {
            Turn::Refused(Refused {
                refusal,
                stamp_ns: frame.stamp_ns,
                sequence: frame.sequence,
            })
        };
        let turn = match self.calibration_at_hand() {
            None => {
                let asked = self.calibration_asked.filter(|asked| !has_waited(*asked));
                if asked.is_none() {
                    ask_calibration(&self.path);
                    self.calibration_asked = Some(now);
                }
                // What is remembered helps this frame only if nothing else comes.
                let since = match self.remembered {
                    Some(_) => asked.unwrap_or(now),
                    None => *arrived,
                };
                let deadline = since + CALIBRATION_WAIT;
                if now < deadline {
                    return Some(Turn::Until(deadline));
                }
                refuse(no_calibration())
            }
            Some(calibration) => {
                let pose = match carried_pose(frame, calibration) {
                    Some(Ok(pose)) => TrackedPose::At(pose),
                    Some(Err(refusal)) => TrackedPose::Never(refusal),
                    None => self.track.at(frame.stamp_ns),
                };
                match pose {
                    TrackedPose::At(pose) => {
                        return Some(Turn::Ready(pose, self.waiting.take()?));
                    }
                    TrackedPose::Never(refusal) => refuse(refusal),
                    TrackedPose::Later => {
                        let deadline = *arrived + pose_wait;
                        if now < deadline {
                            return Some(Turn::Until(deadline));
                        }
                        refuse(Refusal::new(
                            "no_pose",
                            if self.track.is_empty() {
                                "the frame carries neither a pose nor markers and none came on the `pose` and `markers` keys: send `world_from_camera` or `markers` in the frame, or PoseSamples or Markers".to_owned()
                            } else {
                                format!(
                                    "no pose or marker sample at or after the frame's stamp came within pose_wait_s = {} s: publish them more often, or raise the setting",
                                    pose_wait.as_secs_f64()
                                )
                            },
                        ))
                    }
                }
            }
        };
        self.waiting = None;
        Some(turn)
    }

    /// Counts a frame that was processed and goes on from its stamp, and with its calibration.
    pub fn processed(
        &mut self,
        image: RgbImage,
        lenses: Arc<Lenses>,
        world_from_camera: Pose,
        report: proto::SurpriseReport,
        stamp_ns: i64,
    ) {
        self.status.intrinsics = Some(lenses.calibration.middle.intrinsics);
        self.calibration = Some(lenses);
        self.last_pose = Some(world_from_camera);
        self.order.accept(stamp_ns);
        self.last_image = Some(Arc::new(image));
        self.snapshot = None;
        let status = &mut self.status;
        status.frames += 1;
        status.last_sequence = Some(report.sequence);
        status.last_stamp_ns = Some(stamp_ns);
        status.processing_seconds = report.processing_seconds;
        status.max_surprise = report.max_surprise;
        status.coverage = report.coverage;
        status.regions = report.regions.len();
        status.report = Some(Arc::new(report));
    }

    /// Lets somebody look at the camera's last frame. `make` gives the picture while the pipeline's maps are still
    /// those of that frame; otherwise the next frame answers.
    pub fn look(
        &mut self,
        answer: Answer<Arc<Snapshot>>,
        now: Instant,
        make: Option<impl FnOnce(Arc<RgbImage>, Arc<proto::SurpriseReport>) -> Snapshot>,
    ) {
        self.watched_until = Some(now + WATCHED);
        if let (None, Some(make)) = (&self.snapshot, make) {
            self.snapshot = self.snapshot_by(make);
        }
        self.watchers.retain(|watcher| !watcher.is_closed());
        match &self.snapshot {
            // Whoever asked may have gone.
            Some(snapshot) => drop(answer.send(Ok(snapshot.clone()))),
            None if self.watchers.len() < WATCHERS_MAX => self.watchers.push(answer),
            None => drop(answer.send(Err(busy()))),
        }
    }

    /// Somebody looks: make a snapshot of the frame just processed.
    pub fn watched(&self, now: Instant) -> bool {
        self.watched_until.is_some_and(|until| now < until)
    }

    fn snapshot_by(
        &self,
        make: impl FnOnce(Arc<RgbImage>, Arc<proto::SurpriseReport>) -> Snapshot,
    ) -> Option<Arc<Snapshot>> {
        let (image, report) = (self.last_image.clone()?, self.status.report.clone()?);
        Some(Arc::new(make(image, report)))
    }

    pub fn show(
        &mut self,
        make: impl FnOnce(Arc<RgbImage>, Arc<proto::SurpriseReport>) -> Snapshot,
    ) {
        let Some(snapshot) = self.snapshot_by(make) else {
            return;
        };
        for watcher in self.watchers.drain(..) {
            // Whoever asked may have gone.
            drop(watcher.send(Ok(snapshot.clone())));
        }
        self.snapshot = Some(snapshot);
    }
}

pub fn busy() -> Refusal {
    Refusal::new(
        "busy",
        "the place is busy with frames and other questions: ask again in a moment",
    )
}

fn no_calibration() -> Refusal {
    Refusal::new(
        "no_calibration",
        "no calibration is known: put it on the camera's `calibration` key, answer gets there, or send it in the frame",
    )
}

/// The calibration of a frame that brings everything itself, as an evaluation asks for.
///
/// # Errors
/// `image_too_large`, `no_calibration`.
pub fn lenses_alone(packed: &PackedFrame, limits: Limits) -> Result<Arc<Lenses>, Refusal> {
    let Some(calibration) = &packed.calibration else {
        return Err(Refusal::new(
            "no_calibration",
            "a frame to evaluate must carry its calibration, or come with the parameters robot and camera",
        ));
    };
    Ok(Arc::new(Lenses::new(calibration.clone(), limits)?))
}

/// # Errors
/// `no_pose`, or why its markers give none.
pub fn pose_alone(packed: &PackedFrame, lenses: &Lenses) -> Result<Pose, Refusal> {
    carried_pose(packed, &lenses.calibration).unwrap_or_else(|| {
        Err(Refusal::new(
            "no_pose",
            "a frame to evaluate must carry its pose in `world_from_camera`, or `markers`",
        ))
    })
}

/// The frame's own pose, or else the one that its markers give; `None` where it carries neither.
fn carried_pose(
    packed: &PackedFrame,
    calibration: &RigCalibration,
) -> Option<Result<Pose, Refusal>> {
    if let Some(pose) = packed.world_from_camera {
        return Some(Ok(pose));
    }
    Some(fitted(calibration, packed.marker_in_world.as_ref()?))
}

fn fitted(
    calibration: &RigCalibration,
    marker_in_world: &[Option<Point3<f64>>],
) -> Result<Pose, Refusal> {
    let plate = calibration.plate.as_ref().ok_or_else(|| {
        Refusal::new(
            "no_plate",
            "markers came but the calibration has no plate: fill its `marker_in_plate` and `camera_from_plate`",
        )
    })?;
    Ok(localise::world_from_camera(plate, marker_in_world)?)
}

/// Unpacks and rectifies a frame's pictures.
///
/// # Errors
/// Pictures that cannot be unpacked or are not of the calibration's size; `side_calibration` where depth is to be
/// computed by cameras that the calibration lacks.
pub fn unpack(
    packed: &PackedFrame,
    lenses: &Lenses,
    source: Source,
    world_from_camera: Pose,
    noise_default: PoseNoise,
    limits: Limits,
) -> Result<Frame, Refusal> {
    let pictures = packed.pictures(limits)?;
    let intrinsics = lenses.calibration.middle.intrinsics;
    let mut image = pictures.image;
    if (image.width, image.height) != (intrinsics.width, intrinsics.height) {
        return Err(FrameError::ImageSize {
            image_width: image.width,
            image_height: image.height,
            width: intrinsics.width,
            height: intrinsics.height,
        }
        .into());
    }
    if let Some(rectifier) = &lenses.middle {
        image = rectifier.image(&image);
    }
    let depth = match pictures.depth {
        PicturedDepth::Given(depth_m) => DepthSource::Given(match &lenses.middle {
            Some(rectifier) => rectifier.depth_m(&depth_m),
            None => depth_m,
        }),
        PicturedDepth::Sides { left, right } => {
            let calibration = lenses.calibration.sides.as_ref().ok_or_else(|| {
                Refusal::new(
                    "side_calibration",
                    "left and right images came but the calibration lacks their cameras: fill its `left`, `right`, `middle_from_left` and `middle_from_right`",
                )
            })?;
            let [left_rectifier, right_rectifier] = &lenses.sides;
            DepthSource::Sides(Box::new(Sides {
                left: side("left", left, &calibration.left, left_rectifier.as_ref())?,
                right: side("right", right, &calibration.right, right_rectifier.as_ref())?,
            }))
        }
    };
    let given = |value: f64, default: f64| if value > 0.0 { value } else { default };
    Ok(Frame {
        source,
        stamp_ns: packed.stamp_ns,
        sequence: packed.sequence,
        image,
        depth,
        intrinsics,
        world_from_camera,
        pose_noise: packed.pose_noise.map(|noise| PoseNoise {
            position_m: given(noise.position_m, noise_default.position_m),
            rotation_rad: given(noise.rotation_rad, noise_default.rotation_rad),
        }),
    })
}

fn side(
    name: &'static str,
    image: GreyImage,
    calibration: &SideCalibration,
    rectifier: Option<&Rectifier>,
) -> Result<SideView, Refusal> {
    let intrinsics = calibration.camera.intrinsics;
    if (image.width, image.height) != (intrinsics.width, intrinsics.height) {
        return Err(FrameError::SideSize {
            side: name,
            got_width: image.width,
            got_height: image.height,
            width: intrinsics.width,
            height: intrinsics.height,
        }
        .into());
    }
    Ok(SideView {
        image: match rectifier {
            Some(rectifier) => rectifier.grey(&image),
            None => image,
        },
        intrinsics,
        middle_from_side: calibration.middle_from_side,
    })
}
