//! What is asked of the memory, checked.

use nalgebra::Point3;
use prost_reflect::DynamicMessage;

use super::{intrinsics, pose, stamp_ns};
use crate::{
    memory::forget::{Forget, Region},
    model::{camera::Intrinsics, mode::Mode, pose::Pose, refusal::Refusal},
    wire::{encode::Named, encode::PriorPlane, proto},
};

/// Poses that one question may compare.
pub const CANDIDATES_MAX: usize = 64;
const RING_DEFAULT: usize = 8;
/// No step of a robot is longer, metres.
const RING_RADIUS_MAX_M: f64 = 1e3;
/// Viewpoints in one reply.
pub const VIEWS_MAX: usize = 10_000;

/// A message as protobuf's JSON mapping writes it.
///
/// # Errors
/// `undecodable`: no JSON, or none of such a message.
pub fn json<M: Named + Default>(bytes: &[u8]) -> Result<M, Refusal> {
    let refusal = |error: &dyn std::fmt::Display| {
        Refusal::new(
            "undecodable",
            format!(
                "the body is no {} in protobuf's JSON mapping: {error}; see proto/surprised/v1",
                M::full_name()
            ),
        )
    };
    let mut deserializer = serde_json::Deserializer::from_slice(bytes);
    let message =
        DynamicMessage::deserialize(crate::wire::encode::descriptor::<M>(), &mut deserializer)
            .map_err(|error| refusal(&error))?;
    deserializer.end().map_err(|error| refusal(&error))?;
    message.transcode_to().map_err(|error| refusal(&error))
}

/// # Errors
/// `bad_mode`.
pub fn mode(name: &str) -> Result<Mode, Refusal> {
    Mode::parse(name.trim()).ok_or_else(|| {
        Refusal::new(
            "bad_mode",
            "a mode is learn, observe or freeze: say one of them",
        )
    })
}

/// A rectified camera, and planes to draw; expected and coverage where none is named.
///
/// # Errors
/// `bad_request`, and what poses and intrinsics are refused for.
pub fn prior(
    request: &proto::PriorRequest,
    image_pixels_max: usize,
) -> Result<(Pose, Intrinsics, Vec<PriorPlane>), Refusal> {
    let (Some(world_from_camera), Some(camera)) = (&request.world_from_camera, &request.intrinsics)
    else {
        return Err(bad(
            "the request needs a pose and intrinsics: fill world_from_camera and intrinsics",
        ));
    };
    let planes = if request.planes.is_empty() {
        vec![PriorPlane::Expected, PriorPlane::Coverage]
    } else {
        let planes = request.planes.iter().map(|name| plane(name));
        planes.collect::<Result<_, _>>()?
    };
    let camera = bounded(camera, image_pixels_max)?;
    Ok((pose(world_from_camera)?, camera, planes))
}

/// # Errors
/// `bad_request`.
pub fn plane(name: &str) -> Result<PriorPlane, Refusal> {
    PriorPlane::parse(name).ok_or_else(|| {
        bad("a plane is unknown: ask for expected, uncertainty, coverage, depth or parameters")
    })
}

fn bounded(camera: &proto::Intrinsics, image_pixels_max: usize) -> Result<Intrinsics, Refusal> {
    let camera = intrinsics(camera)?.intrinsics;
    if camera.pixels() > image_pixels_max {
        return Err(Refusal::new(
            "image_too_large",
            format!(
                "{} pixels are more than image_pixels_max = {image_pixels_max}: ask for a smaller image",
                camera.pixels()
            ),
        ));
    }
    Ok(camera)
}

/// Where to look from next.
#[derive(Debug, Clone, PartialEq)]
pub struct NextView {
    pub candidates: Candidates,
    /// `None`: the ring's camera's.
    pub intrinsics: Option<Intrinsics>,
}

#[derive(Debug, Clone, PartialEq)]
pub enum Candidates {
    /// world_from_camera.
    Poses(Vec<Pose>),
    Ring(Ring),
}

#[derive(Debug, Clone, PartialEq)]
pub struct Ring {
    /// `None`: where the camera was in its last frame.
    pub around: Option<Pose>,
    pub radius_m: f64,
    pub count: usize,
}

/// # Errors
/// `bad_request`, `too_many_candidates`, and what poses and intrinsics are refused for.
pub fn next_view(
    request: &proto::NextViewRequest,
    image_pixels_max: usize,
) -> Result<NextView, Refusal> {
    let intrinsics = request.intrinsics.as_ref();
    let intrinsics = intrinsics
        .map(|camera| bounded(camera, image_pixels_max))
        .transpose()?;
    let candidates = match (&request.candidates[..], &request.ring) {
        ([], Some(asked)) => Candidates::Ring(ring(asked)?),
        ([], None) => {
            return Err(bad(
                "there is nothing to compare: fill `candidates` with poses, or `ring`",
            ));
        }
        (_, Some(_)) => {
            return Err(bad("fill either `candidates` or `ring`, not both"));
        }
        (poses, None) => {
            if intrinsics.is_none() {
                return Err(bad(
                    "candidates need the camera they are imagined for: fill `intrinsics`",
                ));
            }
            check_count(poses.len())?;
            Candidates::Poses(poses.iter().map(pose).collect::<Result<_, _>>()?)
        }
    };
    let count = match &candidates {
        Candidates::Poses(poses) => poses.len(),
        Candidates::Ring(ring) => ring.count,
    };
    let pixels = intrinsics.map_or(0, |camera| camera.pixels());
    if pixels.saturating_mul(count) > image_pixels_max {
        return Err(Refusal::new(
            "image_too_large",
            format!(
                "{count} candidates of {pixels} pixels are more than image_pixels_max = {image_pixels_max} in all: a small image ranks them as well"
            ),
        ));
    }
    Ok(NextView {
        candidates,
        intrinsics,
    })
}

fn ring(ring: &proto::Ring) -> Result<Ring, Refusal> {
    if !(0.0..=RING_RADIUS_MAX_M).contains(&ring.radius) {
        return Err(bad(
            "the ring's radius is not between 0 and 1000 m: 0 turns on the spot",
        ));
    }
    let count = match ring.count as usize {
        0 => RING_DEFAULT,
        count => count,
    };
    check_count(count)?;
    Ok(Ring {
        around: ring.around.as_ref().map(pose).transpose()?,
        radius_m: ring.radius,
        count,
    })
}

fn check_count(count: usize) -> Result<(), Refusal> {
    if count > CANDIDATES_MAX {
        return Err(Refusal::new(
            "too_many_candidates",
            format!("{count} candidates are more than {CANDIDATES_MAX}: ask in portions"),
        ));
    }
    Ok(())
}

/// # Errors
/// `bad_request`: nothing is named, or something that is no part of the world.
pub fn forget(request: &proto::ForgetRequest) -> Result<Forget, Refusal> {
    let region = match (&request.sphere, &request.r#box) {
        (None, None) => None,
        (Some(sphere), None) => {
            let center = point(sphere.center.as_ref())?;
            if !(sphere.radius.is_finite() && sphere.radius > 0.0) {
                return Err(bad("the sphere has no radius: give it in metres"));
            }
            Some(Region::Sphere {
                center,
                radius_m: sphere.radius,
            })
        }
        (None, Some(bounds)) => {
            let (min, max) = (point(bounds.min.as_ref())?, point(bounds.max.as_ref())?);
            if !(0..3).all(|axis| min[axis] <= max[axis]) {
                return Err(bad("the box's min is not below its max on every axis"));
            }
            Some(Region::Box { min, max })
        }
        (Some(_), Some(_)) => {
            return Err(bad("fill either `sphere` or `box`, and ask twice for both"));
        }
    };
    let span_ns = match &request.span {
        None => None,
        Some(span) => {
            let since = span.since.as_ref().map(stamp_ns).transpose()?;
            let until = span.until.as_ref().map(stamp_ns).transpose()?;
            if since.is_none() && until.is_none() {
                return Err(bad("the span has no end: fill `since`, `until`, or both"));
            }
            Some(since.unwrap_or(i64::MIN)..until.unwrap_or(i64::MAX))
        }
    };
    match (request.everything, region.is_some() || span_ns.is_some()) {
        (false, false) => Err(bad(
            "nothing to forget is named: fill `sphere`, `box` or `span`, or set `everything`",
        )),
        (true, true) => Err(bad(
            "`everything` goes with nothing else: leave it out, or the rest",
        )),
        _ => Ok(Forget { region, span_ns }),
    }
}

/// Metres, world.
pub(super) fn point(vector: Option<&proto::Vector3>) -> Result<Point3<f64>, Refusal> {
    let point = vector.map(|v| Point3::new(v.x, v.y, v.z));
    point
        .filter(|point| point.iter().all(|value| value.is_finite()))
        .ok_or_else(|| bad("a point in the world is missing or not finite: fill x, y and z"))
}

pub fn bad(detail: impl Into<String>) -> Refusal {
    Refusal::new("bad_request", detail)
}
