//! The service for people and monitors, over HTTP.
//!
//! ```text
//! GET /healthz                                      the process answers
//! GET /readyz                                       everything is up
//! GET /api/v1/info                                  version, endpoints, settings
//! GET /api/v1/places                                names
//! GET /api/v1/places/{place}                        status and counters
//! GET /api/v1/places/{place}/views                  the memory's viewpoints
//! GET /api/v1/places/{place}/robots/{robot}/{camera}            the camera's status and last report
//! GET .../robots/{robot}/{camera}/{frame|expected|surprise|uncertainty}.png
//! POST /api/v1/places/{place}/{prior|evaluate|next_view|forget}     questions, see [`asks`]
//! GET, PUT /api/v1/places/{place}/mode, .../robots/{robot}/{camera}/mode
//! ```
//!
//! Status is read from published snapshots; everything else is asked of the place's worker. Errors are
//! `application/problem+json`.

mod asks;

mod limits;

mod problem;

use std::{net::SocketAddr, sync::Arc, time::Duration};

use axum::{
    Json, Router,
    extract::{DefaultBodyLimit, Path, State},
    http::{StatusCode, header},
    response::{IntoResponse, Response},
    routing::get,
};
use serde_json::{Value, json};
use tokio::{net::TcpListener, sync::oneshot, task::JoinHandle};
use tower_http::timeout::TimeoutLayer;

use self::{limits::LimitedListener, problem::Problem};
use super::{
    ask::{Ask, Snapshot},
    ingest::IngestCounters,
    places::{Place, Places},
    questions::Questions,
    readiness::Readiness,
};
use crate::{
    model::frame::{RgbImage, Source},
    wire::{encode, picture},
};

/// A picture waits for the camera's next frame at most.
const REQUEST_WITHIN: Duration = Duration::from_secs(10);
const BODY_BYTES_MAX: usize = 1 << 20;
/// Nats a pixel that are shown white.
const SURPRISE_FULL: f32 = 60.0;
/// Standard deviation, grey levels, that is shown white.
const UNCERTAINTY_FULL: f32 = 60.0;

/// Filled in when the session is open.
#[derive(Clone)]
pub struct Parts {
    pub places: Arc<Places>,
    pub counters: Arc<IngestCounters>,
    pub locators: Vec<String>,
    pub questions: Arc<Questions>,
}

#[derive(Clone)]
struct App {
    readiness: Readiness,
    parts: Parts,
}

/// A bound server; it ends when dropped or stopped.
pub struct Server {
    pub addr: SocketAddr,
    stop: Option<oneshot::Sender<()>>,
    task: JoinHandle<()>,
}

impl Server {
    /// Lets requests under way finish.
    pub async fn stop(mut self) {
        // The receiver is gone only if the task is.
        if let Some(stop) = self.stop.take() {
            let _ = stop.send(());
        }
        if let Err(error) = self.task.await {
            tracing::warn!("the HTTP server failed: {error}");
        }
    }
}

/// Serves on a listener that is already bound.
///
/// # Errors
/// The listener has no address.
pub fn start(listener: TcpListener, readiness: Readiness, parts: Parts) -> std::io::Result<Server> {
    let addr = listener.local_addr()?;
    let (stop, stopped) = oneshot::channel::<()>();
    let router = router(App { readiness, parts });
    let task = tokio::spawn(async move {
        let server = axum::serve(LimitedListener::new(listener), router).with_graceful_shutdown(
            async move {
                // Stopped, or dropped: both end it.
                drop(stopped.await);
            },
        );
        if let Err(error) = server.await {
            tracing::error!("the HTTP server failed: {error}");
        }
    });
    Ok(Server {
        addr,
        stop: Some(stop),
        task,
    })
}

fn router(app: App) -> Router {
    let camera = "/api/v1/places/{place}/robots/{robot}/{camera}";
    Router::new()
        .route("/healthz", get(|| async { "ok\n" }))
        .route("/readyz", get(readyz))
        .route("/api/v1/info", get(info))
        .route("/api/v1/places", get(places))
        .route("/api/v1/places/{place}", get(place_status))
        .route(camera, get(camera_status))
        .route(&format!("{camera}/{{picture}}"), get(camera_picture))
        .merge(asks::routes())
        .fallback(|| async {
            Problem::not_found("there is no such page: /api/v1/places is a start")
        })
        .method_not_allowed_fallback(|| async {
            Problem::new(
                StatusCode::METHOD_NOT_ALLOWED,
                "method",
                "this page is not asked for in this way: most are read with GET, questions are asked with POST, modes are set with PUT",
            )
        })
        .layer(TimeoutLayer::with_status_code(
            StatusCode::GATEWAY_TIMEOUT,
            REQUEST_WITHIN,
        ))
        .layer(DefaultBodyLimit::max(BODY_BYTES_MAX))
        .with_state(app)
}

async fn readyz(State(app): State<App>) -> Response {
    let mut missing = app.readiness.missing();
    let card = app.parts.places.engines.card();
    // Where the processor has taken over there is nothing to wait for.
    if card.is_some_and(|card| card.is_awaited()) {
        missing.push("graphics card".to_owned());
    }
    if missing.is_empty() {
        "ready\n".into_response()
    } else {
        Problem::new(
            StatusCode::SERVICE_UNAVAILABLE,
            "not_ready",
            format!("not up: {}", missing.join(", ")),
        )
        .into_response()
    }
}

async fn info(State(app): State<App>) -> Json<Value> {
    let places = &app.parts.places;
    Json(json!({
        "name": env!("CARGO_PKG_NAME"),
        "version": env!("CARGO_PKG_VERSION"),
        "root": &*places.root,
        "zenoh": { "id": places.session.zid().to_string(), "locators": app.parts.locators },
        "settings": places.settings,
        "ingest": &*app.parts.counters,
    }))
}

async fn places(State(app): State<App>) -> Json<Value> {
    let names: Vec<String> = app
        .parts
        .places
        .all()
        .into_iter()
        .map(|(name, _)| name.to_string())
        .collect();
    Json(json!({ "places": names }))
}

fn known(app: &App, place: &str) -> Result<Arc<Place>, Problem> {
    app.parts
        .places
        .get(place)
        .ok_or_else(|| Problem::not_found("this place is unknown: it begins with its first frame"))
}

async fn place_status(
    State(app): State<App>,
    Path(place): Path<String>,
) -> Result<Json<Value>, Problem> {
    let status = known(&app, &place)?.status.borrow().clone();
    Ok(Json(json!(*status)))
}

async fn camera_status(
    State(app): State<App>,
    Path((place, robot, camera)): Path<(String, String, String)>,
) -> Result<Json<Value>, Problem> {
    let status = known(&app, &place)?.status.borrow().clone();
    let camera = status
        .cameras
        .iter()
        .find(|known| known.robot == robot && known.camera == camera)
        .ok_or_else(|| Problem::not_found("no frame of this camera has come yet"))?;
    Ok(Json(json!({
        "status": camera,
        "report": camera.report.as_deref().map(encode::json),
    })))
}

type Draw = fn(&Snapshot) -> RgbImage;

async fn camera_picture(
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
    let place = known(&app, &place)?;
    let camera = Source {
        robot: robot.into(),
        camera: camera.into(),
    };
    let questions = &app.parts.questions;
    let snapshot = questions
        .ask(&place, |answer| Ask::Snapshot { camera, answer })
        .await?;
    let png = tokio::task::spawn_blocking(move || picture::png(&draw(&snapshot)))
        .await
        .map_err(|error| {
            Problem::new(
                StatusCode::INTERNAL_SERVER_ERROR,
                "picture",
                error.to_string(),
            )
        })?;
    Ok((
        [
            (header::CONTENT_TYPE, "image/png"),
            (header::CACHE_CONTROL, "no-store"),
        ],
        png,
    )
        .into_response())
}

fn heat(snapshot: &Snapshot, values: &[f32], full: f32) -> RgbImage {
    picture::heat(snapshot.frame.width, snapshot.frame.height, values, full)
}
