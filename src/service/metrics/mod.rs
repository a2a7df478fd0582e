//! What `/metrics` tells, in OpenMetrics. Counts that a place publishes about itself are read from there, in [`places`];
//! the rest is counted here. Labels are bounded: at most 16 places, fixed sets of reasons, stages and outcomes, and no robots.

mod places;

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use prometheus_client::{
    encoding::{EncodeLabelSet, text},
    metrics::{
        counter::Counter,
        family::Family,
        gauge::Gauge,
        histogram::{Histogram, exponential_buckets},
        info::Info,
    },
    registry::{Registry, Unit},
};

use self::places::OfPlaces;
use super::{ingest::IngestCounters, places::Places};
use crate::{
    pipeline::Stage,
    wire::encode::{EVENT_KINDS, EVENT_STATES},
};

/// Half a millisecond to a second: from a stage of a small image to depth from three cameras.
fn seconds() -> Histogram {
    Histogram::new(exponential_buckets(0.0005, 2.0, 12))
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct OfPlace {
    place: String,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct OfStage {
    place: String,
    stage: &'static str,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct OfQuery {
    kind: &'static str,
    outcome: &'static str,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct OfEvent {
    place: String,
    kind: String,
    state: String,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct OfStatus {
    status: &'static str,
}

const STAGES: [&str; 7] = [
    "decode", "depth", "refine", "compare", "attend", "remember", "publish",
];

type Histograms<L> = Family<L, Histogram, fn() -> Histogram>;

/// Counted where it happens.
#[derive(Debug, Clone)]
pub struct Metrics {
    stages: Histograms<OfStage>,
    frames: Histograms<OfPlace>,
    queries: Family<OfQuery, Counter>,
    events: Family<OfEvent, Counter>,
    responses: Family<OfStatus, Counter>,
    pub sse_clients: Gauge,
    /// Messages that a client was too slow for.
    pub sse_lagged: Counter,
    pub sse_refused: Counter,
    pub unauthorized: Counter,
    /// What the workers had to say to the watchers and nobody took in time.
    pub news_dropped: Counter,
}

impl Default for Metrics {
    fn default() -> Self {
        Self {
            stages: Family::new_with_constructor(seconds),
            frames: Family::new_with_constructor(seconds),
            queries: Family::default(),
            events: Family::default(),
            responses: Family::default(),
            sse_clients: Gauge::default(),
            sse_lagged: Counter::default(),
            sse_refused: Counter::default(),
            unauthorized: Counter::default(),
            news_dropped: Counter::default(),
        }
    }
}

impl Metrics {
    /// `outcome`: ok, or a refusal's code.
    pub fn query(&self, kind: &'static str, outcome: &'static str) {
        self.queries.get_or_create(&OfQuery { kind, outcome }).inc();
    }

    pub fn event(&self, place: &str, kind: &str, state: &str) {
        let labels = OfEvent {
            place: place.to_owned(),
            kind: kind.to_owned(),
            state: state.to_owned(),
        };
        self.events.get_or_create(&labels).inc();
    }

    /// A place that is not here any more.
    pub fn forget(&self, place: &str) {
        let place = place.to_owned();
        for stage in STAGES {
            let place = place.clone();
            self.stages.remove(&OfStage { place, stage });
        }
        for kind in EVENT_KINDS {
            for state in EVENT_STATES {
                self.events.remove(&OfEvent {
                    place: place.clone(),
                    kind: kind.to_owned(),
                    state: state.to_owned(),
                });
            }
        }
        self.frames.remove(&OfPlace { place });
    }

    /// An answer over HTTP, by its status.
    pub fn response(&self, status: u16) {
        let status = match status {
            0..300 => "2xx",
            300..400 => "3xx",
            400..500 => "4xx",
            _ => "5xx",
        };
        self.responses.get_or_create(&OfStatus { status }).inc();
    }

    pub fn stopwatches(&self, place: &str) -> Stopwatches {
        let [decode, depth, refine, compare, attend, remember, publish] = STAGES.map(|stage| {
            self.stages.get_or_create_owned(&OfStage {
                place: place.to_owned(),
                stage,
            })
        });
        Stopwatches {
            decode,
            depth,
            refine,
            compare,
            attend,
            remember,
            publish,
            frame: self.frames.get_or_create_owned(&OfPlace {
                place: place.to_owned(),
            }),
        }
    }

    /// Everything, ready to be asked. `places` is not kept alive.
    pub fn registry(&self, places: &Arc<Places>, counters: Arc<IngestCounters>) -> Registry {
        let mut registry = Registry::with_prefix("surprised");
        registry.register(
            "build",
            "The version that runs",
            Info::new([("version", env!("CARGO_PKG_VERSION"))]),
        );
        registry.register_with_unit(
            "stage",
            "Time of the parts of a frame's way",
            Unit::Seconds,
            self.stages.clone(),
        );
        registry.register_with_unit(
            "frame",
            "From a frame's arrival until its report is published",
            Unit::Seconds,
            self.frames.clone(),
        );
        registry.register(
            "queries",
            "Questions to the memory, over Zenoh and HTTP, by what came of them",
            self.queries.clone(),
        );
        registry.register("events", "Events told of", self.events.clone());
        registry.register(
            "http_responses",
            "Answers over HTTP, without those of /events that go on",
            self.responses.clone(),
        );
        registry.register(
            "http_unauthorized",
            "Requests without the token",
            self.unauthorized.clone(),
        );
        registry.register(
            "sse_clients",
            "Open connections to /events",
            self.sse_clients.clone(),
        );
        registry.register(
            "sse_lagged",
            "Messages of /events that a client was too slow for",
            self.sse_lagged.clone(),
        );
        registry.register(
            "sse_refused",
            "Connections to /events that were too many",
            self.sse_refused.clone(),
        );
        registry.register(
            "news_dropped",
            "What watchers were not told because too much happened at once",
            self.news_dropped.clone(),
        );
        registry.register_collector(Box::new(OfPlaces {
            places: Arc::downgrade(places),
            counters,
        }));
        registry
    }
}

/// The histograms of one place.
#[derive(Debug, Clone)]
pub struct Stopwatches {
    decode: Histogram,
    depth: Histogram,
    refine: Histogram,
    compare: Histogram,
    attend: Histogram,
    remember: Histogram,
    publish: Histogram,
    frame: Histogram,
}

/// One frame's way, timed where the clock is: outside of the pipeline.
#[derive(Debug)]
pub struct Stopwatch<'a> {
    watches: &'a Stopwatches,
    started: Instant,
    lap: Instant,
}

impl Stopwatches {
    pub fn start(&self) -> Stopwatch<'_> {
        let now = Instant::now();
        Stopwatch {
            watches: self,
            started: now,
            lap: now,
        }
    }
}

impl Stopwatch<'_> {
    fn lap(&mut self, histogram: &Histogram) {
        let now = Instant::now();
        histogram.observe((now - self.lap).as_secs_f64());
        self.lap = now;
    }

    pub fn decoded(&mut self) {
        self.lap(&self.watches.decode);
    }

    pub fn ended(&mut self, stage: Stage) {
        let watches = self.watches;
        self.lap(match stage {
            Stage::Depth => &watches.depth,
            Stage::Refine => &watches.refine,
            Stage::Compare => &watches.compare,
            Stage::Attend => &watches.attend,
            Stage::Remember => &watches.remember,
        });
    }

    /// Of a frame that came then.
    pub fn published(&mut self, arrived: Instant) {
        self.lap(&self.watches.publish);
        self.watches
            .frame
            .observe((self.lap - arrived).as_secs_f64());
    }

    pub fn elapsed(&self) -> Duration {
        self.started.elapsed()
    }
}

/// The text of a registry.
pub fn text(registry: &Registry) -> String {
    let mut text = String::new();
    text::encode(&mut text, registry).expect("writing to memory does not fail");
    text
}
