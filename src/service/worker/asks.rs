//! A step of an ask: what the memory expects, what somebody's frame comes to, where to look next, what to forget.

use std::time::Instant;

use super::{Desk, Worker, telling::snapshot};
use crate::{
    model::{camera::Intrinsics, frame::Source, pose::Pose, refusal::Refusal},
    service::{
        ask::{Ask, Evaluated},
        camera::{Camera, lenses_alone, pose_alone, unpack},
    },
    stages::next_view,
    wire::{
        decode::{
            self,
            questions::{Candidates, NextView, bad},
        },
        encode::{self, PriorPlanes},
        proto,
    },
};

/// A ring's camera is imagined no larger than this where nothing is said: ranks hardly depend on it.
const IMAGINED_PIXELS_MAX: usize = 320 * 240;

impl Desk {
    /// One step of an ask; what is left of it.
    pub(super) fn work_at(&mut self, ask: Ask) -> Option<Ask> {
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
}

fn unknown_camera() -> Refusal {
    Refusal::new("unknown_camera", "no frame of this camera has come yet")
}
