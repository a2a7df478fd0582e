//! The places and their workers. A place begins with the first message for it and lives as long as the service.

use std::{
    collections::BTreeMap,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{Arc, Mutex, PoisonError, RwLock},
    thread::JoinHandle,
};

use tokio::{
    runtime::Handle,
    sync::{mpsc, watch},
};
use zenoh::{Session, Wait, liveliness::LivelinessToken};

use super::{
    events::PlaceEvents,
    inbox::Inbox,
    ingest,
    live::News,
    metrics::Metrics,
    status::{PlaceStatus, PlaceTotals},
    worker::Worker,
};
use crate::{
    config::Settings,
    engine::Engines,
    memory::store::{PlaceOptions, PlaceStore, Store},
    model::refusal::Refusal,
    pipeline::Pipeline,
    wire::keys,
};

/// Each is a thread and a memory of up to `memory_bytes`.
pub const PLACES_MAX: usize = 16;

/// What others may do with a place.
#[derive(Debug)]
pub struct Place {
    pub inbox: Arc<Inbox>,
    pub status: watch::Receiver<Arc<PlaceStatus>>,
    pub events: watch::Receiver<Arc<PlaceEvents>>,
    /// Taken by the worker when it starts.
    publish: Mutex<Option<Publish>>,
}

/// Where a worker puts what others may know.
#[derive(Debug)]
struct Publish {
    status: watch::Sender<Arc<PlaceStatus>>,
    events: watch::Sender<Arc<PlaceEvents>>,
}

pub struct Places {
    pub settings: Settings,
    /// Where memories last; `None`: they end with the service.
    pub store: Option<Store>,
    runtime: Handle,
    pub engines: Engines,
    pub root: Arc<str>,
    pub session: Session,
    places: RwLock<BTreeMap<Arc<str>, Arc<Place>>>,
    running: Mutex<Vec<Running>>,
    /// Told the name of each place whose worker has panicked or cannot start.
    failures: mpsc::UnboundedSender<String>,
    starts: mpsc::Sender<Arc<str>>,
    pub metrics: Arc<Metrics>,
    news: Option<mpsc::Sender<News>>,
}

struct Running {
    thread: JoinHandle<()>,
    _token: LivelinessToken,
}

/// New places, for [`Places::start`]. There are never more than fit.
pub type Starts = mpsc::Receiver<Arc<str>>;

impl Places {
    /// On a tokio runtime.
    pub fn new(
        settings: Settings,
        store: Option<Store>,
        engines: Engines,
        root: Arc<str>,
        session: Session,
        failures: mpsc::UnboundedSender<String>,
        news: Option<mpsc::Sender<News>>,
    ) -> (Self, Starts) {
        let (starts, started) = mpsc::channel(PLACES_MAX);
        let places = Self {
            settings,
            store,
            runtime: Handle::current(),
            engines,
            root,
            session,
            places: RwLock::default(),
            running: Mutex::default(),
            failures,
            starts,
            metrics: Arc::default(),
            news,
        };
        (places, started)
    }

    pub fn get(&self, place: &str) -> Option<Arc<Place>> {
        let places = self.places.read().unwrap_or_else(PoisonError::into_inner);
        places.get(place).cloned()
    }

    pub fn all(&self) -> Vec<(Arc<str>, Arc<Place>)> {
        let places = self.places.read().unwrap_or_else(PoisonError::into_inner);
        places
            .iter()
            .map(|(name, place)| (name.clone(), place.clone()))
            .collect()
    }

    /// The place. A new one has its inbox at once, so that nothing overtakes its first message, and its worker soon.
    /// Never waits.
    ///
    /// # Errors
    /// `too_many_places`.
    pub fn get_or_open(&self, name: &Arc<str>) -> Result<Arc<Place>, Refusal> {
        if let Some(place) = self.get(name) {
            return Ok(place);
        }
        let mut places = self.places.write().unwrap_or_else(PoisonError::into_inner);
        if let Some(place) = places.get(name) {
            return Ok(place.clone());
        }
        if places.len() == PLACES_MAX {
            return Err(Refusal::new(
                "too_many_places",
                format!(
                    "the service already has {PLACES_MAX} places: use one of them, or start another service for this one"
                ),
            ));
        }
        let totals = PlaceTotals {
            place: name.to_string(),
            memory_bytes_max: self.settings.memory_bytes,
            ..PlaceTotals::default()
        };
        let (publish_status, status) = watch::channel(Arc::new(PlaceStatus {
            totals,
            cameras: Vec::new(),
        }));
        let (publish_events, events) = watch::channel(Arc::default());
        let place = Arc::new(Place {
            inbox: Arc::default(),
            status,
            events,
            publish: Mutex::new(Some(Publish {
                status: publish_status,
                events: publish_events,
            })),
        });
        places.insert(name.clone(), place.clone());
        // There is room for every place; the other end is gone only when the service is.
        drop(self.starts.try_send(name.clone()));
        Ok(place)
    }

    /// Starts the worker of a place that was opened. Not for Zenoh's callbacks: it declares.
    pub fn start(&self, name: &Arc<str>) {
        match self.try_start(name) {
            Ok(()) => tracing::info!("place {name} begins"),
            Err(error) => {
                tracing::error!("place {name} cannot begin: {error}");
                // Nobody listens when the service is stopping anyway.
                drop(self.failures.send(name.to_string()));
            }
        }
    }

    fn try_start(&self, name: &Arc<str>) -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
        let Some(place) = self.get(name) else {
            return Ok(());
        };
        let publish = place
            .publish
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .take();
        let Some(Publish { status, events }) = publish else {
            return Ok(());
        };
        let token = keys::live_service(&self.root, name, &self.session.zid().to_string());
        let token = self.session.liveliness().declare_token(token).wait()?;
        let pipeline = Pipeline::on(&self.engines, self.settings.clone());
        let memory = self.store.as_ref().map(|store| {
            let inbox = place.inbox.clone();
            let options = PlaceOptions::new(&self.settings);
            PlaceStore::open(store, name, options, &self.runtime, move || {
                inbox.put_memory_news();
            })
        });
        let worker = Worker {
            memory,
            place: name.clone(),
            root: self.root.clone(),
            session: self.session.clone(),
            inbox: place.inbox.clone(),
            pipeline,
            status,
            events,
            metrics: self.metrics.clone(),
            news: self.news.clone(),
            ask_calibration: ingest::calibration_getter(
                self.session.clone(),
                self.root.clone(),
                place.inbox.clone(),
            ),
        };
        let thread = start_thread(name, self.failures.clone(), move || worker.run())?;
        self.running
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .push(Running {
                thread,
                _token: token,
            });
        Ok(())
    }

    /// Tells every worker to finish what has come, and waits for them. Blocks.
    pub fn close(&self) {
        for (_, place) in self.all() {
            place.inbox.close();
        }
        let mut running = self.running.lock().unwrap_or_else(PoisonError::into_inner);
        for running in running.drain(..) {
            // A panic was already told of.
            drop(running.thread.join());
        }
    }
}

/// A panic in `work` is a bug; it is told to `failures`, because a place without its worker is lost.
fn start_thread(
    name: &str,
    failures: mpsc::UnboundedSender<String>,
    work: impl FnOnce() + Send + 'static,
) -> std::io::Result<JoinHandle<()>> {
    let place = name.to_owned();
    std::thread::Builder::new()
        .name(format!("place {name}"))
        .spawn(move || {
            // Nothing of the worker is used after a panic.
            if catch_unwind(AssertUnwindSafe(work)).is_err() {
                // Nobody listens when the service is stopping anyway.
                drop(failures.send(place));
            }
        })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_panic_is_told_with_the_place() {
        let (sender, mut failures) = mpsc::unbounded_channel();
        let thread = start_thread("lab", sender, || panic!("a bug")).expect("a thread starts");
        thread.join().expect("the panic was caught");
        assert_eq!(failures.try_recv().as_deref(), Ok("lab"));
    }
}
