//! Questions over HTTP: the messages of `proto/surprised/v1/query.proto` in protobuf's JSON mapping, in and out.
//!
//! ```text
//! POST /api/v1/places/{place}/prior        PriorRequest -> PriorReply; with `Accept: image/png` its first plane as a picture
//! POST .../evaluate?robot=&camera=         EvaluateRequest -> EvaluateReply
//! POST .../next_view                       NextViewRequest -> NextViewReply
//! POST .../forget                          ForgetRequest -> ForgetReply
//! GET  .../views?after=&limit=             -> ViewsReply
//! GET, PUT .../mode                        Mode -> Mode: how cameras begin; put: how all are from now on
//! GET, PUT .../robots/{robot}/{camera}/mode    Mode -> Mode
//! ```
//!
//! A body may also be the message itself, as `application/protobuf`; and so may the reply, if that is accepted.

use axum::{
    body::{Bytes, to_bytes},
    extract::{
        Query, Request, State,
        rejection::{BytesRejection, QueryRejection},
    },
    http::{HeaderMap, StatusCode, header},
    response::{IntoResponse, Response},
};
use serde::Deserialize;
use tokio::sync::OwnedSemaphorePermit;
use utoipa::IntoParams;
use utoipa_axum::{router::OpenApiRouter, routes};

use super::{
    App,
    extract::Path,
    message as described,
    problem::{Problem, Unanswered},
};
use crate::{
    model::refusal::Refusal,
    service::questions::{Held, Questions, camera_named, off_the_loop},
    wire::{
        decode::{
            self,
            questions::{bad, json, mode, plane},
        },
        encode::{self, Named, PriorPlane},
        keys::CameraPath,
        picture, proto,
    },
};

/// A frame to evaluate, its pictures as base64: a few megapixels as files, one as raw planes. What is larger travels
/// over Zenoh.
const FRAME_BYTES_MAX: usize = 32 << 20;

const PROTOBUF: &str = "application/protobuf";
const PNG: &str = "image/png";

pub fn routes() -> OpenApiRouter<App> {
    OpenApiRouter::new()
        .routes(routes!(views))
        .routes(routes!(prior))
        .routes(routes!(evaluate))
        .routes(routes!(next_view))
        .routes(routes!(forget))
        .routes(routes!(place_mode, set_place_mode))
        .routes(routes!(camera_mode, set_camera_mode))
}

/// Whether a header names this type, whatever else it says.
fn names(headers: &HeaderMap, header: header::HeaderName, media_type: &str) -> bool {
    let values = headers.get_all(header).into_iter();
    values
        .filter_map(|value| value.to_str().ok())
        .flat_map(|value| value.split(','))
        .any(|value| {
            value
                .split(';')
                .next()
                .is_some_and(|name| name.trim() == media_type)
        })
}

/// The message in a body, and the room it takes up.
fn request<M: Named + Default>(
    questions: &Questions,
    headers: &HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<(M, OwnedSemaphorePermit), Problem> {
    let body = body.map_err(|rejection| match rejection.status() {
        StatusCode::PAYLOAD_TOO_LARGE => too_large(),
        status => Problem::new(status, "body", rejection.body_text()),
    })?;
    let room = questions.room(body.len())?;
    Ok((message(headers, &body)?, room))
}

fn too_large() -> Problem {
    Problem::from(Refusal::new(
        "message_too_large",
        "the body is larger than such a question can be: send smaller or compressed pictures, or ask over Zenoh",
    ))
}

fn message<M: Named + Default>(headers: &HeaderMap, body: &[u8]) -> Result<M, Refusal> {
    if names(headers, header::CONTENT_TYPE, PROTOBUF) {
        decode::message(body)
    } else {
        json(body)
    }
}

/// In the form that is accepted; the room is free again when the reply has left.
fn reply<M: Named>(
    headers: &HeaderMap,
    message: &M,
    room: Option<OwnedSemaphorePermit>,
) -> Response {
    if names(headers, header::ACCEPT, PROTOBUF) {
        return sent(PROTOBUF, encode::bytes(message), room);
    }
    let text = encode::json(message).to_string();
    sent("application/json", text.into_bytes(), room)
}

/// Bytes that hold their room as long as they are held.
struct Sending(
    Vec<u8>,
    #[expect(dead_code, reason = "it is held")] Option<OwnedSemaphorePermit>,
);

impl AsRef<[u8]> for Sending {
    fn as_ref(&self) -> &[u8] {
        &self.0
    }
}

fn sent(media_type: &'static str, bytes: Vec<u8>, room: Option<OwnedSemaphorePermit>) -> Response {
    let headers = [
        (header::CONTENT_TYPE, media_type),
        (header::CACHE_CONTROL, "no-store"),
    ];
    (headers, Bytes::from_owner(Sending(bytes, room))).into_response()
}

/// What would be seen from a pose; accept image/png to have its first plane as a picture
#[utoipa::path(post, path = "/api/v1/places/{place}/prior", tag = "memory",
    params(("place" = String, Path)),
    request_body = described::PriorRequest,
    responses(
        (status = 200, content((described::PriorReply = "application/json"), (Vec<u8> = "image/png"))),
        Unanswered,
    ))]
async fn prior(
    State(app): State<App>,
    Path(place): Path<String>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<Response, Problem> {
    let questions = &app.parts.questions;
    let (mut request, _room): (proto::PriorRequest, _) = request(questions, &headers, body)?;
    let place = questions.places.known(&place).await?;
    if !names(&headers, header::ACCEPT, PNG) {
        let Held { reply: prior, room } = questions.prior(&place, &request).await?;
        return Ok(reply(&headers, &prior, room));
    }
    request.planes.truncate(1);
    let drawn = match request.planes.first() {
        Some(name) => plane(name)?,
        None => PriorPlane::Expected,
    };
    if drawn == PriorPlane::Parameters {
        return Err(bad("parameters are no picture: ask for them as JSON").into());
    }
    let Held { reply: prior, room } = questions.prior(&place, &request).await?;
    let png = off_the_loop(move || picture::plane_png(&prior, drawn)).await?;
    let png = png.ok_or_else(|| bad("the reply has no such plane"))?;
    Ok(sent(PNG, png, room))
}

/// Whose calibration and visit an evaluated frame borrows.
#[derive(Debug, Deserialize, Default, IntoParams)]
#[serde(default)]
#[into_params(parameter_in = Query)]
struct Borrowed {
    robot: String,
    camera: String,
}

/// How surprising a frame would be; nothing is learnt
#[utoipa::path(post, path = "/api/v1/places/{place}/evaluate", tag = "memory",
    params(("place" = String, Path), Borrowed),
    request_body = described::EvaluateRequest,
    responses(
        (status = 200, body = described::EvaluateReply),
        Unanswered,
    ))]
async fn evaluate(
    State(app): State<App>,
    Path(name): Path<String>,
    borrowed: Result<Query<Borrowed>, QueryRejection>,
    request: Request,
) -> Result<Response, Problem> {
    let questions = &app.parts.questions;
    let Query(Borrowed { robot, camera }) =
        borrowed.map_err(|_| bad("robot and camera are names"))?;
    let camera = camera_named(&robot, &camera)?;
    let place = questions.places.known(&name).await?;
    let (head, body) = request.into_parts();
    // Room is made before the body is read: some of these are large.
    let length = head.headers.get(header::CONTENT_LENGTH);
    let length = length.and_then(|length| length.to_str().ok()?.parse().ok());
    let length: usize = length.unwrap_or(FRAME_BYTES_MAX);
    if length > FRAME_BYTES_MAX {
        return Err(too_large());
    }
    let room = questions.room(length)?;
    let body = to_bytes(body, length).await.map_err(|_| too_large())?;
    let request = message(&head.headers, &body)?;
    drop(body);
    let evaluated = questions.evaluate(&name, &place, request, camera).await?;
    drop(room);
    Ok(reply(&head.headers, &evaluated.reply, evaluated.room))
}

/// From which pose a picture would teach most
#[utoipa::path(post, path = "/api/v1/places/{place}/next_view", tag = "memory",
    params(("place" = String, Path)),
    request_body = described::NextViewRequest,
    responses(
        (status = 200, body = described::NextViewReply),
        Unanswered,
    ))]
async fn next_view(
    State(app): State<App>,
    Path(place): Path<String>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<Response, Problem> {
    let questions = &app.parts.questions;
    let (request, _room) = request(questions, &headers, body)?;
    let place = questions.places.known(&place).await?;
    let ranked = questions.next_view(&place, &request).await?;
    Ok(reply(&headers, &ranked, None))
}

/// Takes something out of the memory, for good
#[utoipa::path(post, path = "/api/v1/places/{place}/forget", tag = "memory",
    params(("place" = String, Path)),
    request_body = described::ForgetRequest,
    responses(
        (status = 200, body = described::ForgetReply),
        Unanswered,
    ))]
async fn forget(
    State(app): State<App>,
    Path(place): Path<String>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<Response, Problem> {
    let questions = &app.parts.questions;
    let (request, _room) = request(questions, &headers, body)?;
    let place = questions.places.known(&place).await?;
    let forgotten = questions.forget(&place, &request).await?;
    Ok(reply(&headers, &forgotten, None))
}

/// Which of the viewpoints.
#[derive(Debug, Deserialize, Default, IntoParams)]
#[serde(default)]
#[into_params(parameter_in = Query)]
struct Page {
    after: u64,
    limit: u32,
}

/// The memory's viewpoints, in the order of their ids
#[utoipa::path(get, path = "/api/v1/places/{place}/views", tag = "memory",
    params(("place" = String, Path), Page),
    responses(
        (status = 200, body = described::ViewsReply),
        Unanswered,
    ))]
async fn views(
    State(app): State<App>,
    Path(place): Path<String>,
    page: Result<Query<Page>, QueryRejection>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let Query(Page { after, limit }) =
        page.map_err(|_| bad("after and limit are whole numbers"))?;
    let questions = &app.parts.questions;
    let place = questions.places.known(&place).await?;
    let request = proto::ViewsRequest { after, limit };
    let views = questions.views(&place, &request).await?;
    Ok(reply(&headers, &views, None))
}

/// How cameras begin
#[utoipa::path(get, path = "/api/v1/places/{place}/mode", tag = "memory",
    params(("place" = String, Path)),
    responses(
        (status = 200, body = described::Mode),
        Unanswered,
    ))]
async fn place_mode(
    State(app): State<App>,
    Path(place): Path<String>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let now = app.parts.questions.mode_of_place(&place, None).await?;
    Ok(reply(&headers, &encode::mode(now), None))
}

/// How all cameras are from now on: learn, observe or freeze
#[utoipa::path(put, path = "/api/v1/places/{place}/mode", tag = "memory",
    params(("place" = String, Path)),
    request_body = described::Mode,
    responses(
        (status = 200, body = described::Mode),
        Unanswered,
    ))]
async fn set_place_mode(
    State(app): State<App>,
    Path(place): Path<String>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<Response, Problem> {
    let questions = &app.parts.questions;
    let (wanted, _room): (proto::Mode, _) = request(questions, &headers, body)?;
    let set = mode(&wanted.mode)?;
    let now = questions.mode_of_place(&place, Some(set)).await?;
    Ok(reply(&headers, &encode::mode(now), None))
}

fn camera_path(place: &str, robot: &str, camera: &str) -> Result<CameraPath, Problem> {
    CameraPath::new(place, robot, camera)
        .ok_or_else(|| Problem::not_found("places, robots and cameras are [a-z0-9_-]+"))
}

/// How a camera's frames are taken
#[utoipa::path(get, path = "/api/v1/places/{place}/robots/{robot}/{camera}/mode", tag = "memory",
    params(("place" = String, Path), ("robot" = String, Path), ("camera" = String, Path)),
    responses(
        (status = 200, body = described::Mode),
        Unanswered,
    ))]
async fn camera_mode(
    State(app): State<App>,
    Path((place, robot, camera)): Path<(String, String, String)>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let path = camera_path(&place, &robot, &camera)?;
    let now = app.parts.questions.mode(&path, None).await?;
    Ok(reply(&headers, &encode::mode(now), None))
}

/// How a camera's frames are taken from now on: learn, observe or freeze
#[utoipa::path(put, path = "/api/v1/places/{place}/robots/{robot}/{camera}/mode", tag = "memory",
    params(("place" = String, Path), ("robot" = String, Path), ("camera" = String, Path)),
    request_body = described::Mode,
    responses(
        (status = 200, body = described::Mode),
        Unanswered,
    ))]
async fn set_camera_mode(
    State(app): State<App>,
    Path((place, robot, camera)): Path<(String, String, String)>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<Response, Problem> {
    let path = camera_path(&place, &robot, &camera)?;
    let questions = &app.parts.questions;
    let (wanted, _room): (proto::Mode, _) = request(questions, &headers, body)?;
    let set = mode(&wanted.mode)?;
    let now = questions.mode(&path, Some(set)).await?;
    Ok(reply(&headers, &encode::mode(now), None))
}
