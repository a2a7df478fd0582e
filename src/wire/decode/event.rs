//! An event as it was told of before: what [`crate::wire::encode::event`] made, without its pictures.

use nalgebra::Vector3;
use prost::Message;
use prost_types::Timestamp;

use super::{
    questions::{bad, point},
    stamp_ns,
};
use crate::{
    model::{
        event::{EndReason, Event, Kind, Sighting, State},
        frame::Source,
        refusal::Refusal,
        report::PixelBox,
    },
    wire::{
        encode::{END_REASONS, EVENT_KINDS, EVENT_STATES},
        proto,
    },
};

/// The message, with its pictures, and what it says.
///
/// # Errors
/// The bytes are no event's.
pub fn stored(bytes: &[u8]) -> Result<(proto::Event, Event), Refusal> {
    let message = proto::Event::decode(bytes);
    let message = message.map_err(|error| bad(format!("not an event: {error}")))?;
    let event = event(&message)?;
    Ok((message, event))
}

/// # Errors
/// A field is missing, or is not what it may be.
pub fn event(event: &proto::Event) -> Result<Event, Refusal> {
    let one_of = |name: &str, names: &[&str]| {
        let found = names.iter().position(|known| *known == name);
        found.ok_or_else(|| bad(format!("{name:?} is none of {names:?}")))
    };
    let state = match one_of(&event.state, &EVENT_STATES)? {
        0 => State::New,
        1 => State::Update,
        _ => match one_of(&event.end_reason, &END_REASONS)? {
            0 => State::End(EndReason::SeenAgain),
            _ => State::End(EndReason::NoRoom),
        },
    };
    let extent = point(event.extent_in_world.as_ref())?;
    let points = event.unseen_points.iter();
    Ok(Event {
        id: event.id,
        kind: match one_of(&event.kind, &EVENT_KINDS)? {
            0 => Kind::Change,
            _ => Kind::Unseen,
        },
        state,
        first_seen_ns: required(event.first_seen.as_ref())?,
        last_seen_ns: required(event.last_seen.as_ref())?,
        ended_ns: event.ended.as_ref().map(stamp_ns).transpose()?,
        center_in_world: match &event.center_in_world {
            Some(center) => Some(point(Some(center))?),
            None => None,
        },
        extent_in_world: Vector3::new(extent.x, extent.y, extent.z),
        peak_surprise: event.peak_surprise,
        unseen_share: event.unseen_share,
        unseen_points: points.map(|p| point(Some(p))).collect::<Result<_, _>>()?,
        sightings: event.sightings,
        robots: event
            .robots
            .iter()
            .map(|robot| robot.as_str().into())
            .collect(),
        peak: sighting(event.peak.as_ref())?,
        last: sighting(event.last.as_ref())?,
        picture: None,
    })
}

fn required(stamp: Option<&Timestamp>) -> Result<i64, Refusal> {
    stamp_ns(stamp.ok_or_else(|| bad("an event has no time"))?)
}

fn sighting(sighting: Option<&proto::Sighting>) -> Result<Sighting, Refusal> {
    let sighting = sighting.ok_or_else(|| bad("an event has no sighting"))?;
    let pixel_box = sighting.r#box.as_ref();
    let pixel_box = pixel_box.ok_or_else(|| bad("a sighting has no box"))?;
    Ok(Sighting {
        source: Source {
            robot: sighting.robot.as_str().into(),
            camera: sighting.camera.as_str().into(),
        },
        stamp_ns: required(sighting.stamp.as_ref())?,
        sequence: sighting.sequence,
        pixel_box: PixelBox {
            x_min: pixel_box.x_min,
            y_min: pixel_box.y_min,
            x_max: pixel_box.x_max,
            y_max: pixel_box.y_max,
        },
        surprise: sighting.surprise,
    })
}
