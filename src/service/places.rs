//! The places and their workers. A place begins with the first message for it and lives as long as the service.

use std::{
    collections::BTreeMap,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{Arc, PoisonError, RwLock},
    thread::JoinHandle,
};

use rayon::ThreadPool;
use tokio::sync::{mpsc, watch};
use zenoh::{Session, Wait, liveliness::LivelinessToken};

use super::{inbox::Inbox, ingest, status::PlaceStatus, worker::Worker};
use crate::{
    config::Settings,
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
    _token: LivelinessToken,
}

pub struct Places {
    pub settings: Settings,
    pub root: Arc<str>,
    pub session: Session,
    pool: Arc<ThreadPool>,
    places: RwLock<BTreeMap<Arc<str>, Arc<Place>>>,
    threads: std::sync::Mutex<Vec<JoinHandle<()>>>,
    /// Told the name of each place whose worker has panicked.
    failures: mpsc::UnboundedSender<String>,
}

impl Places {
    pub fn new(
        settings: Settings,
        root: Arc<str>,
        session: Session,
        pool: Arc<ThreadPool>,
        failures: mpsc::UnboundedSender<String>,
    ) -> Self {
        Self {
            settings,
            root,
            session,
            pool,
            places: RwLock::default(),
            threads: std::sync::Mutex::default(),
            failures,
        }
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

    /// The place, with its worker started if it is new. Not for Zenoh's callbacks: it declares.
    ///
    /// # Errors
    /// `too_many_places`; `closing` when the session or the threads are gone.
    pub fn get_or_start(&self, name: &Arc<str>) -> Result<Arc<Place>, Refusal> {
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
        let closing = |error: &dyn std::fmt::Display| {
            Refusal::new(
                "closing",
                format!("the service cannot open another place: {error}"),
            )
        };
        let token = keys::live_service(&self.root, name, &self.session.zid().to_string());
        let token = self
            .session
            .liveliness()
            .declare_token(token)
            .wait()
            .map_err(|error| closing(&error))?;
        let inbox = Arc::new(Inbox::default());
        let (status, watched) = watch::channel(Arc::default());
        let worker = Worker {
            place: name.clone(),
            root: self.root.clone(),
            session: self.session.clone(),
            inbox: inbox.clone(),
            pipeline: Pipeline::new(self.settings.clone(), self.pool.clone()),
            status,
            ask_calibration: ingest::calibration_getter(
                self.session.clone(),
                self.root.clone(),
                inbox.clone(),
            ),
        };
        let thread = start_thread(name, self.failures.clone(), move || worker.run())
            .map_err(|error| closing(&error))?;
        self.threads
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .push(thread);
        let place = Arc::new(Place {
            inbox,
            status: watched,
            _token: token,
        });
        tracing::info!("place {name} begins");
        places.insert(name.clone(), place.clone());
        Ok(place)
    }

    /// Tells every worker to finish what has come, and waits for them. Blocks.
    pub fn close(&self) {
        for (_, place) in self.all() {
            place.inbox.close();
        }
        let mut threads = self.threads.lock().unwrap_or_else(PoisonError::into_inner);
        for thread in threads.drain(..) {
            // A panic was already told of.
            drop(thread.join());
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
