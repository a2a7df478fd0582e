//! The places and their workers. A place begins with the first message for it, or with the first question where something
//! is stored of it. It lives as long as the service, unless others want its room and nobody misses it: nothing has come
//! for it in a while, and what it remembers is stored, or nothing ever came of what was sent.

use std::{
    collections::BTreeMap,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Arc, Mutex, PoisonError, RwLock,
        atomic::{AtomicU64, Ordering},
    },
    thread::JoinHandle,
    time::{Duration, Instant},
};

use tokio::{
    runtime::Handle,
    sync::{mpsc, watch},
    time::timeout,
};
use zenoh::{Session, Wait};

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

/// A place for which no message came for so long may make room for another, as may one that has existed for so long without
/// a frame that could be used: under a name, say, that somebody mistyped.
const UNHEARD: Duration = Duration::from_secs(60);
/// How long the store may take to say whether it has a place.
const KNOWN_WITHIN: Duration = Duration::from_secs(2);

/// What others may do with a place.
#[derive(Debug)]
pub struct Place {
    opened: Instant,
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
    /// Places that made room for others.
    closed: AtomicU64,
    /// Told the name of each place whose worker has panicked or cannot start.
    failures: mpsc::UnboundedSender<String>,
    starts: mpsc::Sender<Arc<str>>,
    pub metrics: Arc<Metrics>,
    news: Option<mpsc::Sender<News>>,
}

struct Running {
    place: Arc<str>,
    thread: JoinHandle<()>,
}

impl Place {
    /// Since when nobody would have missed it; `None`: it may not go.
    fn dispensable_since(&self) -> Option<Instant> {
        let publish = self.publish.lock().unwrap_or_else(PoisonError::into_inner);
        if publish.is_some() {
            // Its worker has not started.
            return None;
        }
        let status = self.status.borrow();
        let totals = &status.totals;
        if totals.frames == 0 && totals.viewpoints_known == 0 {
            return (self.opened.elapsed() > UNHEARD).then_some(self.opened);
        }
        // Where there is no store what is remembered would be gone.
        let is_stored = totals
            .store
            .as_ref()
            .is_some_and(|store| store.pending == 0 && store.trouble.is_none());
        let heard = self.inbox.heard()?;
        let is_unheard = heard.is_none_or(|heard| heard.elapsed() > UNHEARD);
        (is_stored && is_unheard).then_some(heard.unwrap_or(self.opened))
    }
}

/// New places, for [`Places::start`]. There are never more than fit: those that have not started make no room for others.
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
            closed: AtomicU64::default(),
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

    /// How many made room for others.
    pub fn closed(&self) -> u64 {
        self.closed.load(Ordering::Relaxed)
    }

    /// The place if it is here, or if something is stored of it. Waits for the store, but not for long.
    ///
    /// # Errors
    /// `unknown_place`, `too_many_places`.
    pub async fn known(&self, name: &str) -> Result<Arc<Place>, Refusal> {
        if let Some(place) = self.get(name) {
            return Ok(place);
        }
        if let Some(store) = self.store.as_ref().filter(|_| keys::is_id(name)) {
            match timeout(KNOWN_WITHIN, store.has(name)).await {
                Ok(Ok(true)) => return self.get_or_open(&name.into()),
                Ok(Ok(false)) => {}
                Ok(Err(error)) => tracing::debug!("whether {name} is stored is not known: {error}"),
                Err(_) => tracing::debug!("whether {name} is stored is not known: no answer"),
            }
        }
        Err(Refusal::new(
            "unknown_place",
            format!("place {name} is unknown: it begins with its first frame"),
        ))
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
            self.make_room(&mut places)?;
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
            opened: Instant::now(),
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

    /// # Errors
    /// `too_many_places`.
    fn make_room(&self, places: &mut BTreeMap<Arc<str>, Arc<Place>>) -> Result<(), Refusal> {
        let dispensable = places
            .iter()
            .filter_map(|(name, place)| Some((place.dispensable_since()?, name.clone())))
            .min();
        let Some((_, name)) = dispensable else {
            return Err(Refusal::new(
                "too_many_places",
                format!(
                    "the service already has {PLACES_MAX} places and all are in use: use one of them, start another service for this one, or wait until one has been quiet for a minute and is stored"
                ),
            ));
        };
        if let Some(place) = places.remove(&name) {
            tracing::info!("place {name} makes room for another");
            place.inbox.close();
            self.closed.fetch_add(1, Ordering::Relaxed);
        }
        Ok(())
    }

    /// Lets go of what is left of places that made room for others.
    fn reap(&self) {
        let mut running = self.running.lock().unwrap_or_else(PoisonError::into_inner);
        let ended = running.extract_if(.., |running| running.thread.is_finished());
        for Running { place, thread } in ended {
            // A panic was already told of.
            drop(thread.join());
            if self.get(&place).is_none() {
                self.metrics.forget(&place);
            }
        }
    }

    /// Starts the worker of a place that was opened. Not for Zenoh's callbacks: it declares.
    pub fn start(&self, name: &Arc<str>) {
        self.reap();
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
        let thread = start_thread(name, self.failures.clone(), move || {
            let _token = token;
            worker.run();
        })?;
        self.running
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .push(Running {
                place: name.clone(),
                thread,
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
    use crate::{
        memory::store::StoreStatus,
        model::frame::Source,
        service::{ask::Ask, inbox::Arrival},
    };

    /// One whose worker runs, opened so long ago.
    fn running(opened_s: u64, totals: PlaceTotals) -> Place {
        let ago = Instant::now().checked_sub(Duration::from_secs(opened_s));
        let status = PlaceStatus {
            totals,
            cameras: Vec::new(),
        };
        Place {
            opened: ago.expect("the machine runs for a minute already"),
            inbox: Arc::default(),
            status: watch::channel(Arc::new(status)).1,
            events: watch::channel(Arc::default()).1,
            publish: Mutex::new(None),
        }
    }

    fn stored(viewpoints_known: usize, store: StoreStatus) -> PlaceTotals {
        PlaceTotals {
            viewpoints_known,
            store: Some(StoreStatus {
                role: "writer",
                ..store
            }),
            ..PlaceTotals::default()
        }
    }

    #[test]
    fn a_place_of_which_nothing_came_may_go_after_a_minute_even_if_somebody_still_sends() {
        let anna = Source {
            robot: "anna".into(),
            camera: "head".into(),
        };
        for totals in [PlaceTotals::default(), stored(0, StoreStatus::default())] {
            let place = running(61, totals.clone());
            place.inbox.set_live(&anna, true).expect("room");
            assert!(place.dispensable_since().is_some());
            assert!(running(30, totals).dispensable_since().is_none());
        }
    }

    #[test]
    fn a_place_that_remembers_may_go_if_that_is_stored_and_nobody_misses_it() {
        let kept = |totals| running(61, totals).dispensable_since().is_none();
        // Its memory would be gone with it.
        let in_ram = PlaceTotals {
            frames: 9,
            viewpoints_known: 3,
            ..PlaceTotals::default()
        };
        assert!(kept(in_ram));
        assert!(!kept(stored(3, StoreStatus::default())));
        assert!(kept(stored(
            3,
            StoreStatus {
                pending: 1,
                ..StoreStatus::default()
            }
        )));
        assert!(kept(stored(
            3,
            StoreStatus {
                trouble: Some("cut off".to_owned()),
                ..StoreStatus::default()
            }
        )));
    }

    #[test]
    fn a_place_to_which_something_was_sent_lately_or_that_is_being_asked_stays() {
        let anna = Source {
            robot: "anna".into(),
            camera: "head".into(),
        };
        let place = || running(61, stored(3, StoreStatus::default()));
        let live = place();
        live.inbox.set_live(&anna, true).expect("room");
        assert!(live.dispensable_since().is_none());
        let sent = place();
        let arrival = Arrival {
            payload: Default::default(),
            arrived: Instant::now(),
            pulled: false,
        };
        sent.inbox.put_frame(&anna, arrival).expect("room");
        drop(sent.inbox.take_frame(&anna));
        assert!(sent.dispensable_since().is_none());
        let asked = place();
        let (answer, _) = tokio::sync::oneshot::channel();
        let ask = Ask::Mode {
            camera: None,
            set: None,
            answer,
        };
        asked.inbox.put_ask(ask).expect("room");
        assert!(asked.dispensable_since().is_none());
        drop(asked.inbox.take_ask());
        asked.inbox.end_ask(None);
        // It can be had again for the next question.
        assert!(asked.dispensable_since().is_some());
    }

    #[test]
    fn a_panic_is_told_with_the_place() {
        let (sender, mut failures) = mpsc::unbounded_channel();
        let thread = start_thread("lab", sender, || panic!("a bug")).expect("a thread starts");
        thread.join().expect("the panic was caught");
        assert_eq!(failures.try_recv().as_deref(), Ok("lab"));
    }
}
