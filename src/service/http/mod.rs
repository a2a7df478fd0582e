//! The service for people and monitors, over HTTP.
//!
//! ```text
//! GET  /                                             the page for people
//! GET  /healthz                                     the process answers
//! GET  /readyz                                      everything is up
//! GET  /metrics                                     OpenMetrics
//! GET  /openapi.json                                all of this, for programs
//! GET  /events                                      what happens, as server-sent events
//! GET  POST DELETE /api/v1/session                  signing in with a browser
//! GET  /api/v1/info                                 version, endpoints, settings
//! GET  /api/v1/places                               names
//! GET  /api/v1/places/{place}                       status and counters
//! GET  /api/v1/places/{place}/views                 the memory's viewpoints
//! GET  /api/v1/places/{place}/events                those that last, and those that ended lately
//! GET  /api/v1/places/{place}/events/{event}        one of them
//! GET  .../events/{event}/{seen|expected}.jpg
//! GET  /api/v1/places/{place}/timeline              surprise of the last quarter of an hour
//! GET  /api/v1/places/{place}/robots/{robot}/{camera}            the camera's status and last report
//! GET  .../robots/{robot}/{camera}/{frame|expected|surprise|uncertainty}.png
//! POST /api/v1/places/{place}/{prior|evaluate|next_view|forget}  questions, see [`asks`]
//! GET  PUT /api/v1/places/{place}/mode, .../robots/{robot}/{camera}/mode
//! ```
//!
//! Status is read from published snapshots; views and pictures are asks to the place's worker. Errors are
//! `application/problem+json`. Everything but the page, the first two, the description and signing in needs the token if
//! there is one.

mod asks;

mod door;

mod extract;

mod limits;

mod page;

mod places;

mod problem;

mod watch;

use std::{net::SocketAddr, sync::Arc, time::Duration};

use axum::{
    Router,
    extract::{DefaultBodyLimit, FromRef, State},
    http::{StatusCode, header},
    middleware,
    response::{IntoResponse, Response},
};
use prometheus_client::registry::Registry;
use serde_json::{Value, json};
use tokio::{net::TcpListener, sync::oneshot, task::JoinHandle, time::timeout};
use tower_http::timeout::TimeoutLayer;
use utoipa::{OpenApi, openapi};
use utoipa_axum::{router::OpenApiRouter, routes};

use self::{door::Door, limits::LimitedListener, problem::Problem};
use super::{
    access::HttpAccess, ingest::IngestCounters, live::Live, metrics, places::Places,
    questions::Questions, readiness::Readiness,
};
/// A picture waits for the camera's next frame at most.
const REQUEST_WITHIN: Duration = Duration::from_secs(10);
/// Requests under way when the service stops.
const FINISH_WITHIN: Duration = Duration::from_secs(2);
const BODY_BYTES_MAX: usize = 1 << 20;
const OPENMETRICS: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// Filled in when the session is open.
#[derive(Clone)]
pub struct Parts {
    pub places: Arc<Places>,
    pub counters: Arc<IngestCounters>,
    pub locators: Vec<String>,
    pub live: Arc<Live>,
    pub questions: Arc<Questions>,
}

#[derive(Clone)]
struct App {
    readiness: Readiness,
    parts: Parts,
    registry: Arc<Registry>,
    clients: watch::Clients,
    door: Arc<Door>,
}

impl FromRef<App> for Arc<Door> {
    fn from_ref(app: &App) -> Self {
        app.door.clone()
    }
}

/// A bound server; it ends when dropped or stopped.
pub struct Server {
    pub addr: SocketAddr,
    live: Arc<Live>,
    stop: Option<oneshot::Sender<()>>,
    task: JoinHandle<()>,
}

impl Server {
    /// Lets requests under way finish, for a while; those who watch are let go.
    pub async fn stop(mut self) {
        self.live.close();
        // The receiver is gone only if the task is.
        if let Some(stop) = self.stop.take() {
            let _ = stop.send(());
        }
        match timeout(FINISH_WITHIN, &mut self.task).await {
            Ok(Ok(())) => {}
            Ok(Err(error)) => tracing::warn!("the HTTP server failed: {error}"),
            // Somebody does not read what was sent.
            Err(_) => self.task.abort(),
        }
    }
}

/// Serves on a listener that is already bound.
///
/// # Errors
/// The listener has no address, or the system no random numbers.
pub fn start(
    listener: TcpListener,
    readiness: Readiness,
    access: HttpAccess,
    parts: Parts,
) -> std::io::Result<Server> {
    let addr = listener.local_addr()?;
    let (stop, stopped) = oneshot::channel::<()>();
    let live = parts.live.clone();
    let metrics = parts.places.metrics.clone();
    let app = App {
        registry: Arc::new(metrics.registry(&parts.places, parts.counters.clone())),
        clients: watch::Clients::new(metrics.clone()),
        door: Arc::new(Door::new(access, metrics)?),
        readiness,
        parts,
    };
    let router = router(app);
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
        live,
        stop: Some(stop),
        task,
    })
}

#[derive(OpenApi)]
#[openapi(
    info(
        title = "surprised",
        description = "The surprise daemon: remembers how places look and notices when they look different. Metres, radians, nats, pixels; world_from_camera poses; camera axes x right, y down, z forward.",
        license(name = "MIT OR Apache-2.0", identifier = "MIT OR Apache-2.0")
    ),
    security((), ("token" = []), ("session" = [])),
    tags(
        (name = "service", description = "The process"),
        (name = "places", description = "What is known and seen"),
        (name = "memory", description = "What is remembered: questions, modes, forgetting"),
        (name = "events", description = "What has happened"),
        (name = "session", description = "Signing in with a browser"),
    )
)]
struct Description;

fn router(app: App) -> Router {
    let guarded = OpenApiRouter::new()
        .routes(routes!(prometheus))
        .routes(routes!(info))
        .routes(routes!(places::list))
        .routes(routes!(places::status))
        .routes(routes!(places::camera))
        .routes(routes!(places::picture))
        .routes(routes!(watch::stream))
        .routes(routes!(watch::events))
        .routes(routes!(watch::event))
        .routes(routes!(watch::event_picture))
        .routes(routes!(watch::timeline))
        .merge(asks::routes())
        .route_layer(middleware::from_fn_with_state(
            app.door.clone(),
            door::token,
        ));
    let (router, description) = OpenApiRouter::with_openapi(Description::openapi())
        .routes(routes!(healthz))
        .routes(routes!(readyz))
        .routes(routes!(door::session, door::sign_in, door::sign_out))
        .merge(guarded)
        .split_for_parts();
    let description: Arc<str> = described(description).to_string().into();
    router
        .merge(page::routes())
        .route(
            "/openapi.json",
            axum::routing::get(move || {
                let json = [(header::CONTENT_TYPE, "application/json")];
                let description = description.to_string();
                async move { (json, description) }
            }),
        )
        .fallback(|| async {
            Problem::not_found(
                "there is no such page: /api/v1/places is a start, /openapi.json has all",
            )
        })
        .method_not_allowed_fallback(|| async { Problem::of(StatusCode::METHOD_NOT_ALLOWED) })
        .layer(TimeoutLayer::with_status_code(
            StatusCode::GATEWAY_TIMEOUT,
            REQUEST_WITHIN,
        ))
        .layer(DefaultBodyLimit::max(BODY_BYTES_MAX))
        .layer(middleware::from_fn_with_state(
            app.door.clone(),
            door::guard,
        ))
        .with_state(app)
}

/// With how to sign in, and with what only the messages' own description knows.
fn described(description: openapi::OpenApi) -> Value {
    let mut description = serde_json::to_value(&description).expect("descriptions map to JSON");
    let components = &mut description["components"];
    components["securitySchemes"] = json!({
        "token": { "type": "http", "scheme": "bearer" },
        "session": { "type": "apiKey", "in": "cookie", "name": door::COOKIE },
    });
    let schemas = &mut components["schemas"];
    for (name, schema) in message::schemas() {
        schemas[name] = schema;
    }
    // Every answer must have a description; that of a plain success is its operation's summary.
    let paths = description["paths"].as_object_mut().into_iter().flatten();
    let operations = paths.flat_map(|(_, path)| path.as_object_mut().into_iter().flatten());
    for (_, operation) in operations {
        let summary = operation["summary"].clone();
        let responses = operation["responses"].as_object_mut().into_iter().flatten();
        for (_, response) in responses {
            if response["description"].is_null() {
                response["description"] = summary.clone();
            }
        }
    }
    description
}

/// Stand for messages of the contract, whose own descriptions take their places.
mod message {
    use serde_json::Value;
    use utoipa::ToSchema;

    use crate::wire::{proto, schema};

    macro_rules! messages {
        ($($direction:ident $name:ident),* $(,)?) => {
            $(
                #[derive(ToSchema)]
                pub struct $name {}
            )*

            pub fn schemas() -> Vec<(&'static str, Value)> {
                vec![$((stringify!($name), schema::$direction::<proto::$name>())),*]
            }
        };
    }

    messages!(
        reply Event,
        reply SurpriseReport,
        reply ViewsReply,
        request PriorRequest,
        reply PriorReply,
        request EvaluateRequest,
        reply EvaluateReply,
        request NextViewRequest,
        reply NextViewReply,
        request ForgetRequest,
        reply ForgetReply,
        request Mode,
    );
}

/// Whether the process answers
#[utoipa::path(get, path = "/healthz", tag = "service", security(()),
    responses((status = 200, body = String, content_type = "text/plain")))]
async fn healthz() -> &'static str {
    "ok\n"
}

/// Whether everything is up
#[utoipa::path(get, path = "/readyz", tag = "service", security(()),
    responses(
        (status = 200, body = String, content_type = "text/plain"),
        (status = 503, description = "What is not up", body = problem::Document,
            content_type = "application/problem+json"),
    ))]
async fn readyz(State(app): State<App>) -> Response {
    let mut missing = app.readiness.missing();
    for (name, place) in app.parts.places.all() {
        let store = place.status.borrow().totals.store.clone();
        if let Some(trouble) = store.and_then(|store| store.trouble) {
            missing.push(format!("the stored memory of {name} ({trouble})"));
        }
    }
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

/// What Prometheus scrapes, as OpenMetrics
#[utoipa::path(get, path = "/metrics", tag = "service",
    responses(
        (status = 200, body = String, content_type = "application/openmetrics-text"),
        problem::Refused,
    ))]
async fn prometheus(State(app): State<App>) -> Response {
    let text = metrics::text(&app.registry);
    ([(header::CONTENT_TYPE, OPENMETRICS)], text).into_response()
}

/// Version, endpoints and every setting
#[utoipa::path(get, path = "/api/v1/info", tag = "service",
    responses(
        (status = 200, body = Object),
        problem::Refused,
    ))]
async fn info(State(app): State<App>) -> axum::Json<Value> {
    let places = &app.parts.places;
    axum::Json(json!({
        "name": env!("CARGO_PKG_NAME"),
        "version": env!("CARGO_PKG_VERSION"),
        "boot": app.parts.live.boot.to_string(),
        "root": &*places.root,
        "zenoh": { "id": places.session.zid().to_string(), "locators": app.parts.locators },
        "settings": places.settings,
        "ingest": &*app.parts.counters,
    }))
}
