//! What the worker and the store's tasks know together of one place.

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use serde::Serialize;
use tokio::sync::Notify;

use super::{
    form, lease,
    notes::{Kind, Notes},
    shelf::Shelf,
};
use crate::{
    config::Settings,
    memory::Version,
    model::{
        mode::Modes,
        viewpoint::{Head, Viewpoint},
    },
};

/// Damaged objects that are named; there may be more.
pub const NAMES_MAX: usize = 16;

/// What the place's settings say to its store.
#[derive(Debug, Clone)]
pub struct PlaceOptions {
    /// A crash loses at most the last so much.
    pub write_behind: Duration,
    /// Budget of what is in RAM, bytes.
    pub memory_bytes: usize,
    /// Larger images are not loaded.
    pub pixels_max: usize,
    /// Of what viewpoints are learnt with.
    pub settings_hash: u64,
    /// How many viewpoints a frame recalls.
    pub views: usize,
    pub metres_per_radian: f64,
}

impl PlaceOptions {
    pub fn new(settings: &Settings) -> Self {
        Self {
            write_behind: Duration::from_secs_f64(settings.write_behind_s),
            memory_bytes: settings.memory_bytes,
            pixels_max: settings.image_pixels_max,
            settings_hash: settings_hash(settings),
            views: settings.views,
            metres_per_radian: settings.metres_per_radian,
        }
    }

    /// How long after a change it is written: the other half of the time is left for the writing.
    pub fn write_behind_half(&self) -> Duration {
        self.write_behind / 2
    }
}

/// Of the settings that say what a belief means.
fn settings_hash(settings: &Settings) -> u64 {
    let meaning = (
        settings.forgetting,
        settings.xi,
        (settings.sigma_min, settings.sigma_max),
        (settings.unseen_start, settings.unseen_variance),
        (settings.earlier_appearance, settings.second_look),
    );
    form::checksum(format!("{meaning:?}").as_bytes())
}

/// What this service may do with the place.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum Role {
    /// The store has not been read yet.
    #[default]
    Unread,
    /// Another service writes the place; this one answers questions.
    Reader {
        holder: String,
    },
    Writer,
}

/// What [`StoreStatus::role`] may be.
pub const ROLES: [&str; 3] = ["unread", "reader", "writer"];

/// For people and monitors.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct StoreStatus {
    /// One of [`ROLES`].
    pub role: &'static str,
    /// Who writes the place, where it is not this service.
    pub holder: Option<String>,
    /// Why the store cannot be used at present.
    pub trouble: Option<String>,
    /// Of the lease under which this service writes.
    pub epoch: u64,
    pub stored_viewpoints: usize,
    pub stored_bytes: u64,
    /// Viewpoints found when the place was read or taken over last.
    pub recovered: usize,
    /// Of those, learnt with other settings.
    pub recovered_other_settings: usize,
    /// Objects that could not be read, and where the first of them are.
    pub damaged: u64,
    pub damaged_names: Vec<String>,
    /// Whole objects that are left as they are: of a later version of the form, or too large for these settings.
    pub left_unread: usize,
    /// Changes that are not stored yet, and the age of the oldest.
    pub pending: usize,
    pub pending_s: f64,
    pub written: u64,
    pub written_bytes: u64,
    /// Stored later than `write_behind_s` after the change.
    pub late: u64,
    pub removed: u64,
    pub write_failures: u64,
    /// Changes that were lost because another service took the place while the store could not be reached.
    pub lost: u64,
    pub loaded: u64,
    pub read_failures: u64,
    /// Frames and questions that found all they needed in RAM, and those that had to wait for the store.
    pub hits: u64,
    pub misses: u64,
    pub miss_seconds: f64,
    /// Of the misses, those that went on without.
    pub incomplete: u64,
    /// Viewpoints expected to be needed that were too many to load.
    pub not_prefetched: u64,
}

/// A change on its way to the store, and since when the store lacks one.
#[derive(Debug, Clone)]
pub struct Pending {
    /// `None`: removed.
    pub written: Option<(Arc<Viewpoint>, u64)>,
    pub since: Instant,
}

#[derive(Debug, Clone, PartialEq)]
pub struct Known {
    pub head: Head,
    pub version: Version,
    pub bytes: u64,
}

#[derive(Debug, Clone, PartialEq)]
pub struct Unreadable {
    pub name: String,
    /// Else it is of another version of the form, or too large for these settings.
    pub is_damaged: bool,
}

/// What the worker has to learn of the viewpoints, in this order.
#[derive(Debug)]
pub enum News {
    /// Everything is as the store says from here on.
    Reset,
    /// Ids up to this one are not to be given again.
    Taken(u64),
    Known(Vec<(Head, Version)>),
    Gone(u64),
    Loaded(Arc<Viewpoint>, Version),
    Stored(u64, Version),
}

#[derive(Debug, Default)]
pub struct State {
    pub role: Role,
    pub epoch: u64,
    /// Until when the lease allows to write.
    pub trusted_until: Option<Instant>,
    pub pending: BTreeMap<u64, Pending>,
    /// Being written now; not in `pending`.
    pub writing: usize,
    /// What is stored, by id.
    pub catalogue: BTreeMap<u64, Known>,
    /// What is stored of the modes, and under which name.
    pub modes: Modes,
    pub modes_version: Option<Version>,
    /// What was said about modes since, here. Who writes the place stores it.
    pub modes_said: Modes,
    /// The worker knows what these come to.
    pub modes_told: bool,
    pub events: Notes,
    pub calibrations: Notes,
    /// To be loaded, the next first.
    pub wanted: VecDeque<u64>,
    /// Being loaded.
    pub fetching: BTreeSet<u64>,
    /// Loaded, among the news.
    pub loaded: BTreeSet<u64>,
    pub news: Vec<News>,
    /// Objects that cannot be read, as long as they are among the others.
    pub unreadable: BTreeMap<(u64, Version), Unreadable>,
    /// The store is not as the catalogue says.
    pub stale: bool,
    /// What went wrong, by who noticed.
    pub trouble: BTreeMap<&'static str, String>,
    pub counters: StoreStatus,
    pub closing: bool,
    pub closed: bool,
}

impl State {
    pub fn is_awaited(&self, id: u64) -> bool {
        self.fetching.contains(&id) || self.wanted.contains(&id)
    }

    pub fn notes(&mut self, kind: Kind) -> &mut Notes {
        match kind {
            Kind::Event => &mut self.events,
            Kind::Calibration => &mut self.calibrations,
        }
    }

    /// Changes that are not stored yet.
    pub fn unstored(&self) -> usize {
        let mut unstored = self.pending.len() + self.writing + self.events.unstored();
        // What else was said here waits until this service writes the place.
        if self.role == Role::Writer {
            let modes = usize::from(!self.modes_said.is_empty());
            unstored += modes + self.calibrations.unstored();
        }
        unstored
    }

    /// Whether the lease of this epoch still allows to write.
    pub fn may_write(&self, epoch: u64) -> bool {
        let trusted = self
            .trusted_until
            .is_some_and(|until| Instant::now() < until);
        self.role == Role::Writer && self.epoch == epoch && trusted
    }
}

pub struct Shared {
    pub place: Arc<str>,
    pub shelf: Shelf,
    pub options: PlaceOptions,
    /// This service's name in leases.
    pub name: String,
    state: Mutex<State>,
    /// Rung for who waits in [`Self::wait`].
    arrived: Condvar,
    pub for_writer: Notify,
    pub for_loader: Notify,
    pub for_keeper: Notify,
    /// Wakes the worker.
    wake: Box<dyn Fn() + Send + Sync>,
}

impl Shared {
    pub fn new(
        place: &str,
        shelf: Shelf,
        options: PlaceOptions,
        wake: impl Fn() + Send + Sync + 'static,
    ) -> Self {
        Self {
            place: place.into(),
            shelf,
            options,
            name: lease::own_name(),
            state: Mutex::default(),
            arrived: Condvar::new(),
            for_writer: Notify::new(),
            for_loader: Notify::new(),
            for_keeper: Notify::new(),
            wake: Box::new(wake),
        }
    }

    pub fn lock(&self) -> MutexGuard<'_, State> {
        // Nothing below panics between two changes that belong together.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// After news or a change of role.
    pub fn tell_worker(&self) {
        self.arrived.notify_all();
        (self.wake)();
    }

    pub fn tell_tasks(&self) {
        self.for_writer.notify_one();
        self.for_loader.notify_one();
        self.for_keeper.notify_one();
    }

    /// Waits until the state is such, rung by [`Self::tell_worker`]; false if that takes too long.
    pub fn wait(&self, within: Duration, until: impl Fn(&State) -> bool) -> bool {
        let deadline = Instant::now() + within;
        let mut state = self.lock();
        while !until(&state) {
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return false;
            }
            state = self
                .arrived
                .wait_timeout(state, left)
                .unwrap_or_else(PoisonError::into_inner)
                .0;
        }
        true
    }

    /// Logs trouble when it begins and ends, not while it lasts.
    pub fn trouble(&self, who: &'static str, what: Option<String>) {
        let mut state = self.lock();
        let before = match &what {
            Some(what) => state.trouble.insert(who, what.clone()),
            None => state.trouble.remove(who),
        };
        drop(state);
        match (before, what) {
            (None, Some(what)) => {
                tracing::warn!(
                    place = &*self.place,
                    "the stored memory has trouble: {what}"
                );
            }
            (Some(_), None) => {
                tracing::info!(
                    place = &*self.place,
                    "the stored memory is well again ({who})"
                );
            }
            _ => {}
        }
    }
}
