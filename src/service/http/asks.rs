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
    Router,
    body::{Bytes, to_bytes},
    extract::{
        Path, Query, Request, State,
        rejection::{BytesRejection, QueryRejection},
    },
    http::{HeaderMap, StatusCode, header},
    response::{IntoResponse, Response},
    routing::{get, post},
};
use serde::Deserialize;
use tokio::sync::OwnedSemaphorePermit;

use super::{App, problem::Problem};
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

pub fn routes() -> Router<App> {
    let place = "/api/v1/places/{place}";
    Router::new()
        .route(&format!("{place}/views"), get(views))
        .route(&format!("{place}/prior"), post(prior))
        .route(&format!("{place}/evaluate"), post(evaluate))
        .route(&format!("{place}/next_view"), post(next_view))
        .route(&format!("{place}/forget"), post(forget))
        .route(
            &format!("{place}/mode"),
            get(place_mode).put(set_place_mode),
        )
        .route(
            &format!("{place}/robots/{{robot}}/{{camera}}/mode"),
            get(camera_mode).put(set_camera_mode),
        )
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

async fn prior(
    State(app): State<App>,
    Path(place): Path<String>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<Response, Problem> {
    let questions = &app.parts.questions;
    let (mut request, _room): (proto::PriorRequest, _) = request(questions, &headers, body)?;
    let place = questions.place(&place)?;
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
#[derive(Debug, Deserialize, Default)]
#[serde(default)]
struct Borrowed {
    robot: String,
    camera: String,
}

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
    let place = questions.place(&name)?;
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
    let answer = questions.evaluate(&name, &place, request, camera).await?;
    Ok(reply(&head.headers, &answer, Some(room)))
}

async fn next_view(
    State(app): State<App>,
    Path(place): Path<String>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<Response, Problem> {
    let questions = &app.parts.questions;
    let (request, _room) = request(questions, &headers, body)?;
    let place = questions.place(&place)?;
    let ranked = questions.next_view(&place, &request).await?;
    Ok(reply(&headers, &ranked, None))
}

async fn forget(
    State(app): State<App>,
    Path(place): Path<String>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<Response, Problem> {
    let questions = &app.parts.questions;
    let (request, _room) = request(questions, &headers, body)?;
    let place = questions.place(&place)?;
    let forgotten = questions.forget(&place, &request).await?;
    Ok(reply(&headers, &forgotten, None))
}

/// Which of the viewpoints.
#[derive(Debug, Deserialize, Default)]
#[serde(default)]
struct Page {
    after: u64,
    limit: u32,
}

async fn views(
    State(app): State<App>,
    Path(place): Path<String>,
    page: Result<Query<Page>, QueryRejection>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let Query(Page { after, limit }) =
        page.map_err(|_| bad("after and limit are whole numbers"))?;
    let questions = &app.parts.questions;
    let place = questions.place(&place)?;
    let request = proto::ViewsRequest { after, limit };
    let views = questions.views(&place, &request).await?;
    Ok(reply(&headers, &views, None))
}

async fn place_mode(
    State(app): State<App>,
    Path(place): Path<String>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let now = app.parts.questions.mode_of_place(&place, None).await?;
    Ok(reply(&headers, &encode::mode(now), None))
}

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

async fn camera_mode(
    State(app): State<App>,
    Path((place, robot, camera)): Path<(String, String, String)>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let path = camera_path(&place, &robot, &camera)?;
    let now = app.parts.questions.mode(&path, None).await?;
    Ok(reply(&headers, &encode::mode(now), None))
}

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
