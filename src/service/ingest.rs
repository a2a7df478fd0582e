//! From Zenoh to the places' inboxes. Callbacks run on Zenoh's few threads, so they move a message into a bounded slot
//! or hand it on by `try_send`, and nothing else; a place's worker is started by a task.

use std::{
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::{Duration, Instant},
};

use tokio::{sync::mpsc, task::JoinHandle};
use zenoh::{
    Session, Wait,
    bytes::{Encoding, ZBytes},
    pubsub::Subscriber,
    query::Reply,
    sample::{Sample, SampleKind},
};

use super::{
    camera::CALIBRATION_WAIT,
    inbox::{Arrival, Aside, Inbox},
    places::{Places, Starts},
};
use crate::{
    model::{frame::Source, mode::Mode, refusal::Refusal},
    wire::{
        decode::{self, Limits},
        encode,
        keys::{self, CameraPath},
        proto,
    },
};

/// Refusals to publish that no place's worker can.
const REFUSALS_MAX: usize = 64;
/// More than any name of a mode takes.
const MODE_BYTES_MAX: usize = 64;
/// A robot that does not answer a pull within this time is asked again.
const PULL_TIMEOUT: Duration = Duration::from_secs(2);

/// What a robot sends on one of its keys.
#[derive(Debug)]
enum Message {
    Frame(Arrival),
    Aside(Aside),
    Live(bool),
}

/// Counted where no place could be blamed.
#[derive(Debug, Default, serde::Serialize)]
pub struct IngestCounters {
    /// Keys below the root that name no camera.
    pub bad_keys: AtomicU64,
    /// Refused because there are too many places or cameras.
    pub refused: AtomicU64,
    /// Of these, how many were too many to be published.
    pub refused_unpublished: AtomicU64,
    /// Queries that found their queue full and ended without a reply.
    pub queries_dropped: AtomicU64,
    /// Questions, over Zenoh or HTTP, that were refused as busy before they reached a place.
    pub questions_busy: AtomicU64,
    /// Questions that no place came to in time.
    pub questions_late: AtomicU64,
}

/// Ends with its value.
pub struct Ingest {
    pub counters: Arc<IngestCounters>,
    _subscribers: Vec<Subscriber<()>>,
    tasks: Vec<JoinHandle<()>>,
}

impl Drop for Ingest {
    fn drop(&mut self) {
        for task in &self.tasks {
            task.abort();
        }
    }
}

/// Refused although no worker knows the camera.
type Refused = (CameraPath, &'static str, Refusal);

/// Where callbacks put things.
#[derive(Clone)]
struct Door {
    places: Arc<Places>,
    limits: Limits,
    refused: mpsc::Sender<Refused>,
    counters: Arc<IngestCounters>,
}

impl Door {
    /// Never waits.
    fn put(&self, path: CameraPath, leaf: &'static str, message: Message) {
        let put = self
            .places
            .get_or_open(&path.place)
            .and_then(|place| put(&place.inbox, &path.source, message));
        let Err(refusal) = put else {
            return;
        };
        self.counters.refused.fetch_add(1, Ordering::Relaxed);
        if self.refused.try_send((path, leaf, refusal)).is_err() {
            self.counters
                .refused_unpublished
                .fetch_add(1, Ordering::Relaxed);
        }
    }

    fn sample(&self, leaf: &'static str, sample: &Sample) {
        if sample.kind() == SampleKind::Delete {
            return;
        }
        let Some(path) = CameraPath::parse(&self.places.root, sample.key_expr().as_str()) else {
            self.bad_key(sample.key_expr().as_str());
            return;
        };
        if leaf == keys::MODE {
            let aside =
                mode(sample).map_or_else(|refusal| Aside::Refused(leaf, refusal), Aside::Mode);
            return self.put(path, leaf, Message::Aside(aside));
        }
        let checked = checked_payload(leaf, sample, self.limits.message_bytes_max());
        let message = match checked {
            Err(refusal) => Message::Aside(Aside::Refused(leaf, refusal)),
            Ok(payload) => match leaf {
                keys::POSE => Message::Aside(Aside::Pose(payload)),
                keys::MARKERS => Message::Aside(Aside::Markers(payload)),
                keys::CALIBRATION => Message::Aside(Aside::Calibration(payload)),
                _ => Message::Frame(Arrival {
                    payload,
                    arrived: Instant::now(),
                    pulled: false,
                }),
            },
        };
        self.put(path, leaf, message);
    }

    fn live(&self, sample: &Sample) {
        match CameraPath::parse_live(&self.places.root, sample.key_expr().as_str()) {
            Some(path) => {
                let live = sample.kind() == SampleKind::Put;
                self.put(path, keys::FRAME, Message::Live(live));
            }
            None => self.bad_key(sample.key_expr().as_str()),
        }
    }

    fn bad_key(&self, key: &str) {
        let count = 1 + self.counters.bad_keys.fetch_add(1, Ordering::Relaxed);
        // Nobody can be told on such a key; a robot that goes on would fill the log.
        if count.is_power_of_two() {
            tracing::warn!(
                count,
                "{key} names no camera: places, robots and cameras are [a-z0-9_-]+, at most {} long",
                keys::ID_LENGTH_MAX
            );
        }
    }
}

fn put(inbox: &Inbox, source: &Source, message: Message) -> Result<(), Refusal> {
    match message {
        Message::Frame(arrival) => inbox.put_frame(source, arrival),
        Message::Aside(aside) => inbox.put_aside(source, aside),
        Message::Live(live) => inbox.set_live(source, live),
    }
}

fn expected_encoding(leaf: &str) -> Encoding {
    match leaf {
        keys::POSE => keys::encoding::<proto::PoseSample>(),
        keys::MARKERS => keys::encoding::<proto::Markers>(),
        keys::CALIBRATION => keys::encoding::<proto::Calibration>(),
        _ => keys::encoding::<proto::Frame>(),
    }
}

fn checked_payload(leaf: &str, sample: &Sample, bytes_max: usize) -> Result<ZBytes, Refusal> {
    let expected = expected_encoding(leaf);
    if *sample.encoding() != expected {
        let got: String = sample.encoding().to_string().chars().take(64).collect();
        return Err(Refusal::new(
            "wrong_encoding",
            format!("the encoding is `{got}`: set it to `{expected}`"),
        ));
    }
    if sample.payload().len() > bytes_max {
        return Err(Refusal::new(
            "message_too_large",
            format!(
                "the message has {} bytes, more than the {bytes_max} that image_pixels_max allows: send smaller or compressed pictures",
                sample.payload().len()
            ),
        ));
    }
    Ok(sample.payload().clone())
}

/// As a `Mode`, or as its name in plain text.
fn mode(sample: &Sample) -> Result<Mode, Refusal> {
    if sample.payload().len() > MODE_BYTES_MAX {
        return decode::questions::mode("");
    }
    let bytes = sample.payload().to_bytes();
    if *sample.encoding() == keys::encoding::<proto::Mode>() {
        return decode::questions::mode(&decode::message::<proto::Mode>(&bytes)?.mode);
    }
    // Whatever a shell calls it.
    decode::questions::mode(&String::from_utf8_lossy(&bytes))
}

/// Subscribes to what robots send.
///
/// # Errors
/// What Zenoh says when the session is closing.
pub fn start(places: &Arc<Places>, starts: Starts) -> zenoh::Result<Ingest> {
    let (refused, refusals) = mpsc::channel(REFUSALS_MAX);
    let counters = Arc::new(IngestCounters::default());
    let door = Door {
        places: places.clone(),
        limits: Limits::new(&places.settings),
        refused,
        counters: counters.clone(),
    };
    let session = &places.session;
    let mut subscribers = Vec::new();
    for leaf in [
        keys::MODE,
        keys::CALIBRATION,
        keys::POSE,
        keys::MARKERS,
        keys::FRAME,
    ] {
        let door = door.clone();
        subscribers.push(
            session
                .declare_subscriber(keys::every_camera(&places.root, leaf))
                .callback(move |sample| door.sample(leaf, &sample))
                .wait()?,
        );
    }
    let live = door.clone();
    subscribers.push(
        session
            .liveliness()
            .declare_subscriber(keys::every_live_camera(&places.root))
            .history(true)
            .callback(move |sample| live.live(&sample))
            .wait()?,
    );
    let mut tasks = vec![
        tokio::spawn(start_places(places.clone(), starts)),
        tokio::spawn(publish_refusals(places.clone(), refusals)),
    ];
    if places.settings.pull_hz > 0.0 {
        tasks.push(tokio::spawn(pull(door)));
    }
    Ok(Ingest {
        counters,
        _subscribers: subscribers,
        tasks,
    })
}

async fn start_places(places: Arc<Places>, mut starts: Starts) {
    while let Some(name) = starts.recv().await {
        places.start(&name);
    }
}

async fn publish_refusals(places: Arc<Places>, mut refusals: mpsc::Receiver<Refused>) {
    while let Some((path, leaf, refusal)) = refusals.recv().await {
        let key = path.key(&places.root, leaf);
        tracing::debug!(code = refusal.code, "refused on {key}: {refusal}");
        let rejection = encode::rejection(&key, &refusal, 0, 0);
        let sent = places
            .session
            .put(
                path.key(&places.root, keys::REJECTED),
                encode::bytes(&rejection),
            )
            .encoding(keys::encoding::<proto::Rejection>())
            .await;
        if let Err(error) = sent {
            tracing::debug!("not published: {error}");
        }
    }
}

/// Gets the frames of live cameras at the settings' rate; a camera that has not answered yet is left out.
async fn pull(door: Door) {
    let places = door.places.clone();
    let period = Duration::from_secs_f64(1.0 / places.settings.pull_hz);
    let mut ticks = tokio::time::interval(period);
    ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    loop {
        ticks.tick().await;
        for (name, place) in places.all() {
            for source in place.inbox.start_pulls() {
                let path = CameraPath {
                    place: name.clone(),
                    source,
                };
                let ended = EndPull {
                    inbox: place.inbox.clone(),
                    source: path.source.clone(),
                };
                let key = path.key(&places.root, keys::FRAME);
                let door = door.clone();
                let got = places
                    .session
                    .get(key)
                    .timeout(PULL_TIMEOUT)
                    .callback(move |reply| {
                        // Moved in, so that it ends with the last reply.
                        let _ended = &ended;
                        door.pulled(&path, &reply);
                    })
                    .await;
                if let Err(error) = got {
                    tracing::debug!("no pull: {error}");
                }
            }
        }
    }
}

impl Door {
    fn pulled(&self, path: &CameraPath, reply: &Reply) {
        // A robot without a new frame may answer with an error: nothing is lost.
        let Ok(sample) = reply.result() else {
            return;
        };
        let message = match checked_payload(keys::FRAME, sample, self.limits.message_bytes_max()) {
            Ok(payload) => Message::Frame(Arrival {
                payload,
                arrived: Instant::now(),
                pulled: true,
            }),
            Err(refusal) => Message::Aside(Aside::Refused(keys::FRAME, refusal)),
        };
        self.put(path.clone(), keys::FRAME, message);
    }
}

struct EndPull {
    inbox: Arc<Inbox>,
    source: Source,
}

impl Drop for EndPull {
    fn drop(&mut self) {
        self.inbox.end_pull(&self.source);
    }
}

/// Gets a calibration from the robot's queryable into the inbox; returns at once.
pub fn calibration_getter(
    session: Session,
    root: Arc<str>,
    inbox: Arc<Inbox>,
) -> Box<dyn Fn(&CameraPath) + Send> {
    Box::new(move |path| {
        let answers = CalibrationAnswers {
            inbox: inbox.clone(),
            source: path.source.clone(),
        };
        let got = session
            .get(path.key(&root, keys::CALIBRATION))
            .timeout(CALIBRATION_WAIT)
            .callback(move |reply| {
                // Errors are the same as no answer: the frame says so when it has waited long enough.
                let Ok(sample) = reply.result() else {
                    return;
                };
                answers.put(match checked_payload(keys::CALIBRATION, sample, 1 << 20) {
                    Ok(payload) => Aside::Calibration(payload),
                    Err(refusal) => Aside::Refused(keys::CALIBRATION, refusal),
                });
            })
            .wait();
        if let Err(error) = got {
            tracing::debug!("no get for a calibration: {error}");
        }
    })
}

/// Says that it was the last when it ends: at once where nobody answers such gets.
struct CalibrationAnswers {
    inbox: Arc<Inbox>,
    source: Source,
}

impl CalibrationAnswers {
    fn put(&self, aside: Aside) {
        if let Err(refusal) = self.inbox.put_aside(&self.source, aside) {
            tracing::debug!("calibration not taken: {refusal}");
        }
    }
}

impl Drop for CalibrationAnswers {
    fn drop(&mut self) {
        self.put(Aside::CalibrationAsked);
    }
}
