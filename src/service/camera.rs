//! What a worker knows about one camera: its calibration, its poses, its clock, and the frame that waits for them.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use super::{
    ask::{Answer, Snapshot},
    inbox::Arrival,
    publish::CameraPublisher,
    status::CameraStatus,
};
use crate::{
    model::{
        camera::Calibration,
        frame::{Frame, FrameError, RgbImage, Source},
        pose::{Pose, PoseNoise},
        refusal::Refusal,
    },
    stages::{
        pose_track::{PoseTrack, TrackedPose, goes_back},
        rectify::Rectifier,
        stamp_order::{Order, StampOrder},
    },
    wire::{
        decode::{self, Limits, PackedFrame},
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
    calibration: Option<Lens>,
    calibration_asked: Option<Instant>,
    order: StampOrder,
    /// Sequence of the last frame that could be read, refused or not.
    last_received: Option<u64>,
    last_image: Option<Arc<RgbImage>>,
    snapshot: Option<Arc<Snapshot>>,
    watched_until: Option<Instant>,
    watchers: Vec<Answer<Arc<Snapshot>>>,
}

/// A calibration with the map that follows from it.
#[derive(Debug, Clone)]
struct Lens {
    calibration: Calibration,
    rectifier: Option<Arc<Rectifier>>,
}

impl Lens {
    fn new(calibration: Calibration) -> Self {
        Self {
            rectifier: Rectifier::new(&calibration).map(Arc::new),
            calibration,
        }
    }
}

/// A frame whose pose or calibration may still come.
pub struct Waiting {
    frame: PackedFrame,
    arrived: Instant,
}

/// Whether a waiting frame's turn can come.
#[expect(
    clippy::large_enum_variant,
    reason = "one is made and taken apart a frame"
)]
pub enum Turn {
    Ready(Pose, PackedFrame),
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
            calibration_asked: None,
            order: StampOrder::default(),
            last_received: None,
            last_image: None,
            snapshot: None,
            watched_until: None,
            watchers: Vec::new(),
        }
    }

    pub fn set_calibration(
        &mut self,
        calibration: Calibration,
        limits: Limits,
    ) -> Result<(), Refusal> {
        let pixels = calibration.intrinsics.pixels();
        if pixels > limits.image_pixels_max {
            return Err(Refusal::new(
                "image_too_large",
                format!(
                    "the calibration is of {pixels} pixels, more than image_pixels_max = {}: send smaller pictures, or raise the setting",
                    limits.image_pixels_max
                ),
            ));
        }
        if self
            .calibration
            .as_ref()
            .is_none_or(|lens| lens.calibration != calibration)
        {
            self.calibration = Some(Lens::new(calibration));
        }
        Ok(())
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
            self.set_calibration(calibration.clone(), limits)
                .map_err(refused)?;
        }
        self.waiting = Some(Waiting {
            frame,
            arrived: arrival.arrived,
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
        let Waiting { frame, arrived } = self.waiting.as_ref()?;
        let refuse = |refusal| {
            Turn::Refused(Refused {
                refusal,
                stamp_ns: frame.stamp_ns,
                sequence: frame.sequence,
            })
        };
        let turn = if self.calibration.is_none() {
            if self
                .calibration_asked
                .is_none_or(|asked| now.saturating_duration_since(asked) >= CALIBRATION_WAIT)
            {
                self.calibration_asked = Some(now);
                ask_calibration(&self.path);
            }
            let deadline = *arrived + CALIBRATION_WAIT;
            if now < deadline {
                return Some(Turn::Until(deadline));
            }
            refuse(Refusal::new(
                "no_calibration",
                "no calibration is known: put it on the camera's `calibration` key, answer gets there, or send it in the frame",
            ))
        } else {
            let pose = match frame.world_from_camera {
                Some(pose) => TrackedPose::At(pose),
                None => self.track.at(frame.stamp_ns),
            };
            match pose {
                TrackedPose::At(pose) => {
                    let frame = self.waiting.take()?.frame;
                    return Some(Turn::Ready(pose, frame));
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
                            "the frame carries no pose and none came on the `pose` key: send `world_from_camera` in the frame, or PoseSamples".to_owned()
                        } else {
                            format!(
                                "no pose sample at or after the frame's stamp came within pose_wait_s = {} s: publish poses more often, or raise the setting",
                                pose_wait.as_secs_f64()
                            )
                        },
                    ))
                }
            }
        };
        self.waiting = None;
        Some(turn)
    }

    /// Unpacks and rectifies a frame's pictures.
    ///
    /// # Errors
    /// Pictures that cannot be unpacked or are not of the calibration's size.
    pub fn unpack(
        &self,
        packed: &PackedFrame,
        world_from_camera: Pose,
        noise_default: PoseNoise,
        limits: Limits,
    ) -> Result<Frame, Refusal> {
        let Some(lens) = &self.calibration else {
            return Err(Refusal::new("no_calibration", "no calibration is known"));
        };
        unpack(
            packed,
            lens,
            self.path.source.clone(),
            world_from_camera,
            noise_default,
            limits,
        )
    }

    /// Counts a frame that was processed and goes on from its stamp.
    pub fn processed(&mut self, image: RgbImage, report: proto::SurpriseReport, stamp_ns: i64) {
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
        make: Option<impl FnOnce(Arc<RgbImage>) -> Snapshot>,
    ) {
        self.watched_until = Some(now + WATCHED);
        if let (None, Some(make), Some(image)) = (&self.snapshot, make, &self.last_image) {
            self.snapshot = Some(Arc::new(make(image.clone())));
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

    pub fn show(&mut self, make: impl FnOnce(Arc<RgbImage>) -> Snapshot) {
        let Some(image) = &self.last_image else {
            return;
        };
        let snapshot = Arc::new(make(image.clone()));
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

/// A frame that brings everything itself, as an evaluation asks for.
///
/// # Errors
/// What is wrong with it, or missing.
pub fn unpack_alone(
    packed: &PackedFrame,
    source: Source,
    noise_default: PoseNoise,
    limits: Limits,
) -> Result<Frame, Refusal> {
    let (Some(calibration), Some(pose)) = (&packed.calibration, packed.world_from_camera) else {
        return Err(Refusal::new(
            "no_calibration",
            "a frame to evaluate must carry its pose, and its calibration or the parameters robot and camera",
        ));
    };
    let lens = Lens::new(calibration.clone());
    unpack(packed, &lens, source, pose, noise_default, limits)
}

fn unpack(
    packed: &PackedFrame,
    lens: &Lens,
    source: Source,
    world_from_camera: Pose,
    noise_default: PoseNoise,
    limits: Limits,
) -> Result<Frame, Refusal> {
    let pictures = packed.pictures(limits)?;
    let intrinsics = lens.calibration.intrinsics;
    let (mut image, mut depth_m) = (pictures.image, pictures.depth_m);
    if (image.width, image.height) != (intrinsics.width, intrinsics.height) {
        return Err(FrameError::ImageSize {
            image_width: image.width,
            image_height: image.height,
            width: intrinsics.width,
            height: intrinsics.height,
        }
        .into());
    }
    if let Some(rectifier) = &lens.rectifier {
        image = rectifier.image(&image);
        depth_m = rectifier.depth_m(&depth_m);
    }
    let given = |value: f64, default: f64| if value > 0.0 { value } else { default };
    Ok(Frame {
        source,
        stamp_ns: packed.stamp_ns,
        sequence: packed.sequence,
        image,
        depth_m,
        intrinsics,
        world_from_camera,
        pose_noise: packed.pose_noise.map(|noise| PoseNoise {
            position_m: given(noise.position_m, noise_default.position_m),
            rotation_rad: given(noise.rotation_rad, noise_default.rotation_rad),
        }),
    })
}
