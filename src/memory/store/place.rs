//! The stored memory of one place, as the place's worker sees it: hands over what changed, learns what is known, asks
//! for what it needs. All that touches the store runs in tasks of its own; this is what they share.

use std::{
    collections::{BTreeMap, BTreeSet, HashMap, VecDeque},
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use bytes::Bytes;
use serde::Serialize;
use tokio::{runtime::Handle, sync::Notify};

use super::{
    Store,
    events::EventNotes,
    form, keeper, lease,
    loader::{self, LOADS_MAX},
    shelf::Shelf,
    way::{self, Passed},
};
use crate::{
    config::Settings,
    memory::{Memory, Version, residency::Change},
    model::{
        frame::Source,
        mode::Modes,
        pose::Pose,
        refusal::Refusal,
        viewpoint::{Head, Viewpoint},
    },
};

/// How far ahead of a robot viewpoints are loaded, and how many more than a frame recalls.
const AHEAD_S: [f64; 2] = [0.5, 1.0];
const AHEAD_FACTOR: usize = 3;
/// A robot that turns back needs at once what lies behind it: more than what a frame recalls is brought.
const NEED_FACTOR: usize = 2;
/// A frame or question waits no longer for what it needs; it goes on with what is there.
const BRING_WITHIN: Duration = Duration::from_secs(2);
/// A question waits no longer at a time, so that frames are served in between: a pass of the engine takes as long.
const BRING_STEP: Duration = Duration::from_millis(20);
/// Viewpoints are loaded without being asked for while less than this share of the budget is used.
const WARM_SHARE: (usize, usize) = (3, 4);
const WARM_AT_ONCE: usize = 16;
/// What is being loaded takes no more than one part in so many of the budget beside it.
const LOADS_SHARE: usize = 4;
/// Robots whose way is followed.
const WAYS_MAX: usize = 64;
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
pub(super) struct Pending {
    /// `None`: removed.
    pub written: Option<(Arc<Viewpoint>, u64)>,
    pub since: Instant,
}

#[derive(Debug, Clone, PartialEq)]
pub(super) struct Known {
    pub head: Head,
    pub version: Version,
    pub bytes: u64,
}

#[derive(Debug, Clone, PartialEq)]
pub(super) struct Unreadable {
    pub name: String,
    /// Else it is of another version of the form, or too large for these settings.
    pub is_damaged: bool,
}

/// What the worker has to learn of the viewpoints, in this order.
#[derive(Debug)]
pub(super) enum News {
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
pub(super) struct State {
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
    pub events: EventNotes,
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
    fn is_awaited(&self, id: u64) -> bool {
        self.fetching.contains(&id) || self.wanted.contains(&id)
    }

    /// Changes that are not stored yet.
    pub fn unstored(&self) -> usize {
        let modes = self.role == Role::Writer && !self.modes_said.is_empty();
        self.pending.len() + self.writing + usize::from(modes) + self.events.unstored()
    }

    /// Whether the lease of this epoch still allows to write.
    pub fn may_write(&self, epoch: u64) -> bool {
        let trusted = self
            .trusted_until
            .is_some_and(|until| Instant::now() < until);
        self.role == Role::Writer && self.epoch == epoch && trusted
    }
}

pub(super) struct Shared {
    pub place: Arc<str>,
    pub shelf: Shelf,
    pub options: PlaceOptions,
    /// This service's name in leases.
    pub name: String,
    state: Mutex<State>,
    /// Rung for who waits in [`PlaceStore::bring`], [`PlaceStore::wait_read`] and [`PlaceStore::close`].
    arrived: Condvar,
    pub for_writer: Notify,
    pub for_loader: Notify,
    pub for_keeper: Notify,
    /// Wakes the worker.
    wake: Box<dyn Fn() + Send + Sync>,
}

impl Shared {
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

/// The worker's end. Closed when dropped, without waiting.
pub struct PlaceStore {
    shared: Arc<Shared>,
    /// The last pose of each robot's camera.
    ways: Mutex<HashMap<Source, Passed>>,
}

/// How a wait for viewpoints ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Brought {
    /// Everything was there.
    Hit,
    Loaded,
    /// The store did not answer in time.
    Incomplete,
}

impl PlaceStore {
    /// Begins to read the place. `wake` is called when there is something for [`Self::sync`].
    pub fn open(
        store: &Store,
        place: &str,
        options: PlaceOptions,
        runtime: &Handle,
        wake: impl Fn() + Send + Sync + 'static,
    ) -> Self {
        let shared = Arc::new(Shared {
            place: place.into(),
            shelf: store.shelf(place),
            options,
            name: lease::own_name(),
            state: Mutex::default(),
            arrived: Condvar::new(),
            for_writer: Notify::new(),
            for_loader: Notify::new(),
            for_keeper: Notify::new(),
            wake: Box::new(wake),
        });
        runtime.spawn(keeper::keep(shared.clone()));
        Self {
            shared,
            ways: Mutex::default(),
        }
    }

    /// Waits until the store has been read; false if that takes too long.
    pub fn wait_read(&self, within: Duration) -> bool {
        self.wait(within, |state| state.role != Role::Unread)
    }

    pub fn role(&self) -> Role {
        self.shared.lock().role.clone()
    }

    /// # Errors
    /// `memory_unread`, `place_held`.
    pub fn may_learn(&self) -> Result<(), Refusal> {
        let state = self.shared.lock();
        match &state.role {
            Role::Writer => Ok(()),
            Role::Reader { holder } => Err(Refusal::new(
                "place_held",
                format!(
                    "this place is written by another service ({holder}); this one answers questions and takes over when that one is gone"
                ),
            )),
            Role::Unread => Err(unread(&state)),
        }
    }

    /// A memory that has never been read expects nothing and knows no modes: whoever relied on it would be told that
    /// nothing is surprising.
    ///
    /// # Errors
    /// `memory_unread`.
    pub fn may_recall(&self) -> Result<(), Refusal> {
        let state = self.shared.lock();
        match state.role {
            Role::Unread => Err(unread(&state)),
            _ => Ok(()),
        }
    }

    /// What holds for the cameras, if that has changed since this was asked last.
    pub fn take_modes(&self) -> Option<Modes> {
        let mut state = self.shared.lock();
        if state.modes_told {
            return None;
        }
        state.modes_told = true;
        Some(state.modes.then(&state.modes_said))
    }

    /// Keeps what is said about modes: at once where this service writes the place, else when it does.
    pub fn say(&self, modes: &Modes) {
        let mut state = self.shared.lock();
        state.modes_said = state.modes_said.then(modes);
        state.modes_told = false;
        self.shared.for_writer.notify_one();
    }

    /// Keeps the state of an event, or keeps it no longer; nothing where another service writes the place.
    pub fn keep_event(&self, id: u64, content: Option<Vec<u8>>) {
        let mut state = self.shared.lock();
        if state.role == Role::Writer {
            state.events.keep(id, content.map(Bytes::from));
            self.shared.for_writer.notify_one();
        }
    }

    /// Stored events that were not taken yet.
    pub fn take_events(&self) -> Vec<(u64, Bytes)> {
        std::mem::take(&mut self.shared.lock().events.read)
    }

    /// Tells the memory what is new and takes what has changed in it. To be called after every frame, and when woken.
    pub fn sync(&self, memory: &mut Memory) {
        let changes = memory.take_changes();
        let mut state = self.shared.lock();
        let news = std::mem::take(&mut state.news);
        state.loaded.clear();
        let reset = news.iter().any(|item| matches!(item, News::Reset));
        if !reset && state.role == Role::Writer && !changes.is_empty() {
            let now = Instant::now();
            for change in changes {
                let (id, written) = match change {
                    Change::Written {
                        viewpoint,
                        revision,
                    } => (viewpoint.id, Some((viewpoint, revision))),
                    Change::Removed(id) => (id, None),
                };
                let since = state.pending.get(&id).map_or(now, |pending| pending.since);
                state.pending.insert(id, Pending { written, since });
            }
            self.shared.for_writer.notify_one();
        }
        drop(state);
        for item in news {
            match item {
                News::Reset => memory.reset(),
                News::Taken(id) => memory.reserve_ids(id),
                News::Known(known) => {
                    for (head, version) in known {
                        memory.know(head, version);
                    }
                }
                News::Gone(id) => memory.lose(id),
                News::Loaded(viewpoint, version) => memory.admit(viewpoint, version),
                News::Stored(id, version) => memory.mark_stored(id, version),
            }
        }
        memory.evict(self.shared.options.memory_bytes);
        self.warm(memory);
    }

    /// Fills RAM with what is stored while there is room.
    fn warm(&self, memory: &Memory) {
        let (share, whole) = WARM_SHARE;
        if memory.bytes() / share >= self.shared.options.memory_bytes / whole {
            return;
        }
        let some = memory.some_absent(WARM_AT_ONCE);
        if some.is_empty() {
            return;
        }
        let mut state = self.shared.lock();
        if state.wanted.is_empty() && state.fetching.is_empty() {
            self.want(&mut state, some, self.loads_max(memory));
        }
    }

    /// How many may be on their way that are only expected to be needed: what comes beside the budget stays small.
    fn loads_max(&self, memory: &Memory) -> usize {
        let mean = memory.bytes() / memory.viewpoints().len().max(1);
        let share = self.shared.options.memory_bytes / LOADS_SHARE;
        let fit = share.checked_div(mean).unwrap_or(LOADS_MAX);
        let needed = NEED_FACTOR * self.shared.options.views;
        fit.clamp(needed.min(LOADS_MAX), LOADS_MAX)
    }

    /// How many could not be asked for.
    fn want(&self, state: &mut State, ids: Vec<u64>, loads_max: usize) -> u64 {
        let mut dropped = 0;
        for id in ids {
            if state.is_awaited(id) || state.loaded.contains(&id) {
                continue;
            }
            let under_way = state.wanted.len() + state.fetching.len() + state.loaded.len();
            if under_way >= loads_max {
                dropped += 1;
                continue;
            }
            state.wanted.push_back(id);
        }
        self.shared.for_loader.notify_one();
        dropped
    }

    /// What the memory needs for a frame or a question at a pose and has not in RAM.
    fn lacks(&self, memory: &mut Memory, world_from_camera: &Pose) -> Vec<u64> {
        let options = &self.shared.options;
        memory.begin_turn();
        let count = NEED_FACTOR * options.views;
        memory.need(world_from_camera, count, options.metres_per_radian)
    }

    /// Brings what a question at a pose needs into RAM, a step at a time. `began`: when that began, of which the caller
    /// keeps what is told here. True when everything is there, or nothing more will come in time.
    pub fn bring_step(
        &self,
        memory: &mut Memory,
        world_from_camera: &Pose,
        began: &mut Option<Instant>,
    ) -> bool {
        let needed = self.lacks(memory, world_from_camera);
        if needed.is_empty() {
            if began.take().is_none() {
                self.shared.lock().counters.hits += 1;
            }
            return true;
        }
        let is_first = began.is_none();
        let since = *began.get_or_insert_with(Instant::now);
        let step = Instant::now();
        let is_complete = self.fetch(memory, needed, BRING_STEP);
        let mut state = self.shared.lock();
        state.counters.misses += u64::from(is_first);
        state.counters.miss_seconds += step.elapsed().as_secs_f64();
        let is_hopeless = state.trouble.contains_key(loader::READING);
        let is_late = is_hopeless || since.elapsed() >= BRING_WITHIN;
        if !is_complete && !is_late {
            return false;
        }
        state.counters.incomplete += u64::from(!is_complete);
        *began = None;
        true
    }

    /// Loads these viewpoints, a step at a time; waits as long where the store cannot be reached.
    pub fn fetch_step(&self, memory: &mut Memory, ids: Vec<u64>) {
        if !self.fetch(memory, ids, BRING_STEP) {
            let is_hopeless = |state: &State| state.trouble.contains_key(loader::READING);
            self.wait(BRING_STEP, |state| !is_hopeless(state));
        }
    }

    /// Brings what a frame at a pose needs into RAM. Waits for the store only where something lacks.
    pub fn bring(&self, memory: &mut Memory, world_from_camera: &Pose) -> Brought {
        let needed = self.lacks(memory, world_from_camera);
        if needed.is_empty() {
            self.shared.lock().counters.hits += 1;
            return Brought::Hit;
        }
        let began = Instant::now();
        let is_complete = self.fetch(memory, needed, BRING_WITHIN);
        let mut state = self.shared.lock();
        state.counters.misses += 1;
        state.counters.miss_seconds += began.elapsed().as_secs_f64();
        if is_complete {
            return Brought::Loaded;
        }
        state.counters.incomplete += 1;
        Brought::Incomplete
    }

    /// Loads these viewpoints and waits for them, but no longer than that; whether all are there.
    fn fetch(&self, memory: &mut Memory, ids: Vec<u64>, within: Duration) -> bool {
        let began = Instant::now();
        let mut left = ids;
        if left.is_empty() {
            return true;
        }
        // What changed its state while it was loaded is loaded once more.
        for _ in 0..2 {
            let mut state = self.shared.lock();
            // What is only expected to be needed waits.
            state.wanted.retain(|id| !left.contains(id));
            for &id in left.iter().rev() {
                if !state.fetching.contains(&id) && !state.loaded.contains(&id) {
                    state.wanted.push_front(id);
                }
            }
            state.wanted.truncate(LOADS_MAX);
            let is_hopeless = state.trouble.contains_key(loader::READING);
            drop(state);
            self.shared.for_loader.notify_one();
            if is_hopeless {
                break;
            }
            self.wait(within.saturating_sub(began.elapsed()), |state| {
                !left.iter().any(|id| state.is_awaited(*id))
            });
            self.sync(memory);
            left = memory.absent_of(&left);
            if left.is_empty() {
                return true;
            }
        }
        false
    }

    /// Has loaded what a robot will need if it goes on as it went.
    pub fn prefetch(&self, memory: &mut Memory, source: &Source, passed: Passed) {
        let mut ways = self.ways.lock().unwrap_or_else(PoisonError::into_inner);
        if ways.len() >= WAYS_MAX && !ways.contains_key(source) {
            ways.clear();
        }
        let before = ways.insert(source.clone(), passed);
        drop(ways);
        let Some(before) = before else {
            return;
        };
        let options = &self.shared.options;
        let loads_max = self.loads_max(memory);
        for ahead_s in AHEAD_S {
            let pose = way::ahead(&before, &passed, ahead_s);
            let count = AHEAD_FACTOR * options.views;
            let expected = memory.need(&pose, count, options.metres_per_radian);
            if !expected.is_empty() {
                let mut state = self.shared.lock();
                let dropped = self.want(&mut state, expected, loads_max);
                state.counters.not_prefetched += dropped;
            }
        }
    }

    pub fn status(&self) -> StoreStatus {
        let state = self.shared.lock();
        let oldest = state.pending.values().map(|pending| pending.since).min();
        let found = state.unreadable.values();
        let damaged: Vec<&String> = found
            .filter(|found| found.is_damaged)
            .map(|found| &found.name)
            .collect();
        let left_unread = state.unreadable.len() - damaged.len();
        StoreStatus {
            role: ROLES[match state.role {
                Role::Unread => 0,
                Role::Reader { .. } => 1,
                Role::Writer => 2,
            }],
            holder: match &state.role {
                Role::Reader { holder } => Some(holder.clone()),
                _ => None,
            },
            trouble: state.trouble.values().next().cloned(),
            epoch: state.epoch,
            stored_viewpoints: state.catalogue.len(),
            stored_bytes: state.catalogue.values().map(|known| known.bytes).sum(),
            damaged: state.counters.damaged + damaged.len() as u64,
            damaged_names: {
                let aside = state.counters.damaged_names.iter();
                aside.chain(damaged).take(NAMES_MAX).cloned().collect()
            },
            left_unread,
            pending: state.unstored(),
            pending_s: oldest.map_or(0.0, |since| since.elapsed().as_secs_f64()),
            ..state.counters.clone()
        }
    }

    /// Stores what is pending and lets the place go; false if that was not possible in time.
    pub fn close(&self, memory: &mut Memory, within: Duration) -> bool {
        self.sync(memory);
        self.shared.lock().closing = true;
        self.shared.tell_tasks();
        let closed = self.wait(within, |state| state.closed);
        let state = self.shared.lock();
        let left = state.unstored();
        if left > 0 {
            tracing::error!(
                place = &*self.shared.place,
                "{left} changes could not be stored before the end"
            );
        }
        closed && left == 0
    }

    fn wait(&self, within: Duration, until: impl Fn(&State) -> bool) -> bool {
        let deadline = Instant::now() + within;
        let mut state = self.shared.lock();
        while !until(&state) {
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return false;
            }
            state = self
                .shared
                .arrived
                .wait_timeout(state, left)
                .unwrap_or_else(PoisonError::into_inner)
                .0;
        }
        true
    }
}

fn unread(state: &State) -> Refusal {
    let why = state.trouble.values().next();
    let why = why.map_or("it is being read", String::as_str);
    Refusal::new(
        "memory_unread",
        format!("what is stored of this place is not known yet: {why}; trying on"),
    )
}

impl Drop for PlaceStore {
    fn drop(&mut self) {
        self.shared.lock().closing = true;
        self.shared.tell_tasks();
    }
}
