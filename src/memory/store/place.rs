//! The stored memory of one place, as the place's worker sees it: hands over what changed, learns what is known, asks
//! for what it needs. All that touches the store runs in tasks of its own; [`super::shared`] is what they share.

use std::{
    collections::HashMap,
    sync::{Arc, Mutex, PoisonError},
    time::{Duration, Instant},
};

use bytes::Bytes;
use tokio::runtime::Handle;

use super::{
    Store, form, keeper,
    loader::{self, LOADS_MAX},
    shared::{NAMES_MAX, News, Pending, PlaceOptions, ROLES, Role, Shared, State, StoreStatus},
    way::{self, Passed},
};
use crate::{
    memory::{Memory, residency::Change},
    model::{
        frame::Source,
        mode::Modes,
        pose::Pose,
        refusal::{PLACE_HELD, Refusal},
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
        let shared = Arc::new(Shared::new(place, store.shelf(place), options, wake));
        runtime.spawn(keeper::keep(shared.clone()));
        Self {
            shared,
            ways: Mutex::default(),
        }
    }

    /// Waits until the store has been read; false if that takes too long.
    pub fn wait_read(&self, within: Duration) -> bool {
        self.shared.wait(within, |state| state.role != Role::Unread)
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
            Role::Reader { holder } => Err(held(holder)),
            Role::Unread => Err(unread(&state)),
        }
    }

    /// Whether what is said here about modes will hold. Before the place has been read that is kept until it can be
    /// stored.
    ///
    /// # Errors
    /// `place_held`.
    pub fn may_say(&self) -> Result<(), Refusal> {
        match &self.shared.lock().role {
            Role::Reader { holder } => Err(held(holder)),
            Role::Writer | Role::Unread => Ok(()),
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
            let by = Instant::now() + self.shared.options.write_behind_half();
            state.events.keep(id, content.map(Bytes::from), by);
            self.shared.for_writer.notify_one();
        }
    }

    /// Keeps a camera's calibration, whose id it has: soon where this service writes the place, else when it does.
    pub fn keep_calibration(&self, source: &Source, content: Vec<u8>) {
        let id = form::checksum(format!("{}/{}", source.robot, source.camera).as_bytes());
        let mut state = self.shared.lock();
        let content = Some(Bytes::from(content));
        state.calibrations.keep(id, content, Instant::now());
        self.shared.for_writer.notify_one();
    }

    /// Stored calibrations that were not taken yet.
    pub fn take_calibrations(&self) -> Vec<Bytes> {
        let read = std::mem::take(&mut self.shared.lock().calibrations.read);
        read.into_iter().map(|(_, content)| content).collect()
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
            self.shared.wait(BRING_STEP, |state| !is_hopeless(state));
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
            self.shared
                .wait(within.saturating_sub(began.elapsed()), |state| {
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
        let closed = self.shared.wait(within, |state| state.closed);
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
}

fn held(holder: &str) -> Refusal {
    Refusal::new(
        PLACE_HELD,
        format!(
            "this place is written by another service ({holder}); this one answers questions and takes over when that one is gone"
        ),
    )
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
