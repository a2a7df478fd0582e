//! Places, their viewpoints, their cameras, and what these see.

use std::sync::Arc;

use axum::{
    extract::State,
    http::{HeaderName, header},
    response::{IntoResponse, Response},
};
use serde::Serialize;
use serde_json::{Value, json};
use utoipa::ToSchema;

use super::{
    App,
    extract::Path,
    message,
    problem::{Document, Problem, Refused},
};
use crate::{
    model::{
        frame::{RgbImage, Source},
        refusal::Refusal,
    },
    service::{
        ask::Snapshot,
        live::{CameraState, PlaceState},
        places::Place,
    },
    wire::{encode, picture as draw},
};

/// Nats a pixel that are shown white.
const SURPRISE_FULL: f32 = 60.0;
/// Standard deviation, grey levels, that is shown white.
const UNCERTAINTY_FULL: f32 = 60.0;

#[derive(Serialize, ToSchema)]
pub struct PlaceNames {
    places: Vec<String>,
}

/// The places' names
#[utoipa::path(get, path = "/api/v1/places", tag = "places",
    responses(
        (status = 200, body = PlaceNames),
        Refused,
    ))]
pub async fn list(State(app): State<App>) -> axum::Json<PlaceNames> {
    let places = app.parts.places.all();
    axum::Json(PlaceNames {
        places: places
            .into_iter()
            .map(|(name, _)| name.to_string())
            .collect(),
    })
}

pub async fn known(app: &App, place: &str) -> Result<Arc<Place>, Problem> {
    Ok(app.parts.places.known(place).await?)
}

/// A place and its cameras: state and counters
#[utoipa::path(get, path = "/api/v1/places/{place}", tag = "places",
    params(("place" = String, Path)),
    responses(
        (status = 200, body = PlaceState),
        Refused,
    ))]
pub async fn status(
    State(app): State<App>,
    Path(place): Path<String>,
) -> Result<axum::Json<PlaceState>, Problem> {
    let status = known(&app, &place).await?.status.borrow().clone();
    Ok(axum::Json(app.parts.live.state_of(&status)))
}

/// For the description only.
#[derive(ToSchema)]
#[expect(dead_code, reason = "described, not made")]
pub struct CameraReply {
    status: CameraState,
    report: Option<message::SurpriseReport>,
}

/// A camera's state and its last report
#[utoipa::path(get, path = "/api/v1/places/{place}/robots/{robot}/{camera}", tag = "places",
    params(("place" = String, Path), ("robot" = String, Path), ("camera" = String, Path)),
    responses(
        (status = 200, body = CameraReply),
        Refused,
    ))]
pub async fn camera(
    State(app): State<App>,
    Path((place, robot, camera)): Path<(String, String, String)>,
) -> Result<axum::Json<Value>, Problem> {
    let status = known(&app, &place).await?.status.borrow().clone();
    let state = app.parts.live.state_of(&status);
    let camera = state
        .cameras
        .iter()
        .find(|known| known.status.robot == robot && known.status.camera == camera)
        .ok_or_else(|| Refusal::new("unknown_camera", "no frame of this camera has come yet"))?;
    Ok(axum::Json(json!({
        "status": camera,
        "report": camera.status.report.as_deref().map(encode::json),
    })))
}

type Draw = fn(&Snapshot) -> RgbImage;

/// What the camera saw last, what was expected, and what was thought of it
#[utoipa::path(get, path = "/api/v1/places/{place}/robots/{robot}/{camera}/{picture}", tag = "places",
    params(("place" = String, Path), ("robot" = String, Path), ("camera" = String, Path),
        ("picture" = String, Path, description = "frame.png, expected.png, surprise.png or uncertainty.png")),
    responses(
        (status = 200, description = "Of which frame, the headers surprised-sequence and surprised-stamp-ns say",
            body = Vec<u8>, content_type = "image/png"),
        (status = "4XX", description = "No such camera or picture, or no token", body = Document,
            content_type = "application/problem+json"),
        (status = 503, description = "Busy", body = Document,
            content_type = "application/problem+json"),
        (status = 504, description = "The camera sends no frames", body = Document,
            content_type = "application/problem+json"),
    ))]
pub async fn picture(
    State(app): State<App>,
    Path((place, robot, camera, picture)): Path<(String, String, String, String)>,
) -> Result<Response, Problem> {
    let draw: Draw = match picture.as_str() {
        "frame.png" => |snapshot| (*snapshot.frame).clone(),
        "expected.png" => |snapshot| snapshot.expected.clone(),
        "surprise.png" => |snapshot| heat(snapshot, &snapshot.surprise, SURPRISE_FULL),
        "uncertainty.png" => |snapshot| {
            let deviation: Vec<f32> = snapshot.uncertainty.iter().map(|v| v.sqrt()).collect();
            heat(snapshot, &deviation, UNCERTAINTY_FULL)
        },
        _ => {
            return Err(Problem::not_found(
                "there are frame.png, expected.png, surprise.png and uncertainty.png",
            ));
        }
    };
    let place = known(&app, &place).await?;
    let camera = Source {
        robot: robot.into(),
        camera: camera.into(),
    };
    let snapshot = app.parts.questions.picture(&place, camera).await?;
    let report = snapshot.report.clone();
    let png = tokio::task::spawn_blocking(move || draw::png(&draw(&snapshot)))
        .await
        .map_err(|error| {
            tracing::error!("no picture: {error}");
            Problem::of(axum::http::StatusCode::INTERNAL_SERVER_ERROR)
        })?;
    let stamp = report.stamp.unwrap_or_default();
    let headers = [
        (header::CONTENT_TYPE, "image/png".to_owned()),
        (
            HeaderName::from_static("surprised-sequence"),
            report.sequence.to_string(),
        ),
        (
            HeaderName::from_static("surprised-stamp-ns"),
            format!("{}{:09}", stamp.seconds, stamp.nanos),
        ),
    ];
    Ok((headers, png).into_response())
}

fn heat(snapshot: &Snapshot, values: &[f32], full: f32) -> RgbImage {
    draw::heat(snapshot.frame.width, snapshot.frame.height, values, full)
}
