//! For those who watch: what the workers tell, gathered so that its amount depends neither on the frames' rate nor on how
//! many watch, and handed to each watcher through one ring that never waits for anybody.
//!
//! | queue | bound | beyond it |
//! |---|---|---|
//! | news from the workers | [`NEWS_MAX`] | dropped and counted; watchers are told to look anew |
//! | messages to watchers | [`MESSAGES_MAX`], shared by all | who is slower loses them, is told so and counted |
//! | events to go back to | [`RESUMABLE_MAX`] | the oldest are forgotten |
//! | timeline | [`POINTS_MAX`] a camera | the oldest are forgotten |

use std::{
    collections::{BTreeMap, VecDeque},
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant, SystemTime, UNIX_EPOCH},
};

use serde::Serialize;
use tokio::sync::{broadcast, mpsc};
use utoipa::ToSchema;

use super::{
    metrics::Metrics,
    places::Places,
    status::{CameraStatus, PlaceStatus, PlaceTotals},
};
use crate::{
    model::frame::Source,
    wire::{encode, proto},
};

/// A second of more frames than any service can process.
pub const NEWS_MAX: usize = 1024;
const MESSAGES_MAX: usize = 256;
const RESUMABLE_MAX: usize = 1024;
/// Seconds of the timeline: a quarter of an hour.
const POINTS_MAX: usize = 900;
/// How often watchers are told of what has changed.
const TICK: Duration = Duration::from_millis(250);
/// Over how many ticks frames a second are counted.
const RATE_TICKS: usize = 8;

/// From a place's worker.
#[derive(Debug)]
pub enum News {
    Frame {
        place: Arc<str>,
        source: Source,
        stamp_ns: i64,
        max_surprise: f32,
        coverage: f32,
    },
    Event(Arc<proto::Event>),
}

/// To a watcher.
#[derive(Debug)]
pub enum Message {
    /// A place and those of its cameras that have changed.
    State { place: String, json: String },
    Event {
        number: u64,
        place: String,
        json: String,
    },
    /// Something was lost: look anew.
    Reset,
}

/// A place as watchers see it.
#[derive(Debug, Clone, PartialEq, Serialize, ToSchema)]
pub struct PlaceState {
    #[serde(flatten)]
    pub totals: PlaceTotals,
    pub cameras: Vec<CameraState>,
}

/// What a `state` message carries.
#[derive(Serialize)]
struct StateMessage<'a> {
    now_ms: u64,
    places: [&'a PlaceState; 1],
}

#[derive(Debug, Clone, PartialEq, Serialize, ToSchema)]
pub struct CameraState {
    #[serde(flatten)]
    pub status: CameraStatus,
    /// Processed frames a second, over the last two seconds.
    pub fps: f64,
    /// When the last frame was processed, milliseconds since the epoch by the service's clock.
    pub last_frame_ms: Option<u64>,
    /// Greatest `max_surprise` since watchers were told last.
    pub max_surprise_since: Option<f32>,
    /// `world_from_camera`, as refined.
    pub pose: Option<PoseState>,
    pub image: Option<ImageState>,
    pub intrinsics: Option<IntrinsicsState>,
    pub boxes: Vec<BoxState>,
}

#[derive(Debug, Clone, PartialEq, Serialize, ToSchema)]
pub struct PoseState {
    /// Metres.
    pub position: [f64; 3],
    /// x, y, z, w.
    pub orientation: [f64; 4],
}

/// Pixels.
#[derive(Debug, Clone, PartialEq, Serialize, ToSchema)]
pub struct ImageState {
    pub width: u32,
    pub height: u32,
}

/// Pixels.
#[derive(Debug, Clone, PartialEq, Serialize, ToSchema)]
pub struct IntrinsicsState {
    pub fx: f64,
    pub fy: f64,
    pub cx: f64,
    pub cy: f64,
}

/// A region of the last frame; half-open, pixels.
#[derive(Debug, Clone, PartialEq, Serialize, ToSchema)]
pub struct BoxState {
    /// As text, because it may have 64 bits.
    pub id: String,
    /// Of its event; "0" = none yet.
    pub event_id: String,
    pub x_min: u32,
    pub y_min: u32,
    pub x_max: u32,
    pub y_max: u32,
    /// Nats.
    pub peak_surprise: f32,
    pub mean_surprise: f32,
    /// Pixels.
    pub area: u32,
    /// Metres.
    pub center_in_world: Option<[f64; 3]>,
    pub touches_border: bool,
}

/// A second of a camera's timeline.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, ToSchema)]
pub struct Point {
    /// Of the robot's stamps, seconds since the epoch.
    pub t: i64,
    /// Greatest of that second, nats.
    pub max_surprise: f32,
    /// Least of that second.
    pub coverage: f32,
    pub frames: u32,
}

#[derive(Debug, Clone, Serialize, ToSchema)]
pub struct CameraTimeline {
    pub robot: String,
    pub camera: String,
    /// The oldest first.
    pub points: Vec<Point>,
}

/// Where watchers come.
#[derive(Debug)]
pub struct Live {
    /// Start of the service, milliseconds since the epoch: numbers of another are not of this one.
    pub boot: u64,
    metrics: Arc<Metrics>,
    state: Mutex<State>,
}

#[derive(Debug)]
struct State {
    /// `None` when the service is stopping.
    watchers: Option<broadcast::Sender<Arc<Message>>>,
    places: BTreeMap<String, PlaceState>,
    cameras: BTreeMap<(String, Source), Watched>,
    events: VecDeque<Arc<Message>>,
    last_number: u64,
    news_dropped: u64,
}

/// What is gathered of a camera beside its status.
#[derive(Debug, Default)]
struct Watched {
    timeline: VecDeque<Point>,
    max_since: Option<f32>,
    last_frame_ms: Option<u64>,
    /// When which number of frames was reached.
    counts: VecDeque<(Instant, u64)>,
}

/// A watcher's end.
pub struct Watching {
    pub messages: broadcast::Receiver<Arc<Message>>,
    /// Events that came after the one it knew.
    pub missed: Vec<Arc<Message>>,
    /// Whether nothing else is missing.
    pub resumed: bool,
}

/// Milliseconds since the epoch.
pub fn now_ms() -> u64 {
    let now = SystemTime::now().duration_since(UNIX_EPOCH);
    now.map_or(0, |now| now.as_millis() as u64)
}

/// Gathers until the workers are gone or [`Live::close`].
pub fn start(places: &Arc<Places>, news: mpsc::Receiver<News>) -> Arc<Live> {
    let (watchers, _) = broadcast::channel(MESSAGES_MAX);
    let live = Arc::new(Live {
        boot: now_ms(),
        metrics: places.metrics.clone(),
        state: Mutex::new(State {
            watchers: Some(watchers),
            places: BTreeMap::new(),
            cameras: BTreeMap::new(),
            events: VecDeque::new(),
            last_number: 0,
            news_dropped: 0,
        }),
    });
    let places = Arc::downgrade(places);
    tokio::spawn(gather(live.clone(), places, news));
    live
}

async fn gather(live: Arc<Live>, places: std::sync::Weak<Places>, mut news: mpsc::Receiver<News>) {
    let mut ticks = tokio::time::interval(TICK);
    ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    loop {
        tokio::select! {
            told = news.recv() => match told {
                Some(told) => live.lock().hear(told),
                None => return,
            },
            _ = ticks.tick() => {
                let Some(places) = places.upgrade() else {
                    return;
                };
                let statuses: Vec<_> = places
                    .all()
                    .into_iter()
                    .map(|(_, place)| place.status.borrow().clone())
                    .collect();
                let dropped = live.metrics.news_dropped.get();
                let mut state = live.lock();
                if state.watchers.is_none() {
                    return;
                }
                state.tick(&statuses, dropped);
            }
        }
    }
}

impl Live {
    fn lock(&self) -> MutexGuard<'_, State> {
        // Nothing below panics between two changes that belong together.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Begins to watch. `known`: boot and number of the last event that the watcher has; `None` when the service is
    /// stopping.
    pub fn watch(&self, known: Option<(u64, u64)>) -> Option<Watching> {
        let state = self.lock();
        let messages = state.watchers.as_ref()?.subscribe();
        let known = known.filter(|(boot, _)| *boot == self.boot);
        let oldest = state.last_number - state.events.len() as u64;
        let resumed =
            known.is_some_and(|(_, number)| (oldest..=state.last_number).contains(&number));
        let after = known.map_or(u64::MAX, |(_, number)| number);
        let missed = state.events.iter().filter(
            |message| matches!(***message, Message::Event { number, .. } if number > after),
        );
        Some(Watching {
            messages,
            missed: missed.cloned().collect(),
            resumed,
        })
    }

    /// What a watcher must know first: each place with all its cameras, as `state` messages carry them.
    pub fn states(&self) -> Vec<(String, String)> {
        let state = self.lock();
        let places = state.places.iter();
        places
            .map(|(name, place)| (name.clone(), state_message(place)))
            .collect()
    }

    /// A place's newest status with what was gathered.
    pub fn state_of(&self, status: &PlaceStatus) -> PlaceState {
        let state = self.lock();
        let name = &status.totals.place;
        let cameras = status.cameras.iter();
        PlaceState {
            totals: status.totals.clone(),
            cameras: cameras
                .map(|camera| match state.cameras.get(&key_of(name, camera)) {
                    Some(watched) => watched.state(camera),
                    None => Watched::default().state(camera),
                })
                .collect(),
        }
    }

    /// Of the newest event.
    pub fn last_event_id(&self) -> String {
        self.event_id(self.lock().last_number)
    }

    pub fn event_id(&self, number: u64) -> String {
        format!("{}-{number}", self.boot)
    }

    pub fn timeline(&self, place: &str) -> Vec<CameraTimeline> {
        let state = self.lock();
        let cameras = state.cameras.iter().filter(|((of, _), _)| of == place);
        cameras
            .map(|((_, source), watched)| CameraTimeline {
                robot: source.robot.to_string(),
                camera: source.camera.to_string(),
                points: watched.timeline.iter().copied().collect(),
            })
            .collect()
    }

    /// Ends all watching.
    pub fn close(&self) {
        self.lock().watchers = None;
    }
}

impl State {
    fn hear(&mut self, news: News) {
        match news {
            News::Frame {
                place,
                source,
                stamp_ns,
                max_surprise,
                coverage,
            } => {
                let key = (place.to_string(), source);
                let watched = self.cameras.entry(key).or_default();
                watched.frame(stamp_ns, max_surprise, coverage);
            }
            News::Event(event) => {
                self.last_number += 1;
                let message = Arc::new(Message::Event {
                    number: self.last_number,
                    place: event.place.clone(),
                    json: encode::event_json(&event).to_string(),
                });
                if self.events.len() == RESUMABLE_MAX {
                    self.events.pop_front();
                }
                self.events.push_back(message.clone());
                self.send(message);
            }
        }
    }

    fn send(&self, message: Arc<Message>) {
        if let Some(watchers) = &self.watchers {
            // It fails where nobody watches.
            drop(watchers.send(message));
        }
    }

    fn tick(&mut self, statuses: &[Arc<PlaceStatus>], news_dropped: u64) {
        if self.news_dropped != news_dropped {
            self.news_dropped = news_dropped;
            self.send(Arc::new(Message::Reset));
        }
        let now = Instant::now();
        for status in statuses {
            let name = &status.totals.place;
            let cameras = status
                .cameras
                .iter()
                .map(|camera| {
                    let watched = self.cameras.entry(key_of(name, camera)).or_default();
                    watched.count(now, camera.frames);
                    let state = watched.state(camera);
                    watched.max_since = None;
                    state
                })
                .collect();
            let after = PlaceState {
                totals: status.totals.clone(),
                cameras,
            };
            let before = self.places.get(name);
            let mut changed = after.clone();
            changed
                .cameras
                .retain(|camera| before.is_none_or(|before| !before.cameras.contains(camera)));
            let same = before.is_some_and(|before| before.totals == after.totals);
            if !same || !changed.cameras.is_empty() {
                if self
                    .watchers
                    .as_ref()
                    .is_some_and(|w| w.receiver_count() > 0)
                {
                    self.send(Arc::new(Message::State {
                        place: name.clone(),
                        json: state_message(&changed),
                    }));
                }
                self.places.insert(name.clone(), after);
            }
        }
        // Places and cameras that made room for others.
        let before = self.places.len();
        let is_here = |name: &String| statuses.iter().any(|status| status.totals.place == *name);
        self.places.retain(|name, _| is_here(name));
        if self.places.len() < before {
            self.send(Arc::new(Message::Reset));
        }
        let known = |key: &(String, Source)| {
            statuses.iter().any(|status| {
                status.totals.place == key.0
                    && status.cameras.iter().any(|camera| {
                        *camera.robot == *key.1.robot && *camera.camera == *key.1.camera
                    })
            })
        };
        self.cameras.retain(|key, _| known(key));
    }
}

impl Watched {
    fn frame(&mut self, stamp_ns: i64, max_surprise: f32, coverage: f32) {
        let most = self
            .max_since
            .map_or(max_surprise, |most| most.max(max_surprise));
        self.max_since = Some(most);
        self.last_frame_ms = Some(now_ms());
        let t = stamp_ns.div_euclid(1_000_000_000);
        match self.timeline.back_mut() {
            Some(point) if point.t == t => {
                point.max_surprise = point.max_surprise.max(max_surprise);
                point.coverage = point.coverage.min(coverage);
                point.frames += 1;
            }
            _ => {
                if self.timeline.len() == POINTS_MAX {
                    self.timeline.pop_front();
                }
                self.timeline.push_back(Point {
                    t,
                    max_surprise,
                    coverage,
                    frames: 1,
                });
            }
        }
    }

    fn count(&mut self, now: Instant, frames: u64) {
        if self.counts.len() == RATE_TICKS {
            self.counts.pop_front();
        }
        self.counts.push_back((now, frames));
    }

    /// Frames a second, to a tenth: less would be news at every tick.
    fn rate(&self) -> f64 {
        let (Some((since, before)), Some((until, frames))) =
            (self.counts.front(), self.counts.back())
        else {
            return 0.0;
        };
        let seconds = (*until - *since).as_secs_f64();
        let rate = frames.saturating_sub(*before) as f64 / seconds.max(TICK.as_secs_f64());
        (10.0 * rate).round() / 10.0
    }

    fn state(&self, status: &CameraStatus) -> CameraState {
        let report = status.report.as_deref();
        CameraState {
            fps: self.rate(),
            last_frame_ms: self.last_frame_ms,
            max_surprise_since: self.max_since,
            pose: report
                .and_then(|report| report.world_from_camera.as_ref())
                .and_then(pose),
            image: report.map(|report| ImageState {
                width: report.width,
                height: report.height,
            }),
            intrinsics: status.intrinsics.map(|intrinsics| IntrinsicsState {
                fx: intrinsics.fx,
                fy: intrinsics.fy,
                cx: intrinsics.cx,
                cy: intrinsics.cy,
            }),
            boxes: report.map_or_else(Vec::new, |report| {
                report.regions.iter().map(box_of).collect()
            }),
            status: status.clone(),
        }
    }
}

fn key_of(place: &str, camera: &CameraStatus) -> (String, Source) {
    let source = Source {
        robot: camera.robot.as_str().into(),
        camera: camera.camera.as_str().into(),
    };
    (place.to_owned(), source)
}

fn state_message(place: &PlaceState) -> String {
    let message = StateMessage {
        now_ms: now_ms(),
        places: [place],
    };
    serde_json::to_string(&message).expect("states map to JSON")
}

fn pose(pose: &proto::Pose) -> Option<PoseState> {
    let (position, turn) = (pose.position.as_ref()?, pose.orientation.as_ref()?);
    Some(PoseState {
        position: [position.x, position.y, position.z],
        orientation: [turn.x, turn.y, turn.z, turn.w],
    })
}

fn box_of(region: &proto::Region) -> BoxState {
    let proto::Box {
        x_min,
        y_min,
        x_max,
        y_max,
    } = region.r#box.unwrap_or_default();
    BoxState {
        id: region.id.to_string(),
        event_id: region.event_id.to_string(),
        x_min,
        y_min,
        x_max,
        y_max,
        peak_surprise: region.peak_surprise,
        mean_surprise: region.mean_surprise,
        area: region.area,
        center_in_world: region
            .center_in_world
            .as_ref()
            .map(|center| [center.x, center.y, center.z]),
        touches_border: region.touches_border,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn live() -> Live {
        Live {
            boot: 7,
            metrics: Arc::default(),
            state: Mutex::new(State {
                watchers: Some(broadcast::channel(MESSAGES_MAX).0),
                places: BTreeMap::new(),
                cameras: BTreeMap::new(),
                events: VecDeque::new(),
                last_number: 0,
                news_dropped: 0,
            }),
        }
    }

    fn numbers(watching: &Watching) -> Vec<u64> {
        let missed = watching.missed.iter();
        missed
            .map(|message| match **message {
                Message::Event { number, .. } => number,
                _ => panic!("only events are resumed"),
            })
            .collect()
    }

    #[test]
    fn who_was_away_gets_what_it_missed_or_is_told_that_it_is_too_much() {
        let live = live();
        let all = RESUMABLE_MAX as u64 + 10;
        for _ in 0..all {
            live.lock().hear(News::Event(Arc::default()));
        }
        let back = live.watch(Some((7, all - 3))).expect("it is open");
        assert!(back.resumed);
        assert_eq!(numbers(&back), [all - 2, all - 1, all]);
        let up_to_date = live.watch(Some((7, all))).expect("it is open");
        assert!(up_to_date.resumed && up_to_date.missed.is_empty());
        assert!(live.watch(Some((7, 10))).expect("it is open").resumed);
        for known in [Some((7, 9)), Some((7, all + 1)), Some((6, all)), None] {
            let anew = live.watch(known).expect("it is open");
            assert!(!anew.resumed, "{known:?}");
        }
        live.close();
        assert!(live.watch(None).is_none());
    }

    #[test]
    fn a_watcher_that_does_not_read_loses_messages_and_keeps_none() {
        let live = live();
        let mut watching = live.watch(None).expect("it is open");
        for _ in 0..3 * MESSAGES_MAX {
            live.lock().hear(News::Event(Arc::default()));
        }
        assert!(watching.messages.len() <= 3 * MESSAGES_MAX);
        assert!(matches!(
            watching.messages.try_recv(),
            Err(broadcast::error::TryRecvError::Lagged(lost)) if lost == 2 * MESSAGES_MAX as u64
        ));
    }

    #[test]
    fn the_timeline_keeps_the_greatest_of_each_second_of_a_quarter_of_an_hour() {
        let mut watched = Watched::default();
        for frame in 0..10_000i64 {
            watched.frame(frame * 100_000_000, (frame % 10) as f32, 0.9);
        }
        assert_eq!(watched.timeline.len(), POINTS_MAX);
        let last = watched.timeline.back().expect("there are some");
        assert_eq!((last.t, last.max_surprise, last.frames), (999, 9.0, 10));
        assert_eq!(
            watched.state(&CameraStatus::default()).max_surprise_since,
            Some(9.0)
        );
    }
}
