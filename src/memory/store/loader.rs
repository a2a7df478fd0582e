//! Loads viewpoints that the worker wants, several at once, and checks them: what is damaged is set aside and named,
//! never loaded, never deleted.

use std::sync::Arc;

use object_store::Error;
use tokio::task::{JoinSet, spawn_blocking};

use super::{
    Backoff,
    form::{self, FormError},
    planes,
    shared::{News, Shared, Unreadable},
};
use crate::memory::Version;

/// Viewpoints wanted, being loaded, or loaded and not taken yet: some hundred megabytes of 320x240 pixels.
pub const LOADS_MAX: usize = 64;
/// Requests under way at once.
const LOADS_AT_ONCE: usize = 8;
/// Under this name the loader has trouble.
pub const READING: &str = "reading";

/// Until the place is closed.
pub async fn load(shared: Arc<Shared>) {
    let mut loads = JoinSet::new();
    let mut backoff = Backoff::default();
    loop {
        while loads.len() < LOADS_AT_ONCE
            && let Some((id, version)) = next(&shared)
        {
            loads.spawn(load_one(shared.clone(), id, version));
        }
        if shared.lock().closing {
            return;
        }
        tokio::select! {
            Some(done) = loads.join_next() => match done {
                Ok(true) => backoff = Backoff::default(),
                Ok(false) => tokio::time::sleep(backoff.next()).await,
                Err(error) => tracing::error!("loading a viewpoint failed: {error}"),
            },
            () = shared.for_loader.notified() => {}
        }
    }
}

/// The next wanted viewpoint that is known to be stored.
fn next(shared: &Shared) -> Option<(u64, Version)> {
    let mut state = shared.lock();
    while let Some(id) = state.wanted.pop_front() {
        if let Some(known) = state.catalogue.get(&id) {
            let version = known.version;
            state.fetching.insert(id);
            return Some((id, version));
        }
    }
    None
}

impl Shared {
    /// It is not stored any more.
    fn forget(&self, id: u64) {
        let mut state = self.lock();
        state.catalogue.remove(&id);
        state.news.push(News::Gone(id));
    }

    fn done(&self, id: u64) {
        self.lock().fetching.remove(&id);
        self.tell_worker();
    }
}

/// False if the store cannot be reached.
async fn load_one(shared: Arc<Shared>, id: u64, version: Version) -> bool {
    let pixels_max = shared.options.pixels_max;
    let bytes_max = planes::packed_bytes_max(pixels_max) + form::HEAD_BYTES_MAX as u64;
    let got = shared.shelf.get(id, version, bytes_max).await;
    let decoded = match got {
        Ok(Some(bytes)) => {
            let place = shared.place.clone();
            // Takes milliseconds of a processor.
            spawn_blocking(move || {
                let (label, viewpoint) = form::decode(&bytes, pixels_max)?;
                if *label.place != *place || label.version != version || viewpoint.id != id {
                    return Err(FormError::Value("name"));
                }
                Ok(viewpoint)
            })
            .await
        }
        Ok(None) => Ok(Err(FormError::TooLong)),
        Err(Error::NotFound { .. }) => {
            // Somebody else has written or removed it.
            shared.forget(id);
            shared.lock().stale = true;
            shared.done(id);
            shared.for_keeper.notify_one();
            return true;
        }
        Err(error) => {
            shared.trouble(READING, Some(error.to_string()));
            shared.lock().counters.read_failures += 1;
            shared.done(id);
            return false;
        }
    };
    shared.trouble(READING, None);
    match decoded {
        Ok(Ok(viewpoint)) => {
            let mut state = shared.lock();
            state.counters.loaded += 1;
            state.loaded.insert(id);
            state.news.push(News::Loaded(Arc::new(viewpoint), version));
        }
        Ok(Err(error)) => {
            note_unreadable(&shared, id, version, &error);
            shared.forget(id);
        }
        Err(error) => tracing::error!("reading a viewpoint failed: {error}"),
    }
    shared.done(id);
    true
}

/// Says that an object cannot be read, and keeps it from being read again. If it is damaged the keeper sets it aside.
pub fn note_unreadable(shared: &Shared, id: u64, version: Version, why: &FormError) {
    let name = shared.shelf.viewpoint(id, version).to_string();
    let is_damaged = why.is_damage();
    if is_damaged {
        tracing::error!(
            place = &*shared.place,
            "viewpoint {id} is damaged and is not loaded: {why}; it is {name}"
        );
    } else {
        tracing::warn!(
            place = &*shared.place,
            "viewpoint {id} is left as it is and not loaded: {why}; it is {name}"
        );
    }
    let unreadable = Unreadable { name, is_damaged };
    shared.lock().unreadable.insert((id, version), unreadable);
    shared.for_keeper.notify_one();
}
