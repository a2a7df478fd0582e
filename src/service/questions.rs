//! Questions to the memory, the same over Zenoh and HTTP: a checked request goes to the place's worker as an
//! [`Ask`], its answer becomes a reply here. Bounded thrice: so many asks a place ([`super::inbox`]), so many bytes of
//! requests and replies in all, and so much time each. What is beyond is refused as busy or late, and counted.

use std::{
    sync::{Arc, atomic::Ordering},
    time::Duration,
};

use tokio::{
    sync::{OwnedSemaphorePermit, Semaphore, oneshot},
    time::timeout,
};

use super::{
    ask::{Answer, Ask, Snapshot},
    camera::busy,
    ingest::IngestCounters,
    places::{Place, Places},
};
use crate::{
    memory::forget::Forgetting,
    model::{frame::Source, mode::Mode, refusal::Refusal},
    wire::{
        decode::{
            Limits,
            questions::{self, VIEWS_MAX, bad},
        },
        encode::{self, PriorPlane},
        keys::{self, CameraPath},
        proto,
    },
};

/// For an answer. Less than whoever asks waits by default: 10 s for a Zenoh get, as for a page.
const ANSWER_WITHIN: Duration = Duration::from_secs(8);
/// Planes of one prior: all of them of a megapixel.
const REPLY_BYTES_MAX: usize = 64 << 20;
/// Requests and replies under way, of all questions together, in units of a KiB.
const ROOM_KIB: usize = 512 << 10;
/// A reply is held as planes, as a message and as bytes at once.
const COPIES: usize = 3;

/// A reply with the room that it takes up.
#[derive(Debug)]
pub struct Held<T> {
    pub reply: T,
    pub room: Option<OwnedSemaphorePermit>,
}

pub struct Questions {
    pub places: Arc<Places>,
    pub limits: Limits,
    counters: Arc<IngestCounters>,
    room: Arc<Semaphore>,
}

impl Questions {
    pub fn new(places: Arc<Places>, counters: Arc<IngestCounters>) -> Self {
        Self {
            limits: Limits::new(&places.settings),
            places,
            counters,
            room: Arc::new(Semaphore::new(ROOM_KIB)),
        }
    }

    /// Room for a request or a reply of so many bytes.
    ///
    /// # Errors
    /// `busy`.
    pub fn room(&self, bytes: usize) -> Result<OwnedSemaphorePermit, Refusal> {
        let kib = (bytes.div_ceil(1024).saturating_mul(COPIES)).min(ROOM_KIB) as u32;
        let room = self.room.clone().try_acquire_many_owned(kib);
        room.map_err(|_| self.busy())
    }

    /// Counts it.
    pub fn busy(&self) -> Refusal {
        self.counters.questions_busy.fetch_add(1, Ordering::Relaxed);
        busy()
    }

    /// Counts what comes of a question.
    async fn counted<T>(
        &self,
        kind: &'static str,
        answer: impl Future<Output = Result<T, Refusal>>,
    ) -> Result<T, Refusal> {
        let answer = answer.await;
        let outcome = answer
            .as_ref()
            .map_or_else(|refusal| refusal.code, |_| "ok");
        self.places.metrics.query(kind, outcome);
        answer
    }

    /// What a camera saw last.
    ///
    /// # Errors
    /// `unknown_camera`, `busy`, `late`.
    pub async fn picture(&self, place: &Place, camera: Source) -> Result<Arc<Snapshot>, Refusal> {
        let asked = self.ask(place, |answer| Ask::Snapshot { camera, answer });
        self.counted("picture", asked).await
    }

    /// Puts an ask and waits for its answer.
    ///
    /// # Errors
    /// `busy`, `late`, or whatever the worker says.
    async fn ask<T>(
        &self,
        place: &Place,
        make: impl FnOnce(Answer<T>) -> Ask,
    ) -> Result<T, Refusal> {
        let (sender, answer) = oneshot::channel();
        place.inbox.put_ask(make(sender)).map_err(|_full| busy())?;
        answered_within(ANSWER_WITHIN, answer, &self.counters).await
    }

    /// # Errors
    /// What is wrong with the request; `image_too_large`, `busy`, `late`.
    pub async fn prior(
        &self,
        place: &Place,
        request: &proto::PriorRequest,
    ) -> Result<Held<proto::PriorReply>, Refusal> {
        self.counted("prior", async {
        let (world_from_camera, intrinsics, planes) =
            questions::prior(request, self.limits.image_pixels_max)?;
        let per_pixel: usize = PriorPlane::ALL
            .into_iter()
            .filter(|plane| planes.contains(plane))
            .map(PriorPlane::bytes_per_pixel)
            .sum();
        let bytes = intrinsics.pixels().saturating_mul(per_pixel);
        if bytes > REPLY_BYTES_MAX {
            return Err(Refusal::new(
                "image_too_large",
                format!(
                    "these planes of {} pixels are more than {REPLY_BYTES_MAX} bytes: ask for a smaller image, or for fewer planes at once",
                    intrinsics.pixels()
                ),
            ));
        }
        let room = self.room(bytes)?;
        let picked = self
            .ask(place, |answer| Ask::Prior {
                world_from_camera,
                intrinsics,
                planes,
                brought_since: None,
                answer,
            })
            .await?;
        let reply = off_the_loop(move || picked.draw()).await?;
        Ok(Held {
            reply,
            room: Some(room),
        })
        }).await
    }

    /// `camera`: whose calibration and visit to use; `name`: the place's. The request's room is the caller's.
    ///
    /// # Errors
    /// What is wrong with the frame; `busy`, `late`.
    pub async fn evaluate(
        &self,
        name: &str,
        place: &Place,
        request: proto::EvaluateRequest,
        camera: Option<Source>,
    ) -> Result<Held<proto::EvaluateReply>, Refusal> {
        self.counted("evaluate", async {
            let frame = request.frame.ok_or_else(|| {
                Refusal::new("no_image", "the request has no frame: fill `frame`")
            })?;
            let evaluated = self
                .ask(place, |answer| Ask::Evaluate {
                    frame: Box::new(frame),
                    camera,
                    brought_since: None,
                    answer,
                })
                .await?;
            let room = self.room(size_of_val(evaluated.surprise.as_slice()))?;
            let report = encode::report(&evaluated.report, name, evaluated.processing_seconds);
            let (width, height) = (evaluated.report.width, evaluated.report.height);
            let map = encode::plane(width, height, evaluated.surprise.into_iter());
            Ok(Held {
                reply: proto::EvaluateReply {
                    report: Some(report),
                    map: Some(map),
                },
                room: Some(room),
            })
        })
        .await
    }

    /// # Errors
    /// `busy`, `late`.
    pub async fn views(
        &self,
        place: &Place,
        request: &proto::ViewsRequest,
    ) -> Result<proto::ViewsReply, Refusal> {
        self.counted("views", async {
            let limit = match request.limit as usize {
                0 => VIEWS_MAX,
                limit => limit.min(VIEWS_MAX),
            };
            let after = request.after;
            self.ask(place, |answer| Ask::Views {
                after,
                limit,
                answer,
            })
            .await
        })
        .await
    }

    /// # Errors
    /// What is wrong with the request; `unknown_camera`, `busy`, `late`.
    pub async fn next_view(
        &self,
        place: &Place,
        request: &proto::NextViewRequest,
    ) -> Result<proto::NextViewReply, Refusal> {
        self.counted("next_view", async {
            let question = questions::next_view(request, self.limits.image_pixels_max)?;
            let ring = request.ring.as_ref();
            let camera = match ring.map(|ring| (ring.robot.as_str(), ring.camera.as_str())) {
                None => None,
                Some((robot, camera)) => camera_named(robot, camera)?,
            };
            self.ask(place, |answer| Ask::NextView {
                question,
                camera,
                answer,
            })
            .await
        })
        .await
    }

    /// # Errors
    /// What is wrong with the request; `busy`. After `late` it goes on all the same.
    pub async fn forget(
        &self,
        place: &Place,
        request: &proto::ForgetRequest,
    ) -> Result<proto::ForgetReply, Refusal> {
        self.counted("forget", async {
            let forgetting = Box::new(Forgetting::new(questions::forget(request)?));
            self.ask(place, |answer| Ask::Forget { forgetting, answer })
                .await
        })
        .await
    }

    /// How cameras of the place begin, or how they are all to be from now on.
    ///
    /// # Errors
    /// `unknown_place`, `too_many_places`, `busy`, `late`.
    pub async fn mode_of_place(&self, name: &str, set: Option<Mode>) -> Result<Mode, Refusal> {
        self.counted("mode", async {
            let place = match set {
                None => self.places.known(name).await?,
                Some(_) => self.open(name)?,
            };
            self.ask(&place, |answer| Ask::Mode {
                camera: None,
                set,
                answer,
            })
            .await
        })
        .await
    }

    /// How a camera's frames are taken, or are to be taken from now on. It need not have sent any yet to be told.
    ///
    /// # Errors
    /// `unknown_place`, `unknown_camera`, `too_many_places`, `too_many_cameras`, `busy`, `late`.
    pub async fn mode(&self, path: &CameraPath, set: Option<Mode>) -> Result<Mode, Refusal> {
        self.counted("mode", async {
        let place = match set {
            None => {
                let place = self.places.known(&path.place).await?;
                if !place.inbox.cameras().contains_key(&path.source) {
                    return Err(Refusal::new(
                        "unknown_camera",
                        "nothing of this camera has come yet: it will begin with the place's mode",
                    ));
                }
                place
            }
            Some(_) => {
                let place = self.open(&path.place)?;
                place.inbox.open(&path.source)?;
                place
            }
        };
        self.ask(&place, |answer| Ask::Mode {
            camera: Some(path.source.clone()),
            set,
            answer,
        })
        .await
        }).await
    }

    fn open(&self, name: &str) -> Result<Arc<Place>, Refusal> {
        if !keys::is_id(name) {
            return Err(bad("a place is [a-z0-9_-]+"));
        }
        self.places.get_or_open(&name.into())
    }
}

/// A worker's answer, if it comes in time; else nobody waits for it any more.
///
/// # Errors
/// `late`, `closing`, or whatever the worker says.
async fn answered_within<T>(
    within: Duration,
    answer: oneshot::Receiver<Result<T, Refusal>>,
    counters: &IngestCounters,
) -> Result<T, Refusal> {
    match timeout(within, answer).await {
        Ok(Ok(answer)) => answer,
        Ok(Err(_)) => Err(Refusal::new(
            "closing",
            "the service is stopping, or the place has just made room for another: ask again",
        )),
        Err(_) => {
            counters.questions_late.fetch_add(1, Ordering::Relaxed);
            Err(Refusal::new(
                "late",
                format!(
                    "the place did not come to an answer within {} s: ask for less, or when fewer ask",
                    within.as_secs()
                ),
            ))
        }
    }
}

/// Both names, or neither.
///
/// # Errors
/// `bad_request`.
pub fn camera_named(robot: &str, camera: &str) -> Result<Option<Source>, Refusal> {
    match (robot, camera) {
        ("", "") => Ok(None),
        _ if keys::is_id(robot) && keys::is_id(camera) => Ok(Some(Source {
            robot: robot.into(),
            camera: camera.into(),
        })),
        _ => Err(bad("give both robot and camera as [a-z0-9_-]+, or none")),
    }
}

/// For what takes a while and waits for nothing.
///
/// # Errors
/// `closing`: the service is stopping.
pub async fn off_the_loop<T: Send + 'static>(
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<T, Refusal> {
    tokio::task::spawn_blocking(work)
        .await
        .map_err(|_| Refusal::new("closing", "the service is stopping"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::service::inbox::Inbox;

    #[tokio::test]
    async fn an_answer_that_does_not_come_in_time_is_late_counted_and_not_worked_for_any_more() {
        let counters = IngestCounters::default();
        let inbox = Inbox::default();
        let (sender, receiver) = oneshot::channel();
        let ask = Ask::Views {
            after: 0,
            limit: 1,
            answer: sender,
        };
        inbox.put_ask(ask).expect("room");
        let late = answered_within(Duration::from_millis(1), receiver, &counters).await;
        assert_eq!(late.expect_err("nobody answers").code, "late");
        assert_eq!(counters.questions_late.load(Ordering::Relaxed), 1);
        assert!(inbox.take_ask().expect("it waits").is_abandoned());

        let (sender, receiver) = oneshot::channel::<Result<(), Refusal>>();
        drop(sender);
        let closing = answered_within(ANSWER_WITHIN, receiver, &counters).await;
        assert_eq!(closing.expect_err("nobody is there").code, "closing");
        let (sender, receiver) = oneshot::channel();
        sender.send(Ok(7)).expect("somebody waits");
        let answered = answered_within(ANSWER_WITHIN, receiver, &counters).await;
        assert_eq!(answered.expect("in time"), 7);
        assert_eq!(counters.questions_late.load(Ordering::Relaxed), 1);
    }
}
