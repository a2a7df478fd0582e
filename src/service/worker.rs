//! The thread that owns a place: its pipeline, its memory, and what is known about its cameras. It takes one frame at a
//! time, of the camera that waited longest for its turn, and answers asks in between.

use std::{
    collections::BTreeMap,
    sync::Arc,
    time::{Duration, Instant},
};

use tokio::sync::watch;

use super::{
    ask::{Ask, Snapshot},
    camera::{Camera, Refused, Turn, lenses_alone, pose_alone, unpack},
    inbox::{Aside, Inbox},
    publish::CameraPublisher,
    status::PlaceStatus,
};
use crate::{
    memory::store::PlaceStore,
    model::{
        frame::{RgbImage, Source},
        pose::{Pose, PoseNoise},
        refusal::Refusal,
    },
    pipeline::Pipeline,
    wire::{
        decode::{self, Limits, PackedFrame},
        encode,
        keys::{self, CameraPath},
        picture, proto,
    },
};

/// How long a closing worker goes on with frames that have already come.
const FINISH_WITHIN: Duration = Duration::from_secs(2);

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
    asks_answered: u64,
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
            asks_answered: 0,
            worker: self,
        };
        if let Some(memory) = &desk.worker.memory {
            // Most stores answer at once; frames of the others are refused with the reason.
            memory.wait_read(READ_WITHIN);
        }
        desk.sync_memory();
        desk.publish_status();
        let mut wake = None;
        let mut finish_by = None;
        loop {
            let inbox = desk.worker.inbox.clone();
            let delivery = inbox.wait(wake, |source| {
                desk.cameras
                    .get(source)
                    .is_some_and(|camera| camera.waiting.is_some())
            });
            if delivery.closed && finish_by.is_none() {
                finish_by = Some(Instant::now() + FINISH_WITHIN);
            }
            for (source, aside) in delivery.asides {
                desk.aside(&source, aside);
            }
            for ask in delivery.asks {
                desk.answer(ask);
            }
            for source in delivery.frames {
                desk.receive(&source);
            }
            desk.sync_memory();
            desk.fit_markers();
            let next = desk.turn();
            wake = next.wake;
            desk.publish_status();
            if let Some(finish_by) = finish_by
                && (!next.served || Instant::now() >= finish_by)
            {
                let Worker {
                    memory, pipeline, ..
                } = &mut desk.worker;
                if let Some(memory) = memory {
                    memory.close(pipeline.memory_mut(), STORE_WITHIN);
                }
                return;
            }
        }
    }
}

/// What a turn came to.
struct Next {
    served: bool,
    /// When the loop must look again even if nothing comes.
    wake: Option<Instant>,
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

    fn receive(&mut self, source: &Source) {
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

    /// Serves the ready frame of the camera that was served longest ago.
    fn turn(&mut self) -> Next {
        let now = Instant::now();
        let mut wake: Option<Instant> = None;
        let mut order: Vec<Source> = self
            .cameras
            .values()
            .filter(|camera| camera.waiting.is_some())
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
                Some(Turn::Ready(pose, packed)) => {
                    self.frames += 1;
                    camera.served = self.frames;
                    let (stamp_ns, sequence) = (packed.stamp_ns, packed.sequence);
                    if let Err(refusal) = self.serve(&source, pose, &packed) {
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
                    return Next {
                        served: true,
                        // Others may be ready now.
                        wake: Some(now),
                    };
                }
            }
        }
        Next {
            served: false,
            wake,
        }
    }

    fn serve(&mut self, source: &Source, pose: Pose, packed: &PackedFrame) -> Result<(), Refusal> {
        let started = Instant::now();
        let (limits, noise) = (self.limits, self.noise_default);
        let Some(camera) = self.cameras.get_mut(source) else {
            return Ok(());
        };
        let lenses = camera.lenses(packed.calibration.as_ref(), limits)?;
        let frame = unpack(packed, &lenses, source.clone(), pose, noise, limits)?;
        let Worker {
            place,
            pipeline,
            memory,
            ..
        } = &mut self.worker;
        if let Some(memory) = memory {
            memory.may_learn()?;
            memory.bring(pipeline.memory_mut(), &pose);
        }
        let report = pipeline.process(&frame)?;
        if let Some(memory) = memory {
            let held = pipeline.memory_mut();
            memory.sync(held);
            memory.prefetch(held, source, (frame.stamp_ns, report.world_from_camera));
        }
        let processing_seconds = started.elapsed().as_secs_f64();
        self.maps_of = Some(source.clone());
        let message = encode::report(&report, place, processing_seconds);
        camera.publisher.report(&message);
        camera.publisher.maps(&report, || pipeline.maps());
        camera.processed(frame.image, lenses, message, frame.stamp_ns);
        if camera.watched(Instant::now()) {
            camera.show(|image| snapshot(pipeline, image));
        }
        Ok(())
    }

    /// Learns what is new about the stored memory.
    fn sync_memory(&mut self) {
        let Worker {
            memory, pipeline, ..
        } = &mut self.worker;
        if let Some(memory) = memory {
            memory.sync(pipeline.memory_mut());
        }
    }

    /// Has in RAM what is stored around a pose.
    fn bring(&mut self, world_from_camera: &Pose) {
        let Worker {
            memory, pipeline, ..
        } = &mut self.worker;
        if let Some(memory) = memory {
            memory.bring(pipeline.memory_mut(), world_from_camera);
        }
    }

    fn refuse(&mut self, source: &Source, leaf: &'static str, refused: Refused) {
        let root = self.worker.root.clone();
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

    fn answer(&mut self, ask: Ask) {
        self.asks_answered += 1;
        // Whoever asked may have gone: sending fails then, and there is nothing to do about it.
        match ask {
            Ask::Prior {
                world_from_camera,
                intrinsics,
                planes,
                answer,
            } => {
                if !answer.is_closed() {
                    self.bring(&world_from_camera);
                    let prior = self.worker.pipeline.prior(&intrinsics, &world_from_camera);
                    drop(answer.send(Ok(encode::prior_reply(&prior, &planes))));
                }
            }
            Ask::Evaluate {
                frame,
                camera,
                answer,
            } => {
                if !answer.is_closed() {
                    drop(answer.send(self.evaluate(*frame, camera)));
                }
            }
            Ask::Views { answer } => {
                let views = self.worker.pipeline.memory().heads();
                drop(answer.send(Ok(proto::ViewsReply {
                    views: views.iter().map(encode::view).collect(),
                })));
            }
            Ask::Snapshot { camera, answer } => {
                let current = self.maps_of.as_ref() == Some(&camera);
                let pipeline = &self.worker.pipeline;
                match self.cameras.get_mut(&camera) {
                    Some(known) => known.look(
                        answer,
                        Instant::now(),
                        current.then_some(|image| snapshot(pipeline, image)),
                    ),
                    None => drop(answer.send(Err(Refusal::new(
                        "unknown_camera",
                        "no frame of this camera has come yet",
                    )))),
                }
            }
        }
    }

    fn evaluate(
        &mut self,
        frame: proto::Frame,
        camera: Option<Source>,
    ) -> Result<proto::EvaluateReply, Refusal> {
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
        self.bring(&frame.world_from_camera);
        let report = self.worker.pipeline.evaluate(&frame)?;
        let seconds = started.elapsed().as_secs_f64();
        Ok(proto::EvaluateReply {
            report: Some(encode::report(&report, &self.worker.place, seconds)),
            map: Some(encode::surprise(self.worker.pipeline.maps())),
        })
    }

    fn publish_status(&mut self) {
        let slots = self.worker.inbox.cameras();
        let pipeline = &mut self.worker.pipeline;
        self.cameras.retain(|source, _| {
            let kept = slots.contains_key(source);
            if !kept {
                pipeline.forget(source);
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
            .values()
            .map(|camera| camera.status.clone())
            .collect();
        let memory = pipeline.memory();
        self.worker.status.send_replace(Arc::new(PlaceStatus {
            place: self.worker.place.to_string(),
            frames: self.frames,
            refused: cameras.iter().map(|camera| camera.refusals()).sum(),
            viewpoints: memory.viewpoints().len(),
            viewpoints_known: memory.known(),
            evicted: memory.evicted(),
            store: self.worker.memory.as_ref().map(PlaceStore::status),
            memory_bytes: memory.bytes(),
            memory_bytes_max: pipeline.settings().memory_bytes,
            replaced_for_room: memory.replaced_for_room(),
            asks_answered: self.asks_answered,
            asks_busy: self.worker.inbox.asks_busy(),
            cameras,
        }));
    }
}

fn snapshot(pipeline: &Pipeline, frame: Arc<RgbImage>) -> Snapshot {
    let maps = pipeline.maps();
    Snapshot {
        frame,
        expected: picture::expected_rgb(&maps.prior),
        surprise: maps.score.surprise.clone(),
        uncertainty: picture::uncertainty(&maps.prior).collect(),
    }
}
