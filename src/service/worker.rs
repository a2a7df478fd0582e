//! The thread that owns a place: its pipeline, its memory, and what is known about its cameras. It takes one frame at a
//! time, of the camera that waited longest for its turn, and works at asks in between, as [`super::turns`] says.

use std::{
    collections::BTreeMap,
    sync::Arc,
    time::{Duration, Instant},
};

use tokio::sync::{mpsc, watch};

use super::{
    ask::{Ask, Evaluated, Snapshot},
    camera::{Camera, Refused, Turn, lenses_alone, pose_alone, unpack},
    events::{self, PlaceEvents},
    inbox::{Aside, CAMERAS_MAX, Delivery, Inbox},
    live::News,
    metrics::{Metrics, Stopwatches},
    publish::CameraPublisher,
    status::{CameraStatus, PlaceStatus, PlaceTotals},
    turns::{self, Hands, take_turns},
};
use crate::{
    memory::{forget::Forgetting, store::PlaceStore},
    model::{
        camera::Intrinsics,
        frame::{RgbImage, Source},
        mode::{Mode, Modes},
        pose::{Pose, PoseNoise},
        refusal::Refusal,
        report::Report,
    },
    pipeline::Pipeline,
    stages::next_view,
    wire::{
        decode::{
            self, Limits, PackedFrame,
            questions::{Candidates, NextView, bad},
        },
        encode::{self, PriorPlanes},
        keys::{self, CameraPath},
        picture, proto,
    },
};

/// Cameras whose modes are kept while the cameras themselves have made room for others.
const MODES_MAX: usize = 1024;
/// Viewpoints that a step of forgetting goes through: about the time of a frame, and more than all cameras can write
/// between two steps, so that it comes to an end.
const FORGET_STEP: usize = 2 * CAMERAS_MAX;
/// Stored viewpoints that such a step brings into RAM.
const FORGET_LOADED: usize = 16;
/// A ring's camera is imagined no larger than this where nothing is said: ranks hardly depend on it.
const IMAGINED_PIXELS_MAX: usize = 320 * 240;

/// How long a starting worker waits for what is stored of its place.
const READ_WITHIN: Duration = Duration::from_secs(3);
/// How long a closing worker waits until everything is stored.
const STORE_WITHIN: Duration = Duration::from_secs(2);

pub struct Worker {
    pub place: Arc<str>,
    pub root: Arc<str>,
    pub session: zenoh::Session,
    pub inbox: Arc<Inbox>,
    pub pipeline: Pipeline,
    /// Where the place's memory lasts.
    pub memory: Option<PlaceStore>,
    pub status: watch::Sender<Arc<PlaceStatus>>,
    pub events: watch::Sender<Arc<PlaceEvents>>,
    pub metrics: Arc<Metrics>,
    /// For whoever watches over HTTP.
    pub news: Option<mpsc::Sender<News>>,
    /// Asks a robot for its calibration; the answer comes through the inbox.
    pub ask_calibration: Box<dyn Fn(&CameraPath) + Send>,
}

/// What the loop keeps from turn to turn.
struct Desk {
    worker: Worker,
    limits: Limits,
    noise_default: PoseNoise,
    pose_wait: Duration,
    cameras: BTreeMap<Source, Camera>,
    /// Whose last frame the pipeline's maps are of.
    maps_of: Option<Source>,
    frames: u64,
    /// Of cameras that made room for others, and what was refused.
    frames_lost_before: u64,
    refused_by: BTreeMap<&'static str, u64>,
    stopwatches: Stopwatches,
    /// What was said about modes; of a stored memory, what holds there.
    modes: Modes,
    asks: AskCounters,
}

#[derive(Debug, Default)]
struct AskCounters {
    answered: u64,
    passes: u64,
    abandoned: u64,
}

impl Worker {
    /// Until the inbox is closed.
    pub fn run(self) {
        let settings = self.pipeline.settings();
        let mut desk = Desk {
            limits: Limits::new(settings),
            noise_default: PoseNoise {
                position_m: settings.pose_position_sd_m,
                rotation_rad: settings.pose_rotation_sd_rad,
            },
            pose_wait: Duration::from_secs_f64(settings.pose_wait_s),
            cameras: BTreeMap::new(),
            maps_of: None,
            frames: 0,
            frames_lost_before: 0,
            refused_by: BTreeMap::new(),
            stopwatches: self.metrics.stopwatches(&self.place),
            modes: Modes::default(),
            asks: AskCounters::default(),
            worker: self,
        };
        if let Some(memory) = &desk.worker.memory {
            // Most stores answer at once; frames of the others are refused with the reason.
            memory.wait_read(READ_WITHIN);
        }
        desk.sync_memory();
        let inbox = desk.worker.inbox.clone();
        take_turns(&inbox, &mut desk);
        let Worker {
            memory, pipeline, ..
        } = &mut desk.worker;
        if let Some(memory) = memory {
            memory.close(pipeline.memory_mut(), STORE_WITHIN);
        }
    }
}

impl Hands for Desk {
    fn holds(&self, source: &Source) -> bool {
        let camera = self.cameras.get(source);
        camera.is_some_and(|camera| camera.waiting.is_some())
    }

    fn receive(&mut self, delivery: Delivery) {
        for (source, aside) in delivery.asides {
            self.aside(&source, aside);
        }
        for source in delivery.frames {
            self.receive_frame(&source);
        }
        self.sync_memory();
        self.fit_markers();
    }

    fn serve(&mut self, but: &[Source]) -> turns::Turn {
        self.serve_longest_waiting(but)
    }

    fn step(&mut self, ask: Ask) -> Option<Ask> {
        if ask.is_abandoned() {
            self.asks.abandoned += 1;
            return None;
        }
        let left = self.work_at(ask);
        self.asks.answered += u64::from(left.is_none());
        left
    }

    fn publish(&mut self) {
        self.publish_status();
    }
}

impl Desk {
    /// The camera's entry, made when it is first heard of; `None` when the session is closing.
    fn camera(&mut self, source: &Source) -> Option<&mut Camera> {
        if !self.cameras.contains_key(source) {
            let path = CameraPath {
                place: self.worker.place.clone(),
                source: source.clone(),
            };
            let Worker { session, root, .. } = &self.worker;
            match CameraPublisher::new(session, root, &path) {
                Ok(publisher) => {
                    self.cameras
                        .insert(source.clone(), Camera::new(path, publisher));
                }
                Err(error) => {
                    tracing::warn!("no publishers for {}: {error}", path.key(root, ""));
                    return None;
                }
            }
        }
        self.cameras.get_mut(source)
    }

    fn aside(&mut self, source: &Source, aside: Aside) {
        let limits = self.limits;
        let set = match aside {
            Aside::Mode(mode) => self.set_mode(Some(source), mode),
            _ => Ok(()),
        };
        let Some(camera) = self.camera(source) else {
            return;
        };
        let (leaf, result) = match aside {
            Aside::Pose(payload) => (
                keys::POSE,
                decode::pose_sample(&payload.to_bytes())
                    .and_then(|(stamp_ns, pose)| camera.track.push(stamp_ns, pose)),
            ),
            Aside::Markers(payload) => (
                keys::MARKERS,
                decode::markers_sample(&payload.to_bytes())
                    .map(|(stamp_ns, markers)| camera.put_markers(stamp_ns, markers)),
            ),
            Aside::Calibration(payload) => (
                keys::CALIBRATION,
                decode::message::<proto::Calibration>(&payload.to_bytes())
                    .and_then(|message| decode::calibration(&message))
                    .and_then(|calibration| camera.set_calibration(calibration, limits)),
            ),
            Aside::Mode(_) => (keys::MODE, set),
            Aside::Refused(leaf, refusal) => (leaf, Err(refusal)),
        };
        if let Err(refusal) = result {
            self.refuse(
                source,
                leaf,
                Refused {
                    refusal,
                    stamp_ns: 0,
                    sequence: 0,
                },
            );
        }
    }

    fn receive_frame(&mut self, source: &Source) {
        let limits = self.limits;
        let Some((arrival, replaced)) = self.worker.inbox.take_frame(source) else {
            return;
        };
        let Some(camera) = self.camera(source) else {
            return;
        };
        if let Err(refused) = camera.receive(arrival, replaced, limits) {
            self.refuse(source, keys::FRAME, refused);
        }
    }

    /// Makes poses of the markers whose plate is known by now.
    fn fit_markers(&mut self) {
        let refused: Vec<(Source, Refused)> = self
            .cameras
            .iter_mut()
            .flat_map(|(source, camera)| {
                let refused = camera.fit_markers();
                refused.into_iter().map(|refused| (source.clone(), refused))
            })
            .collect();
        for (source, refused) in refused {
            self.refuse(&source, keys::MARKERS, refused);
        }
    }

    /// How the frames of a camera are taken.
    fn mode(&self, source: &Source) -> Mode {
        let said = self.modes.of(source);
        said.unwrap_or_else(|| self.worker.pipeline.settings().mode(&source.robot))
    }

    /// How the cameras of the place begin.
    fn mode_of_place(&self) -> Mode {
        let settings = self.worker.pipeline.settings();
        self.modes.place.unwrap_or(settings.mode)
    }

    /// Of a camera, or of all of them: what was said for single ones before is forgotten then.
    fn set_mode(&mut self, source: Option<&Source>, mode: Mode) -> Result<(), Refusal> {
        let said = Modes::said(source, mode);
        let then = self.modes.then(&said);
        if then.cameras.len() > MODES_MAX {
            return Err(Refusal::new(
                "too_many_cameras",
                format!(
                    "modes of {MODES_MAX} cameras are kept already: set the place's mode instead"
                ),
            ));
        }
        self.modes = then;
        if let Some(memory) = &self.worker.memory {
            memory.say(&said);
        }
        Ok(())
    }

    /// Serves the ready frame of the camera that was served longest ago.
    fn serve_longest_waiting(&mut self, but: &[Source]) -> turns::Turn {
        let now = Instant::now();
        let mut wake: Option<Instant> = None;
        let mut order: Vec<Source> = self
            .cameras
            .values()
            .filter(|camera| camera.waiting.is_some() && !but.contains(&camera.path.source))
            .map(|camera| camera.path.source.clone())
            .collect();
        order.sort_by_key(|source| self.cameras.get(source).map(|camera| camera.served));
        for source in order {
            let Some(camera) = self.cameras.get_mut(&source) else {
                continue;
            };
            match camera.turn(now, self.pose_wait, &self.worker.ask_calibration) {
                None => {}
                Some(Turn::Until(deadline)) => {
                    wake = Some(wake.map_or(deadline, |wake| wake.min(deadline)));
                }
                Some(Turn::Refused(refused)) => self.refuse(&source, keys::FRAME, refused),
                Some(Turn::Ready(pose, packed, arrived)) => {
                    self.frames += 1;
                    camera.served = self.frames;
                    let (stamp_ns, sequence) = (packed.stamp_ns, packed.sequence);
                    if let Err(refusal) = self.serve_frame(&source, pose, &packed, arrived) {
                        self.frames -= 1;
                        self.refuse(
                            &source,
                            keys::FRAME,
                            Refused {
                                refusal,
                                stamp_ns,
                                sequence,
                            },
                        );
                    }
                    return turns::Turn {
                        served: Some(source),
                        wake: None,
                    };
                }
            }
        }
        turns::Turn { served: None, wake }
    }

    fn serve_frame(
        &mut self,
        source: &Source,
        pose: Pose,
        packed: &PackedFrame,
        arrived: Instant,
    ) -> Result<(), Refusal> {
        self.may_recall()?;
        // Asked before the modes: whoever has become the place's writer has read what the last one was told.
        let may_learn = self.worker.memory.as_ref().map(PlaceStore::may_learn);
        self.sync_modes();
        let mode = self.mode(source);
        if mode == Mode::Learn {
            may_learn.unwrap_or(Ok(()))?;
        }
        let mut stopwatch = self.stopwatches.start();
        let (limits, noise) = (self.limits, self.noise_default);
        let Some(camera) = self.cameras.get_mut(source) else {
            return Ok(());
        };
        let lenses = camera.lenses(packed.calibration.as_ref(), limits)?;
        let frame = unpack(packed, &lenses, source.clone(), pose, noise, limits)?;
        stopwatch.decoded();
        let Worker {
            place,
            pipeline,
            memory,
            ..
        } = &mut self.worker;
        if let Some(memory) = memory {
            memory.bring(pipeline.memory_mut(), &pose);
        }
        let report = pipeline.process_staged(mode, &frame, &mut |stage| stopwatch.ended(stage))?;
        if let Some(memory) = memory {
            let held = pipeline.memory_mut();
            memory.sync(held);
            memory.prefetch(held, source, (frame.stamp_ns, report.world_from_camera));
        }
        let processing_seconds = stopwatch.elapsed().as_secs_f64();
        self.maps_of = Some(source.clone());
        let message = encode::report(&report, place, processing_seconds);
        camera.publisher.report(&message);
        camera.publisher.maps(&report, || pipeline.maps());
        stopwatch.published(arrived);
        camera.processed(
            frame.image,
            lenses,
            report.world_from_camera,
            message,
            frame.stamp_ns,
        );
        if camera.watched(Instant::now()) {
            camera.show(|image, report| snapshot(pipeline, image, report));
        }
        self.tell(&report);
        Ok(())
    }

    /// Publishes what has changed about events, and tells the watchers of the frame.
    fn tell(&self, report: &Report) {
        let Worker {
            place,
            root,
            session,
            events,
            memory,
            metrics,
            news,
            ..
        } = &self.worker;
        let tell = |message| {
            let Some(news) = news else { return };
            if news.try_send(message).is_err() {
                metrics.news_dropped.inc();
            }
        };
        for event in &report.events {
            let (mut message, mut gone) = (Arc::default(), None);
            events.send_modify(|events| {
                (message, gone) = Arc::make_mut(events).put(event, place);
            });
            if let Some(memory) = memory {
                memory.keep_event(message.id, Some(encode::bytes(&*message)));
                if let Some(gone) = gone {
                    memory.keep_event(gone, None);
                }
            }
            events::publish(session, root, &message);
            metrics.event(place, &message.kind, &message.state);
            tell(News::Event(message));
        }
        tell(News::Frame {
            place: place.clone(),
            source: report.source.clone(),
            stamp_ns: report.stamp_ns,
            max_surprise: report.max_surprise,
            coverage: report.coverage,
        });
    }

    /// # Errors
    /// `memory_unread`.
    fn may_recall(&self) -> Result<(), Refusal> {
        let memory = self.worker.memory.as_ref();
        memory.map_or(Ok(()), PlaceStore::may_recall)
    }

    /// Learns what is stored of the modes.
    fn sync_modes(&mut self) {
        let memory = self.worker.memory.as_ref();
        if let Some(modes) = memory.and_then(PlaceStore::take_modes) {
            self.modes = modes;
        }
    }

    /// Learns what is new about the stored memory.
    fn sync_memory(&mut self) {
        self.sync_modes();
        let Worker {
            memory, pipeline, ..
        } = &mut self.worker;
        if let Some(memory) = memory {
            memory.sync(pipeline.memory_mut());
        }
        self.sync_events();
    }

    /// Goes on with stored events, as after a restart.
    fn sync_events(&mut self) {
        let Worker {
            place,
            memory,
            pipeline,
            events,
            ..
        } = &mut self.worker;
        let Some(memory) = memory else { return };
        for (id, content) in memory.take_events() {
            match decode::event::stored(&content) {
                Ok((message, event)) => {
                    pipeline.resume_event(event);
                    let mut gone = None;
                    events.send_modify(|events| gone = Arc::make_mut(events).restore(message));
                    if let Some(gone) = gone {
                        memory.keep_event(gone, None);
                    }
                }
                Err(refusal) => {
                    tracing::warn!(
                        place = &**place,
                        "stored event {id} is not told of: {refusal}"
                    );
                }
            }
        }
    }

    /// Whether what is stored around a pose is in RAM, or will not be in time; else the question has to wait for its
    /// next turn.
    fn bring(&mut self, world_from_camera: &Pose, since: &mut Option<Instant>) -> bool {
        let Worker {
            memory, pipeline, ..
        } = &mut self.worker;
        memory
            .as_ref()
            .is_none_or(|memory| memory.bring_step(pipeline.memory_mut(), world_from_camera, since))
    }

    fn refuse(&mut self, source: &Source, leaf: &'static str, refused: Refused) {
        let root = self.worker.root.clone();
        *self.refused_by.entry(refused.refusal.code).or_default() += 1;
        let Some(camera) = self.camera(source) else {
            return;
        };
        let Refused {
            refusal,
            stamp_ns,
            sequence,
        } = refused;
        let key = camera.path.key(&root, leaf);
        let count = camera.status.refused.entry(refusal.code).or_default();
        *count += 1;
        // Once is news; a robot that goes on would fill the log.
        if *count == 1 {
            tracing::warn!(code = refusal.code, "refused on {key}: {refusal}");
        } else {
            tracing::debug!(code = refusal.code, "refused on {key}: {refusal}");
        }
        camera.publisher.refused(&key, &refusal, stamp_ns, sequence);
        camera.status.last_refusal = Some(format!("{}: {refusal}", refusal.code));
    }

    /// One step of an ask; what is left of it.
    fn work_at(&mut self, ask: Ask) -> Option<Ask> {
        // Whoever asked may have gone meanwhile: sending fails then, and there is nothing to do about it.
        let ask = match self.may_recall() {
            Ok(()) => ask,
            Err(refusal) => ask.refused_unread(refusal)?,
        };
        match ask {
            Ask::Prior {
                world_from_camera,
                intrinsics,
                planes,
                mut brought_since,
                answer,
            } => {
                if !self.bring(&world_from_camera, &mut brought_since) {
                    return Some(Ask::Prior {
                        world_from_camera,
                        intrinsics,
                        planes,
                        brought_since,
                        answer,
                    });
                }
                self.asks.passes += 1;
                let prior = self.worker.pipeline.prior(&intrinsics, &world_from_camera);
                drop(answer.send(Ok(PriorPlanes::new(&prior, &planes))));
            }
            Ask::Evaluate {
                frame,
                camera,
                mut brought_since,
                answer,
            } => {
                // A frame whose pose has yet to be made of its markers brings what it needs itself.
                let pose = frame.world_from_camera.as_ref();
                let pose = pose.and_then(|pose| decode::pose(pose).ok());
                if pose.is_some_and(|pose| !self.bring(&pose, &mut brought_since)) {
                    return Some(Ask::Evaluate {
                        frame,
                        camera,
                        brought_since,
                        answer,
                    });
                }
                self.asks.passes += 1;
                drop(answer.send(self.evaluate(*frame, camera, pose.is_some())));
            }
            Ask::Views {
                after,
                limit,
                answer,
            } => {
                let memory = self.worker.pipeline.memory();
                let views = memory.heads();
                let asked = views.iter().filter(|view| view.id > after).take(limit);
                drop(answer.send(Ok(encode::views_reply(asked, memory.known()))));
            }
            Ask::Snapshot { camera, answer } => {
                let current = self.maps_of.as_ref() == Some(&camera);
                let pipeline = &self.worker.pipeline;
                match self.cameras.get_mut(&camera) {
                    Some(known) => known.look(
                        answer,
                        Instant::now(),
                        current.then_some(|image, report| snapshot(pipeline, image, report)),
                    ),
                    None => drop(answer.send(Err(unknown_camera()))),
                }
            }
            Ask::NextView {
                question,
                camera,
                answer,
            } => match self.candidates(question, camera) {
                Ok((candidates, intrinsics)) => {
                    return self.work_at(Ask::Ranking {
                        promises: Vec::with_capacity(candidates.len()),
                        brought_since: None,
                        candidates,
                        intrinsics,
                        answer,
                    });
                }
                Err(refusal) => drop(answer.send(Err(refusal))),
            },
            Ask::Ranking {
                candidates,
                intrinsics,
                mut promises,
                mut brought_since,
                answer,
            } => {
                if let Some(candidate) = candidates.get(promises.len())
                    && self.bring(candidate, &mut brought_since)
                {
                    self.asks.passes += 1;
                    promises.push(self.worker.pipeline.promise(&intrinsics, candidate));
                }
                if promises.len() < candidates.len() {
                    return Some(Ask::Ranking {
                        candidates,
                        intrinsics,
                        promises,
                        brought_since,
                        answer,
                    });
                }
                drop(answer.send(Ok(encode::next_view_reply(&candidates, &promises))));
            }
            Ask::Forget {
                mut forgetting,
                answer,
            } => {
                self.asks.passes += 1;
                match self.forget_step(&mut forgetting) {
                    Ok(true) => {}
                    Ok(false) => return Some(Ask::Forget { forgetting, answer }),
                    Err(refusal) => {
                        drop(answer.send(Err(refusal)));
                        return None;
                    }
                }
                let left = self.worker.pipeline.memory().known();
                let reply = encode::forget_reply(forgetting.forgotten(), left);
                tracing::info!(
                    place = &*self.worker.place,
                    removed = reply.viewpoints_removed,
                    changed = reply.viewpoints_changed,
                    left,
                    "forgotten as asked"
                );
                // Whoever was answered finds it in the status.
                self.publish_status();
                drop(answer.send(Ok(reply)));
            }
            Ask::Mode {
                camera,
                set,
                answer,
            } => {
                let set = set.map_or(Ok(()), |mode| self.set_mode(camera.as_ref(), mode));
                self.publish_status();
                drop(answer.send(set.map(|()| match &camera {
                    Some(camera) => self.mode(camera),
                    None => self.mode_of_place(),
                })));
            }
        }
        None
    }

    /// Whether all is forgotten now. What is only stored is gone through as well.
    ///
    /// # Errors
    /// Another service writes the place.
    fn forget_step(&mut self, forgetting: &mut Forgetting) -> Result<bool, Refusal> {
        let Worker {
            memory, pipeline, ..
        } = &mut self.worker;
        if let Some(memory) = memory {
            memory.may_learn()?;
            let held = pipeline.memory_mut();
            let stored = held.absent_to_forget(forgetting, FORGET_LOADED);
            if !stored.is_empty() {
                memory.fetch_step(held, stored);
            }
        }
        let done = pipeline.forget(forgetting, FORGET_STEP);
        self.sync_memory();
        Ok(done)
    }

    /// The poses to compare, and the camera they are imagined for.
    fn candidates(
        &self,
        question: NextView,
        camera: Option<Source>,
    ) -> Result<(Vec<Pose>, Intrinsics), Refusal> {
        let camera = match camera {
            Some(source) => Some(self.cameras.get(&source).ok_or_else(unknown_camera)?),
            None => None,
        };
        let (intrinsics, last_pose) = camera.map_or((None, None), Camera::last_seen);
        let missing = || {
            bad(
                "a ring needs a pose and intrinsics: fill `around` and `intrinsics`, or robot and camera of one that has sent frames",
            )
        };
        let imagined = |mut intrinsics: Intrinsics| {
            while intrinsics.pixels() > IMAGINED_PIXELS_MAX {
                intrinsics = intrinsics.half();
            }
            intrinsics
        };
        let intrinsics = question.intrinsics.or(intrinsics.map(imagined));
        let intrinsics = intrinsics.ok_or_else(missing)?;
        let candidates = match question.candidates {
            Candidates::Poses(poses) => poses,
            Candidates::Ring(ring) => {
                let around = ring.around.or(last_pose).ok_or_else(missing)?;
                next_view::ring(&around, ring.radius_m, ring.count)
            }
        };
        Ok((candidates, intrinsics))
    }

    fn evaluate(
        &mut self,
        frame: proto::Frame,
        camera: Option<Source>,
        is_brought: bool,
    ) -> Result<Evaluated, Refusal> {
        let started = Instant::now();
        let packed = decode::frame(frame)?;
        let known = camera.as_ref().and_then(|source| self.cameras.get(source));
        let lenses = match known {
            Some(known) => known.lenses(packed.calibration.as_ref(), self.limits)?,
            None => lenses_alone(&packed, self.limits)?,
        };
        let pose = pose_alone(&packed, &lenses)?;
        let source = camera.unwrap_or_else(|| Source {
            robot: "".into(),
            camera: "".into(),
        });
        let frame = unpack(
            &packed,
            &lenses,
            source,
            pose,
            self.noise_default,
            self.limits,
        )?;
        // The maps are of the evaluated frame from here on.
        self.maps_of = None;
        let Worker {
            memory, pipeline, ..
        } = &mut self.worker;
        if let Some(memory) = memory.as_ref().filter(|_| !is_brought) {
            memory.bring(pipeline.memory_mut(), &frame.world_from_camera);
        }
        let report = self.worker.pipeline.evaluate(&frame)?;
        Ok(Evaluated {
            report,
            processing_seconds: started.elapsed().as_secs_f64(),
            surprise: self.worker.pipeline.maps().score.surprise.clone(),
        })
    }

    fn publish_status(&mut self) {
        let slots = self.worker.inbox.cameras();
        let pipeline = &mut self.worker.pipeline;
        self.cameras.retain(|source, camera| {
            let kept = slots.contains_key(source);
            if !kept {
                pipeline.forget_camera(source);
                self.frames_lost_before += camera.status.frames_lost;
            }
            kept
        });
        for (source, (live, counters)) in &slots {
            if let Some(camera) = self.cameras.get_mut(source) {
                camera.status.live = *live;
                camera.status.slot = *counters;
            }
        }
        let cameras: Vec<_> = self
            .cameras
            .iter()
            .map(|(source, camera)| CameraStatus {
                mode: self.mode(source),
                ..camera.status.clone()
            })
            .collect();
        let pipeline = &self.worker.pipeline;
        let memory = pipeline.memory();
        let lost: u64 = cameras.iter().map(|camera| camera.frames_lost).sum();
        let engine = pipeline.engine();
        let totals = PlaceTotals {
            place: self.worker.place.to_string(),
            frames: self.frames,
            refused: self.refused_by.values().sum(),
            refused_by: self.refused_by.clone(),
            frames_lost: self.frames_lost_before + lost,
            inbox: self.worker.inbox.counters(),
            viewpoints: memory.viewpoints().len(),
            viewpoints_known: memory.known(),
            evicted: memory.evicted(),
            store: self.worker.memory.as_ref().map(PlaceStore::status),
            memory_bytes: memory.bytes(),
            memory_bytes_max: pipeline.settings().memory_bytes,
            replaced_for_room: memory.replaced_for_room(),
            mode: self.mode_of_place(),
            asks_answered: self.asks.answered,
            ask_passes: self.asks.passes,
            asks_abandoned: self.asks.abandoned,
            engine: engine.name().to_owned(),
            open_events: self.worker.events.borrow().open().len(),
            gpu: engine.counters().cloned(),
        };
        let status = PlaceStatus { totals, cameras };
        self.worker.status.send_replace(Arc::new(status));
    }
}

fn unknown_camera() -> Refusal {
    Refusal::new("unknown_camera", "no frame of this camera has come yet")
}

fn snapshot(
    pipeline: &Pipeline,
    frame: Arc<RgbImage>,
    report: Arc<proto::SurpriseReport>,
) -> Snapshot {
    let maps = pipeline.maps();
    Snapshot {
        report,
        frame,
        expected: picture::expected_rgb(&maps.prior),
        surprise: maps.score.surprise.clone(),
        uncertainty: picture::uncertainty(&maps.prior).collect(),
    }
}
