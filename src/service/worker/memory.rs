//! What lasts of the place: its stored viewpoints and events, and how its cameras' frames are taken.

use std::{sync::Arc, time::Instant};

use super::{Desk, Worker};
use crate::{
    memory::{forget::Forgetting, store::PlaceStore},
    model::{
        frame::Source,
        mode::{Mode, Modes},
        pose::Pose,
        refusal::Refusal,
    },
    service::{camera::Camera, inbox::CAMERAS_MAX},
    wire::{decode, encode},
};

/// Cameras whose modes are kept while the cameras themselves have made room for others.
const MODES_MAX: usize = 1024;
/// Cameras whose calibrations are kept, likewise.
const CALIBRATIONS_MAX: usize = 1024;
/// Viewpoints that a step of forgetting goes through: about the time of a frame, and more than all cameras can write
/// between two steps, so that it comes to an end.
const FORGET_STEP: usize = 2 * CAMERAS_MAX;
/// Stored viewpoints that such a step brings into RAM.
const FORGET_LOADED: usize = 16;

impl Desk {
    /// How the frames of a camera are taken.
    pub(super) fn mode(&self, source: &Source) -> Mode {
        let said = self.modes.of(source);
        said.unwrap_or_else(|| self.worker.pipeline.settings().mode(&source.robot))
    }

    /// How the cameras of the place begin.
    pub(super) fn mode_of_place(&self) -> Mode {
        let settings = self.worker.pipeline.settings();
        self.modes.place.unwrap_or(settings.mode)
    }

    /// Of a camera, or of all of them: what was said for single ones before is forgotten then.
    ///
    /// # Errors
    /// Another service writes the place and would go on as before; too many cameras.
    pub(super) fn set_mode(&mut self, source: Option<&Source>, mode: Mode) -> Result<(), Refusal> {
        if let Some(memory) = &self.worker.memory {
            memory.may_say()?;
        }
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
    /// # Errors
    /// `memory_unread`.
    pub(super) fn may_recall(&self) -> Result<(), Refusal> {
        let memory = self.worker.memory.as_ref();
        memory.map_or(Ok(()), PlaceStore::may_recall)
    }

    /// Learns what is stored of the modes.
    pub(super) fn sync_modes(&mut self) {
        let memory = self.worker.memory.as_ref();
        if let Some(modes) = memory.and_then(PlaceStore::take_modes) {
            self.modes = modes;
        }
    }

    /// Learns what is new about the stored memory.
    pub(super) fn sync_memory(&mut self) {
        self.sync_modes();
        let Worker {
            memory, pipeline, ..
        } = &mut self.worker;
        if let Some(memory) = memory {
            memory.sync(pipeline.memory_mut());
        }
        self.sync_events();
        self.sync_calibrations();
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
                Ok((mut message, event)) => {
                    // It may have been another's that was imported under this name.
                    message.place = place.to_string();
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

    /// Keeps what is known now of a camera's calibration, for when it comes back and for after a restart.
    pub(super) fn keep_calibration(&mut self, source: &Source) {
        let camera = self.cameras.get(source);
        let Some(calibration) = camera.and_then(Camera::calibration) else {
            return;
        };
        let kept = self.calibrations.get(source);
        if kept == Some(calibration) {
            return;
        }
        if kept.is_none() && self.calibrations.len() >= CALIBRATIONS_MAX {
            tracing::debug!(
                place = &*self.worker.place,
                "the calibration of {}/{} is not kept: those of {CALIBRATIONS_MAX} cameras are",
                source.robot,
                source.camera
            );
            return;
        }
        if let Some(memory) = &self.worker.memory {
            let content = encode::camera_calibration(source, calibration);
            memory.keep_calibration(source, encode::bytes(&content));
        }
        self.calibrations
            .insert(source.clone(), calibration.clone());
    }

    /// Goes on with stored calibrations, as after a restart. What came from the cameras since is newer.
    fn sync_calibrations(&mut self) {
        let memory = self.worker.memory.as_ref();
        for content in memory.map_or_else(Vec::new, PlaceStore::take_calibrations) {
            let (source, calibration) = match decode::camera_calibration(&content) {
                Ok(stored) => stored,
                Err(refusal) => {
                    tracing::warn!(
                        place = &*self.worker.place,
                        "a stored calibration is not used: {refusal}"
                    );
                    continue;
                }
            };
            if let Some(camera) = self.cameras.get_mut(&source) {
                camera.remember_calibration(&calibration, self.limits);
            }
            self.calibrations.entry(source).or_insert(calibration);
        }
    }

    /// Whether what is stored around a pose is in RAM, or will not be in time; else the question has to wait for its
    /// next turn.
    pub(super) fn bring(&mut self, world_from_camera: &Pose, since: &mut Option<Instant>) -> bool {
        let Worker {
            memory, pipeline, ..
        } = &mut self.worker;
        memory
            .as_ref()
            .is_none_or(|memory| memory.bring_step(pipeline.memory_mut(), world_from_camera, since))
    }

    /// Whether all is forgotten now. What is only stored is gone through as well.
    ///
    /// # Errors
    /// Another service writes the place.
    pub(super) fn forget_step(&mut self, forgetting: &mut Forgetting) -> Result<bool, Refusal> {
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
}
