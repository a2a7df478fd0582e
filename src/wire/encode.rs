//! Model -> messages -> bytes or JSON.

use std::sync::LazyLock;

use nalgebra::Point3;
use prost::{Message, Name};
use prost_reflect::{DescriptorPool, DynamicMessage, MessageDescriptor, SerializeOptions};
use prost_types::Timestamp;

use super::{picture, proto};
use crate::{
    memory::forget::Forgotten,
    model::{
        camera::{Calibration, Intrinsics, RigCalibration, SideCalibrations},
        event::{EndReason, Event, Kind, Picture, Sighting, State},
        frame::{DepthSource, Frame, GreyImage, RgbImage, RigFrame, Source},
        mode::Mode,
        pose::Pose,
        refusal::Refusal,
        report::{PixelBox, Region, Report},
        viewpoint::Head,
    },
    pipeline::{Maps, PriorAt},
    stages::{
        interpolate::prior::{self, Prior},
        next_view::Promise,
    },
};

/// A message of the contract.
pub trait Named: Message + Name {}

impl<M: Message + Name> Named for M {}

pub fn bytes(message: &impl Message) -> Vec<u8> {
    message.encode_to_vec()
}

static DESCRIPTORS: LazyLock<DescriptorPool> = LazyLock::new(|| {
    DescriptorPool::decode(include_bytes!(concat!(env!("OUT_DIR"), "/descriptors.bin")).as_slice())
        .expect("build.rs wrote the descriptors")
});

pub(super) fn descriptor<M: Named>() -> MessageDescriptor {
    DESCRIPTORS
        .get_message_by_name(&M::full_name())
        .expect("every message of the contract is described")
}

/// As protobuf's JSON mapping says, with the fields' own names and all of them: what is not there cannot be told from
/// what a reader misspelt.
pub fn json<M: Named>(message: &M) -> serde_json::Value {
    let dynamic = DynamicMessage::decode(descriptor::<M>(), message.encode_to_vec().as_slice())
        .expect("a message decodes as itself");
    let options = SerializeOptions::new()
        .use_proto_field_name(true)
        .skip_default_fields(false);
    dynamic
        .serialize_with_options(serde_json::value::Serializer, &options)
        .expect("messages map to JSON")
}

pub fn timestamp(stamp_ns: i64) -> Timestamp {
    Timestamp {
        seconds: stamp_ns.div_euclid(1_000_000_000),
        // Below 10^9.
        nanos: stamp_ns.rem_euclid(1_000_000_000) as i32,
    }
}

pub fn pose(pose: &Pose) -> proto::Pose {
    let rotation = &pose.rotation;
    proto::Pose {
        position: Some(vector(&pose.translation.vector.into())),
        orientation: Some(proto::Quaternion {
            x: rotation.i,
            y: rotation.j,
            z: rotation.k,
            w: rotation.w,
        }),
    }
}

fn vector(point: &Point3<f64>) -> proto::Vector3 {
    proto::Vector3 {
        x: point.x,
        y: point.y,
        z: point.z,
    }
}

pub fn pose_sample(stamp_ns: i64, world_from_camera: &Pose) -> proto::PoseSample {
    proto::PoseSample {
        stamp: Some(timestamp(stamp_ns)),
        world_from_camera: Some(pose(world_from_camera)),
    }
}

/// Of a rectified camera.
pub fn intrinsics(intrinsics: &Intrinsics) -> proto::Intrinsics {
    proto::Intrinsics {
        width: intrinsics.width as u32,
        height: intrinsics.height as u32,
        fx: intrinsics.fx,
        fy: intrinsics.fy,
        cx: intrinsics.cx,
        cy: intrinsics.cy,
        distortion_model: String::new(),
        distortion: Vec::new(),
    }
}

/// Of a camera alone.
pub fn calibration(calibration: &Calibration) -> proto::Calibration {
    proto::Calibration {
        middle: Some(lens(calibration)),
        ..proto::Calibration::default()
    }
}

pub fn rig_calibration(rig: &RigCalibration) -> proto::Calibration {
    let mut message = calibration(&rig.middle);
    if let Some(SideCalibrations { left, right }) = &rig.sides {
        message.left = Some(lens(&left.camera));
        message.right = Some(lens(&right.camera));
        message.middle_from_left = Some(pose(&left.middle_from_side));
        message.middle_from_right = Some(pose(&right.middle_from_side));
    }
    if let Some(plate) = &rig.plate {
        message.marker_in_plate = plate.marker_in_plate.iter().map(vector).collect();
        message.camera_from_plate = Some(pose(&plate.camera_from_plate));
    }
    message
}

/// As it is kept with the place.
pub fn camera_calibration(source: &Source, rig: &RigCalibration) -> proto::CameraCalibration {
    proto::CameraCalibration {
        robot: source.robot.to_string(),
        camera: source.camera.to_string(),
        calibration: Some(rig_calibration(rig)),
    }
}

fn lens(calibration: &Calibration) -> proto::Intrinsics {
    let mut message = intrinsics(&calibration.intrinsics);
    if let Some(lens) = &calibration.distortion {
        message.distortion_model = "plumb_bob".to_owned();
        message.distortion = vec![lens.k1, lens.k2, lens.p1, lens.p2, lens.k3];
    }
    message
}

/// `marker_in_world`: metres, in the calibration's order; `None` for what the tracker does not see.
pub fn markers(stamp_ns: i64, marker_in_world: &[Option<Point3<f64>>]) -> proto::Markers {
    proto::Markers {
        stamp: Some(timestamp(stamp_ns)),
        markers: marker_in_world
            .iter()
            .map(|marker| proto::Marker {
                position: marker.as_ref().map(vector),
                visible: marker.is_some(),
            })
            .collect(),
    }
}

/// As a robot sends it: raw pixels, metres, its own pose; the calibration travels on its own key.
pub fn frame(frame: &Frame) -> proto::Frame {
    let Intrinsics { width, height, .. } = frame.intrinsics;
    let noise = frame.pose_noise;
    let (mut depth, mut left, mut right) = (None, None, None);
    match &frame.depth {
        DepthSource::Given(depth_m) => {
            depth = Some(plane(width, height, depth_m.iter().copied()));
        }
        DepthSource::Sides(sides) => {
            left = Some(mono8(&sides.left.image));
            right = Some(mono8(&sides.right.image));
        }
    }
    proto::Frame {
        stamp: Some(timestamp(frame.stamp_ns)),
        sequence: frame.sequence,
        image: Some(rgb8(&frame.image)),
        left,
        right,
        depth,
        world_from_camera: Some(pose(&frame.world_from_camera)),
        pose_position_sd: noise.map_or(0.0, |noise| noise.position_m),
        pose_rotation_sd: noise.map_or(0.0, |noise| noise.rotation_rad),
        ..proto::Frame::default()
    }
}

/// As a rig sends it: raw pixels, markers; the calibration travels on its own key.
pub fn rig_frame(frame: &RigFrame) -> proto::Frame {
    proto::Frame {
        stamp: Some(timestamp(frame.stamp_ns)),
        sequence: frame.sequence,
        image: Some(rgb8(&frame.image)),
        left: Some(mono8(&frame.left)),
        right: Some(mono8(&frame.right)),
        markers: Some(markers(frame.stamp_ns, &frame.marker_in_world)),
        ..proto::Frame::default()
    }
}

fn image(encoding: &str, width: usize, height: usize, data: Vec<u8>) -> proto::Image {
    proto::Image {
        encoding: encoding.to_owned(),
        width: width as u32,
        height: height as u32,
        step: 0,
        data,
    }
}

pub fn rgb8(rgb: &RgbImage) -> proto::Image {
    image("rgb8", rgb.width, rgb.height, rgb.data.clone())
}

pub fn mono8(grey: &GreyImage) -> proto::Image {
    image("mono8", grey.width, grey.height, grey.data.clone())
}

/// 32FC1.
pub fn plane(width: usize, height: usize, values: impl Iterator<Item = f32>) -> proto::Image {
    image(
        "32FC1",
        width,
        height,
        values.flat_map(f32::to_le_bytes).collect(),
    )
}

/// `png`.
pub fn expected(prior: &Prior) -> proto::Image {
    png(&picture::expected_rgb(prior))
}

pub fn uncertainty(prior: &Prior) -> proto::Image {
    plane(prior.width, prior.height, picture::uncertainty(prior))
}

/// mono8.
pub fn coverage(prior: &Prior) -> proto::Image {
    let views = prior.plane(prior::COVERAGE).map(|views| views as u8);
    image("mono8", prior.width, prior.height, views.collect())
}

pub fn depth(prior: &Prior) -> proto::Image {
    plane(prior.width, prior.height, prior.plane(prior::DEPTH))
}

pub fn surprise(maps: &Maps) -> proto::Image {
    plane(
        maps.prior.width,
        maps.prior.height,
        maps.score.surprise.iter().copied(),
    )
}

pub fn blocks(maps: &Maps) -> proto::Image {
    let blocks = &maps.evidence;
    plane(blocks.width, blocks.height, blocks.data.iter().copied())
}

pub fn report(report: &Report, place: &str, processing_seconds: f64) -> proto::SurpriseReport {
    proto::SurpriseReport {
        stamp: Some(timestamp(report.stamp_ns)),
        sequence: report.sequence,
        place: place.to_owned(),
        robot: report.source.robot.to_string(),
        camera: report.source.camera.to_string(),
        width: report.width as u32,
        height: report.height as u32,
        world_from_camera: Some(pose(&report.world_from_camera)),
        regions: report.regions.iter().map(region).collect(),
        max_surprise: report.max_surprise,
        mean_surprise: report.mean_surprise,
        coverage: report.coverage,
        learned: report.learned,
        viewpoint_id: report.viewpoint_id.unwrap_or(0),
        viewpoints_used: report.viewpoints_used.to_vec(),
        processing_seconds,
        pose_correction_m: report.pose_correction_m,
        pose_correction_rad: report.pose_correction_rad,
    }
}

fn pixel_box(pixels: &PixelBox) -> proto::Box {
    proto::Box {
        x_min: pixels.x_min,
        y_min: pixels.y_min,
        x_max: pixels.x_max,
        y_max: pixels.y_max,
    }
}

fn region(region: &Region) -> proto::Region {
    proto::Region {
        id: region.id,
        r#box: Some(pixel_box(&region.pixel_box)),
        peak_x: region.peak_x,
        peak_y: region.peak_y,
        peak_surprise: region.peak_surprise,
        mean_surprise: region.mean_surprise,
        area: region.area,
        center_in_world: region.center_in_world.as_ref().map(vector),
        touches_border: region.touches_border,
        keypoints: Vec::new(),
        event_id: region.event_id,
    }
}

/// For those who get the pictures on their own.
pub fn event_json(event: &proto::Event) -> serde_json::Value {
    json(&proto::Event {
        picture: None,
        expected_picture: None,
        ..event.clone()
    })
}

/// What was seen and what was expected, as jpeg.
pub fn event_pictures(pictures: &Picture) -> (Option<proto::Image>, Option<proto::Image>) {
    let jpeg = |rgb: &RgbImage| image("jpeg", rgb.width, rgb.height, picture::jpeg(rgb));
    (
        Some(jpeg(&pictures.seen)),
        pictures.expected.as_ref().map(jpeg),
    )
}

/// An event's kinds and states by name.
pub const EVENT_KINDS: [&str; 2] = ["change", "unseen"];
pub const EVENT_STATES: [&str; 3] = ["new", "update", "end"];
pub const END_REASONS: [&str; 2] = ["seen_again", "no_room"];

/// Without its pictures.
pub fn event(event: &Event, place: &str) -> proto::Event {
    proto::Event {
        id: event.id,
        place: place.to_owned(),
        kind: match event.kind {
            Kind::Change => EVENT_KINDS[0],
            Kind::Unseen => EVENT_KINDS[1],
        }
        .to_owned(),
        state: match event.state {
            State::New => EVENT_STATES[0],
            State::Update => EVENT_STATES[1],
            State::End(_) => EVENT_STATES[2],
        }
        .to_owned(),
        first_seen: Some(timestamp(event.first_seen_ns)),
        last_seen: Some(timestamp(event.last_seen_ns)),
        ended: event.ended_ns.map(timestamp),
        end_reason: match event.state {
            State::New | State::Update => "",
            State::End(EndReason::SeenAgain) => END_REASONS[0],
            State::End(EndReason::NoRoom) => END_REASONS[1],
        }
        .to_owned(),
        center_in_world: event.center_in_world.as_ref().map(vector),
        extent_in_world: Some(vector(&event.extent_in_world.into())),
        peak_surprise: event.peak_surprise,
        unseen_share: event.unseen_share,
        sightings: event.sightings,
        robots: event.robots.iter().map(|robot| robot.to_string()).collect(),
        peak: Some(sighting(&event.peak)),
        last: Some(sighting(&event.last)),
        picture: None,
        expected_picture: None,
        unseen_points: event.unseen_points.iter().map(vector).collect(),
    }
}

fn sighting(sighting: &Sighting) -> proto::Sighting {
    proto::Sighting {
        stamp: Some(timestamp(sighting.stamp_ns)),
        robot: sighting.source.robot.to_string(),
        camera: sighting.source.camera.to_string(),
        sequence: sighting.sequence,
        r#box: Some(pixel_box(&sighting.pixel_box)),
        surprise: sighting.surprise,
    }
}

/// `stamp_ns` and `sequence` as far as they could be read.
pub fn rejection(key: &str, refusal: &Refusal, stamp_ns: i64, sequence: u64) -> proto::Rejection {
    proto::Rejection {
        stamp: Some(timestamp(stamp_ns)),
        key: key.to_owned(),
        code: refusal.code.to_owned(),
        detail: refusal.detail.clone(),
        sequence,
    }
}

/// A plane of a `PriorReply`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PriorPlane {
    Expected,
    Uncertainty,
    Coverage,
    Depth,
    Parameters,
}

impl PriorPlane {
    pub const ALL: [Self; 5] = [
        Self::Expected,
        Self::Uncertainty,
        Self::Coverage,
        Self::Depth,
        Self::Parameters,
    ];

    /// As in `PriorRequest.planes`.
    pub fn parse(name: &str) -> Option<Self> {
        Some(match name {
            "expected" => Self::Expected,
            "uncertainty" => Self::Uncertainty,
            "coverage" => Self::Coverage,
            "depth" => Self::Depth,
            "parameters" => Self::Parameters,
            _ => return None,
        })
    }

    /// In a reply, before it is compressed.
    pub fn bytes_per_pixel(self) -> usize {
        match self {
            Self::Expected => 3,
            Self::Coverage => 1,
            Self::Uncertainty | Self::Depth => 4,
            Self::Parameters => 4 * (prior::TAU2 - prior::ALPHA),
        }
    }
}

/// What was asked for of a prior, not yet drawn: drawing takes longer and needs no engine.
#[derive(Debug, Clone)]
pub struct PriorPlanes {
    reply: proto::PriorReply,
    expected: Option<RgbImage>,
}

impl PriorPlanes {
    pub fn new(at: &PriorAt, planes: &[PriorPlane]) -> Self {
        let prior = &at.prior;
        let mut picked = Self {
            reply: proto::PriorReply {
                viewpoints_used: at.viewpoints_used.to_vec(),
                covered: covered(prior),
                ..proto::PriorReply::default()
            },
            expected: None,
        };
        let reply = &mut picked.reply;
        for plane in planes {
            match plane {
                PriorPlane::Expected => picked.expected = Some(picture::expected_rgb(prior)),
                PriorPlane::Uncertainty => reply.uncertainty = Some(uncertainty(prior)),
                PriorPlane::Coverage => reply.coverage = Some(coverage(prior)),
                PriorPlane::Depth => reply.depth = Some(depth(prior)),
                PriorPlane::Parameters => {
                    reply.parameters = (prior::ALPHA..prior::TAU2)
                        .flat_map(|plane| prior.plane(plane))
                        .flat_map(f32::to_le_bytes)
                        .collect();
                }
            }
        }
        picked
    }

    pub fn draw(self) -> proto::PriorReply {
        proto::PriorReply {
            expected: self.expected.as_ref().map(png),
            ..self.reply
        }
    }
}

fn png(rgb: &RgbImage) -> proto::Image {
    image("png", rgb.width, rgb.height, picture::png(rgb))
}

/// Share of the pixels that some viewpoint saw.
fn covered(prior: &Prior) -> f32 {
    let seen = prior.plane(prior::COVERAGE).filter(|&views| views > 0.0);
    seen.count() as f32 / (prior.width * prior.height).max(1) as f32
}

pub fn view(viewpoint: &Head) -> proto::View {
    proto::View {
        id: viewpoint.id,
        world_from_camera: Some(pose(&viewpoint.world_from_camera)),
        stamp: Some(timestamp(viewpoint.stamp_ns)),
        robot: viewpoint.source.robot.to_string(),
        camera: viewpoint.source.camera.to_string(),
        updates: viewpoint.updates,
    }
}

/// `views` as they are to be listed; `total` are in the memory.
pub fn views_reply<'a>(views: impl Iterator<Item = &'a Head>, total: usize) -> proto::ViewsReply {
    proto::ViewsReply {
        views: views.map(view).collect(),
        total: total as u64,
    }
}

/// The most promising candidates first; those that promise the same keep their order.
pub fn next_view_reply(candidates: &[Pose], promises: &[Promise]) -> proto::NextViewReply {
    let candidates = candidates.iter().zip(promises).enumerate();
    let mut views: Vec<proto::RankedView> = candidates
        .map(|(index, (world_from_camera, promise))| proto::RankedView {
            index: index as u32,
            world_from_camera: Some(pose(world_from_camera)),
            reduction: promise.reduction,
            reduction_unseen: promise.reduction_unseen,
            uncertainty: promise.uncertainty,
            covered: promise.covered as f32,
        })
        .collect();
    views.sort_by(|a, b| b.reduction.total_cmp(&a.reduction));
    proto::NextViewReply { views }
}

pub fn forget_reply(forgotten: &Forgotten, left: usize) -> proto::ForgetReply {
    let changed = forgotten.changed.iter();
    proto::ForgetReply {
        viewpoints_removed: forgotten.removed.len() as u64,
        viewpoints_changed: changed.filter(|id| !forgotten.removed.contains(id)).count() as u64,
        pixels: forgotten.pixels,
        viewpoints_left: left as u64,
    }
}

pub fn mode(mode: Mode) -> proto::Mode {
    proto::Mode {
        mode: mode.name().to_owned(),
    }
}
