//! What others may know of the place: its status, its events, news for who watches, a camera's last frame as pictures.

use std::sync::Arc;

use super::{Desk, Worker};
use crate::{
    memory::store::PlaceStore,
    model::{frame::RgbImage, report::Report},
    pipeline::Pipeline,
    service::{
        ask::Snapshot,
        events,
        live::News,
        status::{CameraStatus, PlaceStatus, PlaceTotals},
    },
    wire::{encode, picture, proto},
};

impl Desk {
    /// Publishes what has changed about events, and tells the watchers of the frame.
    pub(super) fn tell(&self, report: &Report) {
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
    pub(super) fn publish_status(&mut self) {
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
            frames_hurried: self.frames_hurried,
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

pub(super) fn snapshot(
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
