//! Messages -> model, checked: what leaves this room has sane poses, cameras and times. Pictures are only measured here;
//! [`image`] unpacks them when a frame's turn has come.

pub mod event;

pub mod image;

pub mod questions;

mod rig;

use prost::Message;
use prost_types::Timestamp;

pub use rig::{calibration, camera_calibration, markers_sample};

use super::proto;
use crate::{
    config::Settings,
    model::{
        camera::{Calibration, Intrinsics, PlumbBob, RigCalibration},
        frame::{GreyImage, MarkersInWorld, RgbImage},
        pose::{Pose, PoseNoise, pose_from_parts},
        refusal::Refusal,
    },
    stages::interpolate::sample::SIDE_MAX,
};

/// The smallest picture that blocks and evidence make sense of.
pub const SIDE_MIN: usize = 16;
/// Nothing on earth is farther away; beyond it, sums of squares lose their meaning.
const POSITION_MAX_M: f64 = 1e7;
/// Focal lengths outside, as a share of the longer side, see half the sky or a hair.
const FOCAL_SHARE: (f64, f64) = (0.01, 1000.0);
/// A robot that is less sure of its pose than this cannot be helped by refinement.
const POSE_SD_MAX: f64 = 10.0;

/// What pictures may take, checked before any of them is unpacked.
#[derive(Debug, Clone, Copy)]
pub struct Limits {
    pub image_pixels_max: usize,
}

impl Limits {
    pub fn new(settings: &Settings) -> Self {
        Self {
            image_pixels_max: settings.image_pixels_max,
        }
    }

    /// The longest message that a frame within the limit can need: three colour images, 32 bit depth, and the rest.
    pub fn message_bytes_max(&self) -> usize {
        self.image_pixels_max * (3 * 3 + 4) + (1 << 20)
    }
}

/// A frame that passed every check but whose pictures are still packed.
#[derive(Debug, Clone)]
pub struct PackedFrame {
    pub stamp_ns: i64,
    pub sequence: u64,
    pub world_from_camera: Option<Pose>,
    pub pose_noise: Option<PoseNoise>,
    pub marker_in_world: Option<MarkersInWorld>,
    pub calibration: Option<RigCalibration>,
    image: proto::Image,
    depth: PackedDepth,
}

#[derive(Debug, Clone)]
enum PackedDepth {
    Given(proto::Image),
    /// Left and right.
    Sides(Box<[proto::Image; 2]>),
}

/// Pictures of a frame, unpacked.
#[derive(Debug, Clone)]
pub struct Pictures {
    pub image: RgbImage,
    pub depth: PicturedDepth,
}

#[derive(Debug, Clone)]
pub enum PicturedDepth {
    /// Metres; 0 = none. As many as the image has pixels.
    Given(Vec<f32>),
    Sides {
        left: GreyImage,
        right: GreyImage,
    },
}

impl PackedFrame {
    /// Unpacks the image, and depth of the same size or the side cameras' images.
    ///
    /// # Errors
    /// What [`image`] refuses, and depth of another size than the image.
    pub fn pictures(&self, limits: Limits) -> Result<Pictures, Refusal> {
        let image = image::colour(&self.image, limits)?;
        let depth = match &self.depth {
            PackedDepth::Given(depth) => depth,
            PackedDepth::Sides(sides) => {
                let [left, right] = sides.as_ref();
                let depth = PicturedDepth::Sides {
                    left: image::grey(left, limits)?,
                    right: image::grey(right, limits)?,
                };
                return Ok(Pictures { image, depth });
            }
        };
        let (width, height, depth_m) = image::depth_m(depth, limits)?;
        if (width, height) != (image.width, image.height) {
            return Err(Refusal::new(
                "depth_size",
                format!(
                    "the depth has {width}x{height} pixels but the image {}x{}: register the depth to the image and send it at the image's resolution",
                    image.width, image.height
                ),
            ));
        }
        Ok(Pictures {
            image,
            depth: PicturedDepth::Given(depth_m),
        })
    }
}

/// # Errors
/// `undecodable`: these bytes are no such message.
pub fn message<M: Message + Default + prost::Name>(bytes: &[u8]) -> Result<M, Refusal> {
    M::decode(bytes).map_err(|error| {
        Refusal::new(
            "undecodable",
            format!(
                "the payload is no {}: {error}; compile proto/surprised/v1 of this version",
                M::full_name()
            ),
        )
    })
}

/// Stamp and sequence of a frame that may be refused for anything else; 0 where they are missing.
pub fn stamp_and_sequence(frame: &proto::Frame) -> (i64, u64) {
    let stamp = frame.stamp.as_ref().map_or(Ok(0), stamp_ns);
    (stamp.unwrap_or(0), frame.sequence)
}

/// # Errors
/// Anything a frame can have wrong but its pictures' contents.
pub fn frame(frame: proto::Frame) -> Result<PackedFrame, Refusal> {
    let stamp_ns = required_stamp_ns(frame.stamp.as_ref())?;
    let world_from_camera = frame.world_from_camera.as_ref().map(pose).transpose()?;
    let pose_noise = pose_noise(frame.pose_position_sd, frame.pose_rotation_sd)?;
    let marker_in_world = frame.markers.as_ref().map(rig::markers).transpose()?;
    let calibration = frame.calibration.as_ref().map(calibration).transpose()?;
    let image = frame.image.ok_or_else(|| {
        Refusal::new(
            "no_image",
            "the frame has no image: put the camera's picture into `image`",
        )
    })?;
    let depth = match (frame.depth, frame.left, frame.right) {
        (Some(depth), ..) => PackedDepth::Given(depth),
        (None, Some(left), Some(right)) => PackedDepth::Sides(Box::new([left, right])),
        (None, ..) => {
            return Err(Refusal::new(
                "no_depth",
                "the frame has no depth: put a depth image registered to the picture into `depth`, or the pictures of the cameras beside it into `left` and `right`",
            ));
        }
    };
    Ok(PackedFrame {
        stamp_ns,
        sequence: frame.sequence,
        world_from_camera,
        pose_noise,
        marker_in_world,
        calibration,
        image,
        depth,
    })
}

/// Time and pose from the `pose` key.
///
/// # Errors
/// Undecodable bytes, no stamp, no pose or a senseless one.
pub fn pose_sample(bytes: &[u8]) -> Result<(i64, Pose), Refusal> {
    let sample: proto::PoseSample = message(bytes)?;
    let stamp_ns = required_stamp_ns(sample.stamp.as_ref())?;
    let world_from_camera = sample.world_from_camera.as_ref().ok_or_else(|| {
        Refusal::new(
            "no_pose",
            "the pose sample has no pose: fill `world_from_camera`",
        )
    })?;
    Ok((stamp_ns, pose(world_from_camera)?))
}

/// # Errors
/// Sizes, focal lengths, principal points and distortions that no camera has.
pub fn intrinsics(intrinsics: &proto::Intrinsics) -> Result<Calibration, Refusal> {
    let proto::Intrinsics { fx, fy, cx, cy, .. } = *intrinsics;
    let (width, height) = size(intrinsics.width, intrinsics.height)?;
    let side = width.max(height) as f64;
    let focal = FOCAL_SHARE.0 * side..=FOCAL_SHARE.1 * side;
    if !(focal.contains(&fx) && focal.contains(&fy)) {
        return Err(Refusal::new(
            "focal_length",
            format!(
                "focal lengths {fx} and {fy} are not those of a {width}x{height} camera: they count pixels and lie between {} and {}",
                focal.start(),
                focal.end()
            ),
        ));
    }
    if !((0.0..width as f64).contains(&cx) && (0.0..height as f64).contains(&cy)) {
        return Err(Refusal::new(
            "principal_point",
            format!(
                "the principal point {cx}, {cy} lies outside the {width}x{height} image: is this the calibration of another resolution?"
            ),
        ));
    }
    Ok(Calibration {
        intrinsics: Intrinsics {
            width,
            height,
            fx,
            fy,
            cx,
            cy,
        },
        distortion: distortion(&intrinsics.distortion_model, &intrinsics.distortion)?,
    })
}

fn distortion(model: &str, coefficients: &[f64]) -> Result<Option<PlumbBob>, Refusal> {
    let refusal = |detail: String| Err(Refusal::new("distortion", detail));
    if !coefficients.iter().all(|value| value.is_finite()) {
        return refusal("a distortion coefficient is not finite: calibrate again".to_owned());
    }
    if coefficients.iter().all(|value| *value == 0.0) && matches!(model, "" | "plumb_bob") {
        return Ok(None);
    }
    match (model, coefficients) {
        ("plumb_bob", &[k1, k2, p1, p2]) => Ok(Some(PlumbBob {
            k1,
            k2,
            p1,
            p2,
            k3: 0.0,
        })),
        ("plumb_bob", &[k1, k2, p1, p2, k3]) => Ok(Some(PlumbBob { k1, k2, p1, p2, k3 })),
        ("plumb_bob", _) => refusal(format!(
            "plumb_bob has 4 or 5 coefficients, k1 k2 p1 p2 [k3], but {} came",
            coefficients.len()
        )),
        ("", _) => refusal(
            "there are distortion coefficients but no model: set `distortion_model` to plumb_bob, or send rectified images without coefficients".to_owned(),
        ),
        (model, _) => refusal(format!(
            "the distortion model `{}` is unknown: use plumb_bob, or send rectified images without a model",
            shortened(model)
        )),
    }
}

/// # Errors
/// `bad_pose`: missing parts, NaN, a quaternion that is no rotation, a position off the earth.
pub fn pose(pose: &proto::Pose) -> Result<Pose, Refusal> {
    let bad = |detail: &str| Refusal::new("bad_pose", detail);
    let (Some(p), Some(q)) = (&pose.position, &pose.orientation) else {
        return Err(bad(
            "the pose lacks its position or its orientation: fill both",
        ));
    };
    let pose = pose_from_parts([p.x, p.y, p.z], [q.x, q.y, q.z, q.w]).ok_or_else(|| {
        bad("the pose is not finite or its quaternion (x y z w) is not of unit length: normalise it")
    })?;
    if pose.translation.vector.amax() > POSITION_MAX_M {
        return Err(bad(
            "the pose is more than 10,000 km from the origin: positions count metres",
        ));
    }
    Ok(pose)
}

/// `None` where the frame leaves both to the settings.
fn pose_noise(position_m: f64, rotation_rad: f64) -> Result<Option<PoseNoise>, Refusal> {
    let range = 0.0..=POSE_SD_MAX;
    if !(range.contains(&position_m) && range.contains(&rotation_rad)) {
        return Err(Refusal::new(
            "pose_noise",
            format!(
                "pose_position_sd {position_m} m or pose_rotation_sd {rotation_rad} rad is not between 0 and {POSE_SD_MAX}: 0 leaves it to the service"
            ),
        ));
    }
    Ok(
        (position_m > 0.0 || rotation_rad > 0.0).then_some(PoseNoise {
            position_m,
            rotation_rad,
        }),
    )
}

fn required_stamp_ns(stamp: Option<&Timestamp>) -> Result<i64, Refusal> {
    stamp_ns(stamp.ok_or_else(|| {
        Refusal::new(
            "no_stamp",
            "the message has no stamp: set it to the capture time",
        )
    })?)
}

/// Nanoseconds since the epoch.
///
/// # Errors
/// `bad_stamp`: fractions that are none, or centuries from now.
pub fn stamp_ns(stamp: &Timestamp) -> Result<i64, Refusal> {
    let bad = || {
        Refusal::new(
            "bad_stamp",
            format!(
                "the stamp {} s {} ns is no time: nanos lie between 0 and 999,999,999, seconds count from 1970",
                stamp.seconds, stamp.nanos
            ),
        )
    };
    if !(0..1_000_000_000).contains(&stamp.nanos) {
        return Err(bad());
    }
    stamp
        .seconds
        .checked_mul(1_000_000_000)
        .and_then(|ns| ns.checked_add(i64::from(stamp.nanos)))
        .ok_or_else(bad)
}

/// Width and height that the memory can hold.
fn size(width: u32, height: u32) -> Result<(usize, usize), Refusal> {
    let (width, height) = (width as usize, height as usize);
    let sides = SIDE_MIN..=SIDE_MAX;
    if !(sides.contains(&width) && sides.contains(&height)) {
        return Err(Refusal::new(
            "side",
            format!(
                "{width}x{height} pixels cannot be used: each side must have {SIDE_MIN} to {SIDE_MAX}"
            ),
        ));
    }
    Ok((width, height))
}

/// Of text from outside, as much as a sentence can bear.
fn shortened(text: &str) -> String {
    text.chars().take(32).collect()
}
