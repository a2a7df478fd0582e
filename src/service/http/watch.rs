//! What happens: the stream of server-sent events, the list of events, the timeline.

use std::{collections::VecDeque, convert::Infallible, sync::Arc, time::Duration};

use axum::{
    extract::State,
    http::{HeaderMap, StatusCode, header},
    response::{
        IntoResponse, Response,
        sse::{Event as Sent, KeepAlive, Sse},
    },
};
use futures_util::{Stream, stream};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, broadcast::error::RecvError};
use utoipa::{IntoParams, ToSchema};

use super::{
    App,
    extract::{Path, Query},
    message,
    places::known,
    problem::{Document, Problem, Refused},
};
use crate::{
    service::{
        events::ENDED_MAX,
        live::{CameraTimeline, Live, Message, Watching, now_ms},
        metrics::Metrics,
    },
    stages::events::OPEN_MAX,
    wire::{encode, proto},
};

/// Each is a connection and a place in the ring.
const CLIENTS_MAX: usize = 256;
/// Says that the service is still there where nothing happens.
const ALIVE_EVERY: Duration = Duration::from_secs(10);
/// How soon a browser comes back.
const COME_BACK: Duration = Duration::from_secs(2);
const LIST_MAX: usize = OPEN_MAX + ENDED_MAX;

/// Who watches.
#[derive(Clone)]
pub struct Clients {
    permits: Arc<Semaphore>,
    metrics: Arc<Metrics>,
}

impl Clients {
    pub fn new(metrics: Arc<Metrics>) -> Self {
        Self {
            permits: Arc::new(Semaphore::new(CLIENTS_MAX)),
            metrics,
        }
    }
}

#[derive(Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
pub struct Which {
    /// Only of this place.
    place: Option<String>,
}

/// One who watches.
struct Client {
    live: Arc<Live>,
    watching: Watching,
    place: Option<String>,
    /// What goes out before anything new.
    next: VecDeque<Sent>,
    metrics: Arc<Metrics>,
    _permit: OwnedSemaphorePermit,
}

impl Drop for Client {
    fn drop(&mut self) {
        self.metrics.sse_clients.dec();
        // What it never took, of what the ring could keep.
        let left = self.watching.messages.len() as u64;
        if left > 0 {
            self.metrics.sse_lagged.inc_by(left);
        }
    }
}

/// What happens, as server-sent events
///
/// `hello` once, then `state` (places and cameras that have changed, at most four times a second), `event` (an event that
/// is new, has news, or has ended; with an id to resume from), and `reset` where messages were lost.
#[utoipa::path(get, path = "/events", tag = "events",
    params(Which, ("Last-Event-ID" = Option<String>, Header, description = "Where a stream that broke is to go on")),
    responses(
        (status = 200, body = String, content_type = "text/event-stream"),
        (status = "4XX", description = "No token", body = Document,
            content_type = "application/problem+json"),
        (status = 503, description = "Too many watch", body = Document,
            content_type = "application/problem+json"),
    ))]
pub async fn stream(
    State(app): State<App>,
    Query(which): Query<Which>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let Clients { permits, metrics } = app.clients.clone();
    let Ok(permit) = permits.try_acquire_owned() else {
        metrics.sse_refused.inc();
        return Err(Problem::new(
            StatusCode::SERVICE_UNAVAILABLE,
            "too_many_clients",
            format!(
                "{CLIENTS_MAX} watch already: close a page, or ask /api/v1/places from time to time"
            ),
        ));
    };
    let known = headers
        .get("last-event-id")
        .and_then(|id| id.to_str().ok()?.split_once('-'))
        .and_then(|(boot, number)| Some((boot.parse().ok()?, number.parse().ok()?)));
    let live = app.parts.live.clone();
    let watching = live.watch(known).ok_or_else(|| {
        Problem::new(
            StatusCode::SERVICE_UNAVAILABLE,
            "closing",
            "the service is stopping",
        )
    })?;
    metrics.sse_clients.inc();
    let mut client = Client {
        live,
        watching,
        place: which.place,
        next: VecDeque::new(),
        metrics,
        _permit: permit,
    };
    client.begin();
    let alive = KeepAlive::new().interval(ALIVE_EVERY).text("alive");
    // Proxies must not keep it to themselves.
    let headers = [("x-accel-buffering", "no")];
    Ok((headers, Sse::new(messages(client)).keep_alive(alive)).into_response())
}

fn messages(client: Client) -> impl Stream<Item = Result<Sent, Infallible>> {
    stream::unfold(client, |mut client| async move {
        let sent = client.next().await?;
        Some((Ok(sent), client))
    })
}

impl Client {
    fn begin(&mut self) {
        let text = json!({
            "boot": self.live.boot.to_string(),
            "version": env!("CARGO_PKG_VERSION"),
            "resumed": self.watching.resumed,
            "now_ms": now_ms(),
        });
        let hello = Sent::default().event("hello").retry(COME_BACK);
        let hello = hello.data(text.to_string());
        self.next.push_back(hello);
        self.look_around();
        for message in std::mem::take(&mut self.watching.missed) {
            self.next.extend(self.of_interest(&message));
        }
    }

    /// Everything as it is now.
    fn look_around(&mut self) {
        for (place, json) in self.live.states() {
            if self.is_watched(&place) {
                self.next
                    .push_back(Sent::default().event("state").data(json));
            }
        }
    }

    fn is_watched(&self, place: &str) -> bool {
        self.place.as_ref().is_none_or(|only| only == place)
    }

    fn of_interest(&self, message: &Message) -> Option<Sent> {
        match message {
            Message::State { place, json } if self.is_watched(place) => {
                Some(Sent::default().event("state").data(json))
            }
            Message::Event {
                number,
                place,
                json,
            } if self.is_watched(place) => {
                let id = self.live.event_id(*number);
                Some(Sent::default().event("event").id(id).data(json))
            }
            Message::Reset => Some(Sent::default().event("reset").data("{}")),
            Message::State { .. } | Message::Event { .. } => None,
        }
    }

    /// `None` when the service is stopping.
    async fn next(&mut self) -> Option<Sent> {
        loop {
            if let Some(sent) = self.next.pop_front() {
                return Some(sent);
            }
            match self.watching.messages.recv().await {
                Ok(message) => {
                    if matches!(*message, Message::Reset) {
                        self.look_around();
                    }
                    if let Some(sent) = self.of_interest(&message) {
                        return Some(sent);
                    }
                }
                Err(RecvError::Lagged(lost)) => {
                    self.metrics.sse_lagged.inc_by(lost);
                    self.look_around();
                    return self.of_interest(&Message::Reset);
                }
                Err(RecvError::Closed) => return None,
            }
        }
    }
}

#[derive(Deserialize, Default, Clone, Copy, PartialEq, Eq, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Lasting {
    Open,
    Ended,
    #[default]
    All,
}

#[derive(Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
pub struct Wanted {
    /// Those that last, those that ended lately, or all.
    #[serde(default)]
    #[param(inline)]
    state: Lasting,
    /// At most so many.
    #[param(minimum = 1, maximum = 320)]
    limit: Option<usize>,
}

/// For the description only.
#[derive(ToSchema)]
#[expect(dead_code, reason = "described, not made")]
pub struct EventList {
    /// The newest first; those that last before those that ended.
    events: Vec<message::Event>,
    /// How many there are of each, wanted or not.
    open: usize,
    ended: usize,
    /// Of /events: up to here the list is true.
    last_event_id: String,
}

/// The events of a place: those that last, and those that ended lately
#[utoipa::path(get, path = "/api/v1/places/{place}/events", tag = "events",
    params(("place" = String, Path), Wanted),
    responses(
        (status = 200, body = EventList),
        Refused,
    ))]
pub async fn events(
    State(app): State<App>,
    Path(place): Path<String>,
    Query(wanted): Query<Wanted>,
) -> Result<axum::Json<Value>, Problem> {
    let limit = wanted.limit.unwrap_or(LIST_MAX);
    if !(1..=LIST_MAX).contains(&limit) {
        return Err(Problem::new(
            StatusCode::BAD_REQUEST,
            "bad_request",
            format!("limit is between 1 and {LIST_MAX}"),
        ));
    }
    let place = known(&app, &place).await?;
    // Before the list: what comes in between is in both.
    let last_event_id = app.parts.live.last_event_id();
    let events = place.events.borrow().clone();
    let open = events.open().filter(|_| wanted.state != Lasting::Ended);
    let ended = events.ended().filter(|_| wanted.state != Lasting::Open);
    let list: Vec<Value> = open
        .chain(ended)
        .take(limit)
        .map(|event| encode::event_json(event))
        .collect();
    Ok(axum::Json(json!({
        "events": list,
        "open": events.open().len(),
        "ended": events.ended().len(),
        "last_event_id": last_event_id,
    })))
}

async fn find(app: &App, place: &str, id: &str) -> Result<Arc<proto::Event>, Problem> {
    let events = known(app, place).await?.events.borrow().clone();
    let event = id.parse().ok().and_then(|id| events.get(id));
    event.cloned().ok_or_else(|| {
        Problem::not_found(
            "there is no such event: it may have ended long ago, or before a restart",
        )
    })
}

/// One event
#[utoipa::path(get, path = "/api/v1/places/{place}/events/{event}", tag = "events",
    params(("place" = String, Path), ("event" = String, Path)),
    responses(
        (status = 200, body = message::Event),
        Refused,
    ))]
pub async fn event(
    State(app): State<App>,
    Path((place, id)): Path<(String, String)>,
) -> Result<axum::Json<Value>, Problem> {
    Ok(axum::Json(encode::event_json(
        &*find(&app, &place, &id).await?,
    )))
}

/// An event's box and its surroundings at its peak
#[utoipa::path(get, path = "/api/v1/places/{place}/events/{event}/{picture}", tag = "events",
    params(("place" = String, Path), ("event" = String, Path),
        ("picture" = String, Path, description = "seen.jpg or expected.jpg")),
    responses(
        (status = 200, body = Vec<u8>, content_type = "image/jpeg"),
        Refused,
    ))]
pub async fn event_picture(
    State(app): State<App>,
    Path((place, id, picture)): Path<(String, String, String)>,
) -> Result<Response, Problem> {
    let event = find(&app, &place, &id).await?;
    let image = match picture.as_str() {
        "seen.jpg" => event.picture.as_ref(),
        "expected.jpg" => event.expected_picture.as_ref(),
        _ => None,
    };
    let image =
        image.ok_or_else(|| Problem::not_found("there are seen.jpg and, mostly, expected.jpg"))?;
    let headers = [(header::CONTENT_TYPE, "image/jpeg")];
    Ok((headers, image.data.clone()).into_response())
}

#[derive(Serialize, ToSchema)]
pub struct Timeline {
    place: String,
    seconds_per_point: u32,
    cameras: Vec<CameraTimeline>,
}

/// Surprise of the last quarter of an hour, a point a second
#[utoipa::path(get, path = "/api/v1/places/{place}/timeline", tag = "events",
    params(("place" = String, Path)),
    responses(
        (status = 200, body = Timeline),
        Refused,
    ))]
pub async fn timeline(
    State(app): State<App>,
    Path(place): Path<String>,
) -> Result<axum::Json<Timeline>, Problem> {
    known(&app, &place).await?;
    Ok(axum::Json(Timeline {
        cameras: app.parts.live.timeline(&place),
        seconds_per_point: 1,
        place,
    }))
}
