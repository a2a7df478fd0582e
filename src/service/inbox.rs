//! What waits for a place's worker. Every queue has a bound and says what happens beyond it:
//!
//! | queue | bound | beyond it |
//! |---|---|---|
//! | frames | one a camera | the newest wins, the replaced is counted |
//! | calibrations, modes | one a camera | the newest wins |
//! | poses and markers | [`POSES_MAX`] a camera | the oldest is dropped and counted |
//! | refusals | [`REFUSALS_MAX`] a camera | the newest is only counted |
//! | asks, the one under way included | [`ASKS_MAX`] | refused as busy and counted |
//! | cameras | [`CAMERAS_MAX`] | the one unheard for a minute makes room, or the new one is refused |
//!
//! Putting never waits: the lock is held for moves only.

use std::{
    collections::{BTreeMap, VecDeque},
    sync::{Condvar, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use zenoh::bytes::ZBytes;

use super::ask::Ask;
use crate::model::{frame::Source, mode::Mode, refusal::Refusal};

/// A second of a 250 Hz tracker: a worker is never away for longer.
pub const POSES_MAX: usize = 256;
pub const REFUSALS_MAX: usize = 4;
/// Each takes the time of a frame or less.
pub const ASKS_MAX: usize = 16;
/// Each keeps a frame or two of a few megabytes.
pub const CAMERAS_MAX: usize = 64;
/// A camera that said nothing for so long may make room for another.
const UNHEARD: Duration = Duration::from_secs(60);

/// A frame as it came.
#[derive(Debug)]
pub struct Arrival {
    pub payload: ZBytes,
    pub arrived: Instant,
    /// Got by the service, which may get the same frame twice.
    pub pulled: bool,
}

/// What came for a camera beside frames.
#[derive(Debug)]
pub enum Aside {
    Pose(ZBytes),
    /// The plate's markers, from which a pose follows.
    Markers(ZBytes),
    Calibration(ZBytes),
    /// The robot was asked for it; whoever wanted to answer has.
    CalibrationAsked,
    Mode(Mode),
    /// Not even worth decoding; the key's leaf on which it came.
    Refused(&'static str, Refusal),
}

/// Counted on the way in.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize, utoipa::ToSchema)]
pub struct SlotCounters {
    /// Frames that a newer one replaced before the worker was free.
    pub frames_replaced: u64,
    pub poses_dropped: u64,
    /// Refusals too many to be published.
    pub refusals_dropped: u64,
}

/// Of all cameras of a place, also those that made room for others.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize, utoipa::ToSchema)]
pub struct InboxCounters {
    pub frames_received: u64,
    /// Of frames.
    pub bytes_received: u64,
    /// Frames that a newer one replaced before the worker was free.
    pub frames_replaced: u64,
    pub poses_dropped: u64,
    /// Asks refused because the queue was full.
    pub asks_busy: u64,
}

/// What waits in an inbox.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Depths {
    pub frames: usize,
    pub poses: usize,
    pub asks: usize,
}

#[derive(Debug)]
struct Slot {
    frame: Option<Arrival>,
    replaced_since_taken: u64,
    /// Poses and markers, in the order they came.
    poses: VecDeque<Aside>,
    calibration: Option<ZBytes>,
    calibration_asked: bool,
    mode: Option<Mode>,
    refused: VecDeque<(&'static str, Refusal)>,
    live: bool,
    /// A get for a frame is under way.
    pulling: bool,
    heard: Instant,
    counters: SlotCounters,
}

#[derive(Debug, Default)]
struct State {
    cameras: BTreeMap<Source, Slot>,
    asks: VecDeque<Ask>,
    /// One was taken and may come back.
    ask_under_way: bool,
    counters: InboxCounters,
    /// A camera came or went.
    live_changed: bool,
    /// The stored memory has news.
    memory_news: bool,
    /// When a message last came.
    heard: Option<Instant>,
    closed: bool,
}

#[derive(Debug, Default)]
pub struct Inbox {
    state: Mutex<State>,
    wake: Condvar,
}

/// Everything but frames that has come since the last delivery.
#[derive(Debug, Default)]
pub struct Delivery {
    pub asides: Vec<(Source, Aside)>,
    /// Asks can be taken.
    pub asks: bool,
    /// Cameras whose frame can be taken.
    pub frames: Vec<Source>,
    /// A camera came or went.
    pub live_changed: bool,
    /// The stored memory has news.
    pub memory_news: bool,
    pub closed: bool,
}

/// An ask that found no place in the queue.
#[derive(Debug)]
pub struct NotAsked;

impl Inbox {
    fn lock(&self) -> MutexGuard<'_, State> {
        // Nothing below panics between two changes that belong together.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn with_slot(
        &self,
        source: &Source,
        put: impl FnOnce(&mut Slot, &mut InboxCounters),
    ) -> Result<(), Refusal> {
        let mut state = self.lock();
        let state = &mut *state;
        if !state.cameras.contains_key(source) {
            make_room(state)?;
        }
        let slot = state.cameras.entry(source.clone()).or_insert_with(|| Slot {
            frame: None,
            replaced_since_taken: 0,
            poses: VecDeque::new(),
            calibration: None,
            calibration_asked: false,
            mode: None,
            refused: VecDeque::new(),
            live: false,
            pulling: false,
            heard: Instant::now(),
            counters: SlotCounters::default(),
        });
        slot.heard = Instant::now();
        state.heard = Some(slot.heard);
        put(slot, &mut state.counters);
        self.wake.notify_one();
        Ok(())
    }

    /// # Errors
    /// `too_many_cameras`, as everything that is put for a camera.
    pub fn put_frame(&self, source: &Source, arrival: Arrival) -> Result<(), Refusal> {
        self.with_slot(source, |slot, place| {
            place.frames_received += 1;
            place.bytes_received += arrival.payload.len() as u64;
            if slot.frame.replace(arrival).is_some() {
                slot.replaced_since_taken += 1;
                slot.counters.frames_replaced += 1;
                place.frames_replaced += 1;
            }
        })
    }

    /// # Errors
    /// `too_many_cameras`.
    pub fn put_aside(&self, source: &Source, aside: Aside) -> Result<(), Refusal> {
        self.with_slot(source, |slot, place| match aside {
            Aside::Pose(_) | Aside::Markers(_) => {
                if slot.poses.len() == POSES_MAX {
                    slot.poses.pop_front();
                    slot.counters.poses_dropped += 1;
                    place.poses_dropped += 1;
                }
                slot.poses.push_back(aside);
            }
            Aside::Calibration(payload) => slot.calibration = Some(payload),
            Aside::CalibrationAsked => slot.calibration_asked = true,
            Aside::Mode(mode) => slot.mode = Some(mode),
            Aside::Refused(leaf, refusal) => {
                if slot.refused.len() == REFUSALS_MAX {
                    slot.counters.refusals_dropped += 1;
                } else {
                    slot.refused.push_back((leaf, refusal));
                }
            }
        })
    }

    /// # Errors
    /// `too_many_cameras`.
    pub fn set_live(&self, source: &Source, live: bool) -> Result<(), Refusal> {
        self.with_slot(source, |slot, _| slot.live = live)?;
        self.lock().live_changed = true;
        self.wake.notify_one();
        Ok(())
    }

    /// # Errors
    /// When the queue is full or the place is closing.
    pub fn put_ask(&self, ask: Ask) -> Result<(), NotAsked> {
        let mut state = self.lock();
        let asks = state.asks.len() + usize::from(state.ask_under_way);
        if state.closed || asks >= ASKS_MAX {
            state.counters.asks_busy += 1;
            return Err(NotAsked);
        }
        state.asks.push_back(ask);
        drop(state);
        self.wake.notify_one();
        Ok(())
    }

    /// Says that the stored memory has news.
    pub fn put_memory_news(&self) {
        self.lock().memory_news = true;
        self.wake.notify_one();
    }

    /// The ask that waited longest since it came or was last worked at. It keeps its room until [`Self::end_ask`].
    pub fn take_ask(&self) -> Option<Ask> {
        let mut state = self.lock();
        let ask = state.asks.pop_front()?;
        state.ask_under_way = true;
        Some(ask)
    }

    /// Ends the turn of the ask that was taken; what is left of it waits behind the others.
    pub fn end_ask(&self, left: Option<Ask>) {
        let mut state = self.lock();
        state.ask_under_way = false;
        state.asks.extend(left);
    }

    /// Makes sure that the camera has a slot.
    ///
    /// # Errors
    /// `too_many_cameras`.
    pub fn open(&self, source: &Source) -> Result<(), Refusal> {
        self.with_slot(source, |_, _| ())
    }

    pub fn close(&self) {
        self.lock().closed = true;
        self.wake.notify_one();
    }

    /// Live cameras without a get under way; marks one under way for each.
    pub fn start_pulls(&self) -> Vec<Source> {
        let mut state = self.lock();
        let idle = state
            .cameras
            .iter_mut()
            .filter(|(_, slot)| slot.live && !slot.pulling);
        idle.map(|(source, slot)| {
            slot.pulling = true;
            source.clone()
        })
        .collect()
    }

    pub fn end_pull(&self, source: &Source) {
        if let Some(slot) = self.lock().cameras.get_mut(source) {
            slot.pulling = false;
        }
    }

    /// Waits until there is something to do or `deadline` passes. Frames of the cameras in `held` are nothing to do:
    /// the worker still has one of theirs.
    pub fn wait(&self, deadline: Option<Instant>, held: impl Fn(&Source) -> bool) -> Delivery {
        let mut state = self.lock();
        loop {
            let delivery = state.deliver(&held);
            if !delivery.is_empty() {
                return delivery;
            }
            state = match deadline {
                None => self
                    .wake
                    .wait(state)
                    .unwrap_or_else(PoisonError::into_inner),
                Some(deadline) => {
                    let left = deadline.saturating_duration_since(Instant::now());
                    if left.is_zero() {
                        return delivery;
                    }
                    self.wake
                        .wait_timeout(state, left)
                        .unwrap_or_else(PoisonError::into_inner)
                        .0
                }
            };
        }
    }

    /// The camera's newest frame, and how many it replaced.
    pub fn take_frame(&self, source: &Source) -> Option<(Arrival, u64)> {
        let mut state = self.lock();
        let slot = state.cameras.get_mut(source)?;
        let arrival = slot.frame.take()?;
        Some((arrival, std::mem::take(&mut slot.replaced_since_taken)))
    }

    /// Of every camera that has a slot: whether it is live, and its counters.
    pub fn cameras(&self) -> BTreeMap<Source, (bool, SlotCounters)> {
        let state = self.lock();
        let cameras = state.cameras.iter();
        cameras
            .map(|(source, slot)| (source.clone(), (slot.live, slot.counters)))
            .collect()
    }

    /// When a message last came, if ever; `None` while something waits or a camera says that it is there.
    pub fn heard(&self) -> Option<Option<Instant>> {
        let state = self.lock();
        let waits = |slot: &Slot| slot.live || slot.frame.is_some();
        let busy = !state.asks.is_empty() || state.ask_under_way;
        (!busy && !state.cameras.values().any(waits)).then_some(state.heard)
    }

    pub fn counters(&self) -> InboxCounters {
        self.lock().counters
    }

    pub fn depths(&self) -> Depths {
        let state = self.lock();
        let slots = || state.cameras.values();
        Depths {
            frames: slots().filter(|slot| slot.frame.is_some()).count(),
            poses: slots().map(|slot| slot.poses.len()).sum(),
            asks: state.asks.len(),
        }
    }
}

fn make_room(state: &mut State) -> Result<(), Refusal> {
    if state.cameras.len() < CAMERAS_MAX {
        return Ok(());
    }
    let unheard = state
        .cameras
        .iter()
        .filter(|(_, slot)| !slot.live && slot.heard.elapsed() > UNHEARD)
        .min_by_key(|(_, slot)| slot.heard)
        .map(|(source, _)| source.clone());
    let Some(unheard) = unheard else {
        return Err(Refusal::new(
            "too_many_cameras",
            format!(
                "the place already has {CAMERAS_MAX} cameras: stop one of them and wait a minute, or use another place"
            ),
        ));
    };
    state.cameras.remove(&unheard);
    Ok(())
}

impl State {
    fn deliver(&mut self, held: &impl Fn(&Source) -> bool) -> Delivery {
        let mut delivery = Delivery {
            asks: !self.asks.is_empty(),
            live_changed: std::mem::take(&mut self.live_changed),
            memory_news: std::mem::take(&mut self.memory_news),
            closed: self.closed,
            ..Delivery::default()
        };
        for (source, slot) in &mut self.cameras {
            let calibration = slot.calibration.take().map(Aside::Calibration);
            let asked = std::mem::take(&mut slot.calibration_asked);
            let asked = asked.then_some(Aside::CalibrationAsked);
            let mode = slot.mode.take().map(Aside::Mode);
            let poses = slot.poses.drain(..);
            let refused = slot
                .refused
                .drain(..)
                .map(|(leaf, refusal)| Aside::Refused(leaf, refusal));
            let asides = calibration.into_iter().chain(asked).chain(mode);
            for aside in asides.chain(poses).chain(refused) {
                delivery.asides.push((source.clone(), aside));
            }
            if slot.frame.is_some() && !held(source) {
                delivery.frames.push(source.clone());
            }
        }
        delivery
    }
}

impl Delivery {
    fn is_empty(&self) -> bool {
        self.asides.is_empty()
            && !self.asks
            && self.frames.is_empty()
            && !self.live_changed
            && !self.memory_news
            && !self.closed
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn source(camera: usize) -> Source {
        Source {
            robot: "r".into(),
            camera: camera.to_string().into(),
        }
    }

    fn arrival(byte: u8) -> Arrival {
        Arrival {
            payload: ZBytes::from(vec![byte]),
            arrived: Instant::now(),
            pulled: false,
        }
    }

    #[test]
    fn the_newest_frame_wins_and_the_replaced_are_counted() {
        let inbox = Inbox::default();
        for byte in 0..5 {
            inbox.put_frame(&source(0), arrival(byte)).expect("room");
        }
        let (newest, replaced) = inbox.take_frame(&source(0)).expect("a frame came");
        assert_eq!((newest.payload.to_bytes()[0], replaced), (4, 4));
        assert!(inbox.take_frame(&source(0)).is_none());
        assert_eq!(inbox.cameras()[&source(0)].1.frames_replaced, 4);
    }

    #[test]
    fn queues_are_bounded() {
        let inbox = Inbox::default();
        for byte in 0..=u8::MAX {
            for _ in 0..4 {
                inbox
                    .put_aside(&source(0), Aside::Pose(ZBytes::from(vec![byte])))
                    .expect("room");
            }
        }
        let delivery = inbox.wait(None, |_| false);
        assert_eq!(delivery.asides.len(), POSES_MAX);
        assert_eq!(
            inbox.cameras()[&source(0)].1.poses_dropped,
            4 * 256 - POSES_MAX as u64
        );
    }

    #[test]
    fn an_ask_keeps_its_room_while_it_is_worked_at() {
        let inbox = Inbox::default();
        let ask = || {
            let (answer, _) = tokio::sync::oneshot::channel();
            Ask::Mode {
                camera: None,
                set: None,
                answer,
            }
        };
        for _ in 0..ASKS_MAX {
            inbox.put_ask(ask()).expect("room");
        }
        inbox.put_ask(ask()).expect_err("the queue is full");
        let taken = inbox.take_ask().expect("one waits");
        inbox.put_ask(ask()).expect_err("one is under way");
        inbox.end_ask(Some(taken));
        inbox.put_ask(ask()).expect_err("it is back");
        drop(inbox.take_ask());
        inbox.end_ask(None);
        inbox.put_ask(ask()).expect("it was answered");
        assert_eq!(inbox.counters().asks_busy, 3);
    }

    #[test]
    fn a_camera_too_many_is_refused() {
        let inbox = Inbox::default();
        for camera in 0..CAMERAS_MAX {
            inbox.put_frame(&source(camera), arrival(0)).expect("room");
        }
        let refusal = inbox
            .put_frame(&source(CAMERAS_MAX), arrival(0))
            .expect_err("no camera has been silent for a minute");
        assert_eq!(refusal.code, "too_many_cameras");
    }

    #[test]
    fn a_camera_that_comes_or_goes_wakes_once() {
        let inbox = Inbox::default();
        inbox.set_live(&source(0), true).expect("room");
        assert!(inbox.wait(None, |_| false).live_changed);
        assert!(inbox.wait(Some(Instant::now()), |_| false).is_empty());
    }

    #[test]
    fn a_held_camera_gives_no_reason_to_wake() {
        let inbox = Inbox::default();
        inbox.put_frame(&source(0), arrival(0)).expect("room");
        let delivery = inbox.wait(Some(Instant::now()), |_| true);
        assert!(delivery.is_empty());
    }
}
