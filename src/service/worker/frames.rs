//! A camera's frames and what comes beside them: from a message to a report, or to why there is none.

use std::time::Instant;

use super::{Desk, Worker, telling::snapshot, writer::Writer};
use crate::{
    memory::store::PlaceStore,
    model::{
        frame::Source,
        mode::Mode,
        pose::Pose,
        refusal::{PLACE_HELD, Refusal},
    },
    pipeline::Effort,
    service::{
        camera::{Camera, Refused, Turn, Waiting, unpack},
        inbox::Aside,
        publish::CameraPublisher,
        turns,
    },
    wire::{
        decode, encode,
        keys::{self, CameraPath},
        proto,
    },
};

/// Two robots whose frames come at once are no sign that there is too much to do.
const OTHERS_WAIT: usize = 2;

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
                    let mut camera = Camera::new(path, publisher);
                    if let Some(known) = self.calibrations.get(source) {
                        camera.remember_calibration(known, self.limits);
                    }
                    self.cameras.insert(source.clone(), camera);
                }
                Err(error) => {
                    tracing::warn!("no publishers for {}: {error}", path.key(root, ""));
                    return None;
                }
            }
        }
        self.cameras.get_mut(source)
    }

    pub(super) fn aside(&mut self, source: &Source, aside: Aside) {
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
            Aside::CalibrationAsked => return camera.calibration_asked(),
            Aside::Mode(_) => (keys::MODE, set),
            Aside::Refused(leaf, refusal) => (leaf, Err(refusal)),
        };
        if leaf == keys::CALIBRATION && result.is_ok() {
            self.keep_calibration(source);
        }
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

    pub(super) fn receive_frame(&mut self, source: &Source) {
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
    pub(super) fn fit_markers(&mut self) {
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
    pub(super) fn serve_longest_waiting(&mut self, but: &[Source]) -> turns::Turn {
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
                Some(Turn::Ready(pose, frame)) => {
                    self.frames += 1;
                    camera.served = self.frames;
                    let Waiting { frame: packed, .. } = &frame;
                    let (stamp_ns, sequence) = (packed.stamp_ns, packed.sequence);
                    if let Err(refusal) = self.serve_frame(&source, pose, &frame) {
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

    /// Less where others wait, or where the frame took the place of one nobody had time for: so that no more are left
    /// out. A frozen camera is never hurried: its frames are judged the same however often they come.
    fn effort(&self, mode: Mode, replaced: u64) -> Effort {
        let settings = self.worker.pipeline.settings();
        let may_hurry = mode != Mode::Freeze && settings.views_busy < settings.views;
        let waiting = |camera: &&Camera| camera.waiting.is_some();
        let others = self.cameras.values().filter(waiting).count();
        if may_hurry && (replaced > 0 || others >= OTHERS_WAIT) {
            Effort::Hurried
        } else {
            Effort::Whole
        }
    }

    fn serve_frame(
        &mut self,
        source: &Source,
        pose: Pose,
        Waiting {
            frame: packed,
            arrived,
            replaced,
        }: &Waiting,
    ) -> Result<(), Refusal> {
        self.may_recall()?;
        // Asked before the modes: whoever has become the place's writer has read what the last one was told.
        let may_learn = self.worker.memory.as_ref().map(PlaceStore::may_learn);
        self.sync_modes();
        let mode = self.mode(source);
        if matches!(may_learn, Some(Ok(()))) {
            self.writer = None;
        }
        if mode == Mode::Learn {
            may_learn.unwrap_or(Ok(()))?;
        }
        let effort = self.effort(mode, *replaced);
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
        let report =
            pipeline.process_staged(mode, effort, &frame, &mut |stage| stopwatch.ended(stage))?;
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
        stopwatch.published(*arrived);
        self.frames_hurried += u64::from(effort == Effort::Hurried);
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
        self.keep_calibration(source);
        self.tell(&report);
        Ok(())
    }

    /// Whether the service that writes the place reports on this camera in this network: then the sender hears from it, and a refusal
    /// beside each report would only confuse.
    fn writer_answers(&mut self, source: &Source) -> bool {
        if self.writer.is_none() {
            let Worker {
                session,
                root,
                place,
                ..
            } = &self.worker;
            self.writer = Writer::listen(session, root, place).ok();
        }
        self.writer
            .as_ref()
            .is_some_and(|writer| writer.reports_on(source))
    }

    fn refuse(&mut self, source: &Source, leaf: &'static str, refused: Refused) {
        let root = self.worker.root.clone();
        let is_told = leaf == keys::FRAME
            && refused.refusal.code == PLACE_HELD
            && self.writer_answers(source);
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
        if !is_told {
            camera.publisher.refused(&key, &refusal, stamp_ns, sequence);
        }
        camera.status.last_refusal = Some(format!("{}: {refusal}", refusal.code));
    }
}
