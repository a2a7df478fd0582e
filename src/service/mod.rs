//! How the service is reached: Zenoh in, Zenoh out, HTTP beside it, and one worker thread a place in between.

pub mod access;

pub mod session;

pub mod client;

pub mod robot;

mod readiness;

mod ingest;

mod inbox;

mod places;

mod worker;

mod camera;

mod publish;

mod ask;

mod turns;

mod status;

mod events;

mod live;

mod metrics;
mod questions;

mod queries;

mod http;

use std::{net::SocketAddr, sync::Arc, time::Duration};

use tokio::{net::TcpListener, sync::mpsc, time::timeout};
use zenoh::query::Queryable;

use self::{
    access::HttpAccess,
    http::{Parts, Server},
    ingest::Ingest,
    live::NEWS_MAX,
    places::{PLACES_MAX, Places},
    questions::Questions,
    readiness::Readiness,
    session::ZenohOptions,
};
use crate::{
    config::{ConfigError, Settings},
    engine::{EngineError, EngineKind, Engines},
    isa::Isa,
    memory::store::{RETRY_MAX, Store},
    wire::{decode::Limits, keys},
};

/// From the wish to stop until the process has ended: longer than a frame and its report can take.
const STOP_WITHIN: Duration = Duration::from_secs(5);

/// How a service is started.
#[derive(Debug, Clone)]
pub struct Options {
    pub settings: Settings,
    /// Where memories last; `None`: they end with the service.
    pub store: Option<Store>,
    pub engine: EngineKind,
    pub root: String,
    /// `None`: no HTTP.
    pub http: Option<SocketAddr>,
    pub http_access: HttpAccess,
    pub zenoh: ZenohOptions,
}

#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    #[error(transparent)]
    Config(#[from] ConfigError),
    #[error("Zenoh: {0}; see -c, -m, -e and -l")]
    Zenoh(#[source] zenoh::Error),
    #[error("HTTP cannot be served on {addr}: {error}; choose another --http, or off")]
    Http {
        addr: SocketAddr,
        error: std::io::Error,
    },
    #[error("threads cannot be started: {0}")]
    Threads(String),
    #[error(transparent)]
    Engine(#[from] EngineError),
    #[error("the worker of place {0} failed: this is a bug; its panic is in the log above")]
    Worker(String),
    #[error("the service did not stop within {} s", STOP_WITHIN.as_secs())]
    Stop,
}

/// A running service.
pub struct Service {
    places: Arc<Places>,
    ingest: Ingest,
    queryables: Vec<Queryable<()>>,
    http: Option<Server>,
    readiness: Readiness,
    failures: mpsc::UnboundedReceiver<String>,
    locators: Vec<String>,
}

/// Serves until `stop` comes, then finishes the frames that have come.
///
/// # Errors
/// A wrong configuration, something that cannot be opened, a worker that failed, or a stop that took too long.
pub async fn serve(options: Options, stop: impl Future<Output = ()>) -> Result<(), ServeError> {
    Service::start(options).await?.run(stop).await
}

/// Opens the places that are stored, as soon as the store can be reached: they can be asked before a frame comes.
async fn open_stored(places: Arc<Places>) {
    let Some(store) = &places.store else {
        return;
    };
    let names = loop {
        match store.places().await {
            Ok(names) => break names,
            Err(error) => {
                tracing::warn!("stored places are not known yet: {error}");
                tokio::time::sleep(RETRY_MAX).await;
            }
        }
    };
    let names: Vec<String> = names.into_iter().filter(|name| keys::is_id(name)).collect();
    for name in names.iter().take(PLACES_MAX) {
        if let Err(refusal) = places.get_or_open(&name.as_str().into()) {
            tracing::warn!("place {name} is stored but not opened: {refusal}");
        }
    }
    if names.len() > PLACES_MAX {
        tracing::info!(
            "{} places are stored, {PLACES_MAX} are open: the others will be when somebody sends or asks, in the room of what is quiet",
            names.len()
        );
    }
}

impl Service {
    /// Opens everything. Needs a multi-threaded tokio runtime.
    ///
    /// # Errors
    /// A wrong configuration, before anything is opened; then what cannot be opened.
    pub async fn start(options: Options) -> Result<Self, ServeError> {
        let Options {
            settings,
            store,
            engine,
            root,
            http,
            http_access,
            zenoh,
        } = options;
        settings.validate()?;
        if !keys::is_root(&root) {
            return Err(ConfigError::Root(root).into());
        }
        if let Some(addr) = http {
            http_access.check(addr)?;
        }
        let config = zenoh.config(Limits::new(&settings).message_bytes_max())?;

        let readiness = Readiness::default();
        let (session_latch, http_latch, workers_latch) = (
            readiness.latch("session"),
            readiness.latch("http"),
            readiness.latch("workers"),
        );
        let listener = match http {
            None => None,
            Some(addr) => Some((
                addr,
                TcpListener::bind(addr)
                    .await
                    .map_err(|error| ServeError::Http { addr, error })?,
            )),
        };
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(settings.threads)
            .thread_name(|index| format!("engine {index}"))
            .build()
            .map_err(|error| ServeError::Threads(error.to_string()))?;
        let pool = Arc::new(pool);
        let engines = Engines::new(engine, pool, Isa::detect())?;
        let session = zenoh::open(config).await.map_err(ServeError::Zenoh)?;
        let locators = session::locators(&session);
        drop(session_latch);

        let (failed, failures) = mpsc::unbounded_channel();
        let (news, told) = mpsc::channel(NEWS_MAX);
        let (places, starts) = Places::new(
            settings,
            store,
            engines,
            root.into(),
            session,
            failed,
            http.is_some().then_some(news),
        );
        let places = Arc::new(places);
        tokio::spawn(open_stored(places.clone()));
        let ingest = ingest::start(&places, starts).map_err(ServeError::Zenoh)?;
        let questions = Arc::new(Questions::new(places.clone(), ingest.counters.clone()));
        let mut queryables: Vec<_> = queries::start(&questions, &ingest.counters)
            .map_err(ServeError::Zenoh)?
            .into();
        let of_events = events::start(&places, ingest.counters.clone());
        queryables.push(of_events.map_err(ServeError::Zenoh)?);
        drop(workers_latch);

        let http = match listener {
            None => None,
            Some((addr, listener)) => {
                let parts = Parts {
                    places: places.clone(),
                    counters: ingest.counters.clone(),
                    locators: locators.clone(),
                    live: live::start(&places, told),
                    questions,
                };
                let server = http::start(listener, readiness.clone(), http_access, parts)
                    .map_err(|error| ServeError::Http { addr, error })?;
                tracing::info!("HTTP on http://{}", server.addr);
                Some(server)
            }
        };
        drop(http_latch);
        tracing::info!(
            root = &*places.root,
            id = %places.session.zid(),
            "robots connect to {}",
            if locators.is_empty() {
                "the same router".to_owned()
            } else {
                locators.join(" or ")
            }
        );
        Ok(Self {
            places,
            ingest,
            queryables,
            http,
            readiness,
            failures,
            locators,
        })
    }

    /// Where HTTP is served.
    pub fn http_addr(&self) -> Option<SocketAddr> {
        self.http.as_ref().map(|server| server.addr)
    }

    /// Zenoh endpoints to connect to.
    pub fn locators(&self) -> &[String] {
        &self.locators
    }

    /// Until `stop` comes or a worker fails.
    ///
    /// # Errors
    /// A worker that failed, or a stop that took too long.
    pub async fn run(mut self, stop: impl Future<Output = ()>) -> Result<(), ServeError> {
        let failure = tokio::select! {
            () = stop => None,
            place = self.failures.recv() => place,
        };
        if let Some(place) = &failure {
            tracing::error!("the worker of place {place} failed: stopping");
            self.readiness.fail(format!("worker of {place}"));
        }
        let Self {
            places,
            ingest,
            queryables,
            http,
            readiness,
            ..
        } = self;
        let _stopping = readiness.latch("stopping");
        let session = places.session.clone();
        let finish = async move {
            // Nothing new comes in; then what has come is finished; then everybody is told.
            drop(ingest);
            drop(queryables);
            // Closing joins threads.
            if let Err(error) = tokio::task::spawn_blocking(move || places.close()).await {
                tracing::error!("the places did not close: {error}");
            }
            if let Some(http) = http {
                http.stop().await;
            }
            if let Err(error) = session.close().await {
                tracing::debug!("the session was closed already: {error}");
            }
        };
        let stopped = timeout(STOP_WITHIN, finish).await;
        match (failure, stopped) {
            (Some(place), _) => Err(ServeError::Worker(place)),
            (None, Err(_)) => Err(ServeError::Stop),
            (None, Ok(())) => Ok(()),
        }
    }
}
