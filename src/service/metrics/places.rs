//! What the places publish about themselves, and what was counted at the door, as it is when somebody asks.

use std::{
    fmt,
    sync::{Arc, Weak, atomic::Ordering},
};

use prometheus_client::{
    collector::Collector,
    encoding::{DescriptorEncoder, EncodeMetric, MetricEncoder},
    metrics::{MetricType, counter::ConstCounter, gauge::ConstGauge},
    registry::Unit,
};

use crate::{
    memory::store::{ROLES, StoreStatus},
    service::{inbox::Depths, ingest::IngestCounters, places::Places, status::PlaceTotals},
};

/// Reads what the places publish when it is asked.
pub struct OfPlaces {
    pub places: Weak<Places>,
    pub counters: Arc<IngestCounters>,
}

impl fmt::Debug for OfPlaces {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("OfPlaces")
    }
}

/// A place at the time of asking.
struct Seen {
    totals: PlaceTotals,
    cameras: usize,
    live: usize,
    depths: Depths,
}

impl Collector for OfPlaces {
    fn encode(&self, mut encoder: DescriptorEncoder) -> fmt::Result {
        let Some(places) = self.places.upgrade() else {
            return Ok(());
        };
        let seen: Vec<Seen> = places
            .all()
            .into_iter()
            .map(|(_, place)| {
                let status = place.status.borrow();
                Seen {
                    totals: status.totals.clone(),
                    cameras: status.cameras.len(),
                    live: status.cameras.iter().filter(|camera| camera.live).count(),
                    depths: place.inbox.depths(),
                }
            })
            .collect();
        let mut out = Out {
            encoder: &mut encoder,
            seen: &seen,
        };
        out.counters("frames_received", "Frames that came", |place| {
            place.totals.inbox.frames_received
        })?;
        out.counters("received_bytes", "Bytes of the frames that came", |place| {
            place.totals.inbox.bytes_received
        })?;
        out.counters("frames_processed", "Frames with a report", |place| {
            place.totals.frames
        })?;
        out.counters(
            "frames_hurried",
            "Frames that were compared with fewer viewpoints because others waited",
            |place| place.totals.frames_hurried,
        )?;
        out.labelled(
            "frames_dropped",
            "Frames that a newer one replaced, or that never came",
            "reason",
            |place| {
                vec![
                    ("replaced", place.totals.inbox.frames_replaced),
                    ("lost", place.totals.frames_lost),
                ]
            },
        )?;
        out.labelled(
            "frames_rejected",
            "Frames and what comes beside them, refused",
            "reason",
            |place| {
                let by = place.totals.refused_by.iter();
                by.map(|(code, count)| (*code, *count)).collect()
            },
        )?;
        out.counters(
            "poses_dropped",
            "Poses and markers that were too many",
            |place| place.totals.inbox.poses_dropped,
        )?;
        out.gauges("cameras", "Cameras heard of", |place| place.cameras as i64)?;
        out.gauges("cameras_live", "Cameras that say they are there", |place| {
            place.live as i64
        })?;
        out.gauges("viewpoints", "Viewpoints held", |place| {
            place.totals.viewpoints as i64
        })?;
        out.gauges("memory_bytes", "Bytes of the viewpoints", |place| {
            place.totals.memory_bytes as i64
        })?;
        out.gauges("memory_max_bytes", "Their budget", |place| {
            place.totals.memory_bytes_max as i64
        })?;
        out.counters(
            "viewpoints_replaced_for_room",
            "Viewpoints forgotten because the memory was full",
            |place| place.totals.replaced_for_room,
        )?;
        out.gauges(
            "viewpoints_known",
            "Viewpoints in RAM or only stored",
            |place| place.totals.viewpoints_known as i64,
        )?;
        out.counters(
            "viewpoints_evicted",
            "Stored viewpoints that left RAM because others were needed there",
            |place| place.totals.evicted,
        )?;
        out.stores()?;
        out.counters(
            "ask_passes",
            "Passes of the engine that questions have taken",
            |place| place.totals.ask_passes,
        )?;
        out.gauges("events_open", "Events that last", |place| {
            place.totals.open_events as i64
        })?;
        out.queues()?;
        out.engines()?;
        out.metric(
            "places_closed",
            "Places that made room for others",
            MetricType::Counter,
            |encoder, _| {
                ConstCounter::new(places.closed()).encode(encoder.encode_family(&[("", ""); 0])?)
            },
        )?;
        out.service(&self.counters)
    }
}

struct Out<'a, 'b> {
    encoder: &'a mut DescriptorEncoder<'b>,
    seen: &'a [Seen],
}

impl Out<'_, '_> {
    fn metric(
        &mut self,
        name: &str,
        help: &str,
        kind: MetricType,
        write: impl FnOnce(&mut MetricEncoder, &[Seen]) -> fmt::Result,
    ) -> fmt::Result {
        let mut encoder = self.encoder.encode_descriptor(name, help, None, kind)?;
        write(&mut encoder, self.seen)
    }

    fn counters(&mut self, name: &str, help: &str, of: impl Fn(&Seen) -> u64) -> fmt::Result {
        self.metric(name, help, MetricType::Counter, |encoder, seen| {
            for place in seen {
                let labels = [("place", place.totals.place.as_str())];
                ConstCounter::new(of(place)).encode(encoder.encode_family(&labels)?)?;
            }
            Ok(())
        })
    }

    fn gauges(&mut self, name: &str, help: &str, of: impl Fn(&Seen) -> i64) -> fmt::Result {
        self.metric(name, help, MetricType::Gauge, |encoder, seen| {
            for place in seen {
                let labels = [("place", place.totals.place.as_str())];
                ConstGauge::new(of(place)).encode(encoder.encode_family(&labels)?)?;
            }
            Ok(())
        })
    }

    fn labelled(
        &mut self,
        name: &str,
        help: &str,
        label: &'static str,
        of: impl Fn(&Seen) -> Vec<(&'static str, u64)>,
    ) -> fmt::Result {
        self.metric(name, help, MetricType::Counter, |encoder, seen| {
            for place in seen {
                for (value, count) in of(place) {
                    let labels = [("place", place.totals.place.as_str()), (label, value)];
                    ConstCounter::new(count).encode(encoder.encode_family(&labels)?)?;
                }
            }
            Ok(())
        })
    }

    /// Of the places whose memory lasts.
    fn stores(&mut self) -> fmt::Result {
        let stores = || {
            self.seen.iter().filter_map(|place| {
                let store = place.totals.store.as_ref()?;
                Some((place.totals.place.as_str(), store))
            })
        };
        let help = "Who may write the stored place: 1 for what this service is to it";
        let mut encoder =
            self.encoder
                .encode_descriptor("store_role", help, None, MetricType::Gauge)?;
        for (place, store) in stores() {
            for role in ROLES {
                let labels = [("place", place), ("role", role)];
                let is = i64::from(store.role == role);
                ConstGauge::new(is).encode(encoder.encode_family(&labels)?)?;
            }
        }
        type Of<N> = fn(&StoreStatus) -> N;
        let counts: [(&str, &str, Of<u64>); 12] = [
            (
                "memory_hits",
                "Frames and questions that found all they needed in RAM; with memory_misses this is the hit rate",
                |store| store.hits,
            ),
            (
                "memory_misses",
                "Frames and questions that had to wait for the store",
                |store| store.misses,
            ),
            (
                "memory_misses_incomplete",
                "Of these, those that went on without because the store did not answer in time",
                |store| store.incomplete,
            ),
            ("store_loaded", "Viewpoints read from the store", |store| {
                store.loaded
            }),
            (
                "store_read_failures",
                "Reads that the store did not answer",
                |store| store.read_failures,
            ),
            (
                "store_not_prefetched",
                "Viewpoints expected to be needed that were too many to read",
                |store| store.not_prefetched,
            ),
            (
                "store_written",
                "Viewpoints written to the store",
                |store| store.written,
            ),
            ("store_written_bytes", "Bytes of these", |store| {
                store.written_bytes
            }),
            (
                "store_late",
                "Of these, those written later than write_behind_s after the change",
                |store| store.late,
            ),
            (
                "store_write_failures",
                "Batches of writes that failed at first",
                |store| store.write_failures,
            ),
            (
                "store_removed",
                "Viewpoints deleted from the store because they were forgotten",
                |store| store.removed,
            ),
            (
                "store_lost",
                "Changes lost because another service took the place",
                |store| store.lost,
            ),
        ];
        for (name, help, of) in counts {
            let mut encoder =
                self.encoder
                    .encode_descriptor(name, help, None, MetricType::Counter)?;
            for (place, store) in stores() {
                let labels = [("place", place)];
                ConstCounter::new(of(store)).encode(encoder.encode_family(&labels)?)?;
            }
        }
        let mut encoder = self.encoder.encode_descriptor(
            "memory_miss",
            "What these waited in all",
            Some(&Unit::Seconds),
            MetricType::Counter,
        )?;
        for (place, store) in stores() {
            let labels = [("place", place)];
            ConstCounter::new(store.miss_seconds).encode(encoder.encode_family(&labels)?)?;
        }
        let gauges: [(&str, &str, Of<f64>); 8] = [
            (
                "store_recovered",
                "Viewpoints found when the place was read or taken over",
                |store| store.recovered as f64,
            ),
            (
                "store_damaged",
                "Objects that could not be read and are kept aside",
                |store| store.damaged as f64,
            ),
            (
                "store_trouble",
                "1 while the store cannot be used",
                |store| f64::from(u8::from(store.trouble.is_some())),
            ),
            ("store_viewpoints", "Viewpoints stored", |store| {
                store.stored_viewpoints as f64
            }),
            ("store_bytes", "Bytes of these", |store| {
                store.stored_bytes as f64
            }),
            (
                "store_pending",
                "Changes that are not stored yet",
                |store| store.pending as f64,
            ),
            (
                "store_pending_age_seconds",
                "Age of the oldest of these",
                |store| store.pending_s,
            ),
            (
                "store_left_unread",
                "Whole objects left as they are: of a later version, or too large for these settings",
                |store| store.left_unread as f64,
            ),
        ];
        for (name, help, of) in gauges {
            let mut encoder =
                self.encoder
                    .encode_descriptor(name, help, None, MetricType::Gauge)?;
            for (place, store) in stores() {
                let labels = [("place", place)];
                ConstGauge::new(of(store)).encode(encoder.encode_family(&labels)?)?;
            }
        }
        Ok(())
    }

    fn queues(&mut self) -> fmt::Result {
        let help = "What waits for a place's worker";
        self.metric("queue_depth", help, MetricType::Gauge, |encoder, seen| {
            for place in seen {
                let Depths {
                    frames,
                    poses,
                    asks,
                } = place.depths;
                for (queue, depth) in [("frames", frames), ("poses", poses), ("asks", asks)] {
                    let labels = [("place", place.totals.place.as_str()), ("queue", queue)];
                    ConstGauge::new(depth as i64).encode(encoder.encode_family(&labels)?)?;
                }
            }
            Ok(())
        })
    }

    /// What computes, and what a graphics card's engine has moved.
    fn engines(&mut self) -> fmt::Result {
        let help = "What computes: 1 for the one in use";
        self.metric("engine", help, MetricType::Gauge, |encoder, seen| {
            for place in seen.iter().filter(|place| !place.totals.engine.is_empty()) {
                let labels = [
                    ("place", place.totals.place.as_str()),
                    ("engine", place.totals.engine.as_str()),
                ];
                ConstGauge::new(1i64).encode(encoder.encode_family(&labels)?)?;
            }
            Ok(())
        })?;
        if self.seen.iter().all(|place| place.totals.gpu.is_none()) {
            return Ok(());
        }
        let gpu = |place: &Seen| place.totals.gpu.clone().unwrap_or_default();
        self.counters("gpu_frames", "Frames computed on the card", |place| {
            gpu(place).frames
        })?;
        self.counters(
            "gpu_on_processor",
            "Frames and recalls that the processor did because the card could not",
            |place| gpu(place).on_processor,
        )?;
        self.counters("gpu_uploaded_bytes", "Bytes moved to the card", |place| {
            gpu(place).uploaded_bytes
        })?;
        self.counters(
            "gpu_read_backs",
            "Times that a frame waited for the card",
            |place| gpu(place).read_backs,
        )?;
        self.counters("gpu_read_back_bytes", "Bytes moved back", |place| {
            gpu(place).read_back_bytes
        })?;
        self.counters(
            "gpu_residency_misses",
            "Viewpoints that were wanted and not on the card",
            |place| gpu(place).views_brought,
        )?;
        self.counters(
            "gpu_residency_evictions",
            "Viewpoints that made room on the card",
            |place| gpu(place).evicted,
        )?;
        self.gauges(
            "gpu_resident_bytes",
            "Bytes of viewpoints on the card",
            |place| gpu(place).resident_bytes as i64,
        )?;
        self.counters("gpu_losses", "Cards lost and replaced", |place| {
            gpu(place).losses
        })?;
        let help = "Time of the last frame's passes, where the card can tell";
        self.metric(
            "gpu_pass_seconds",
            help,
            MetricType::Gauge,
            |encoder, seen| {
                for place in seen {
                    for (pass, seconds) in gpu(place).pass_seconds {
                        let labels = [("place", place.totals.place.as_str()), ("pass", pass)];
                        ConstGauge::new(seconds).encode(encoder.encode_family(&labels)?)?;
                    }
                }
                Ok(())
            },
        )
    }

    fn service(&mut self, counters: &IngestCounters) -> fmt::Result {
        let counts = [
            (
                "bad_keys",
                "Samples on keys that name no camera",
                &counters.bad_keys,
            ),
            (
                "refused_at_the_door",
                "Samples refused because there are too many places or cameras",
                &counters.refused,
            ),
            (
                "questions_busy",
                "Questions refused because too many bytes of them were under way",
                &counters.questions_busy,
            ),
            (
                "questions_late",
                "Questions that had no answer in time",
                &counters.questions_late,
            ),
            (
                "queries_dropped",
                "Queries that found their queue full",
                &counters.queries_dropped,
            ),
        ];
        for (name, help, count) in counts {
            self.metric(name, help, MetricType::Counter, |encoder, _| {
                let count = count.load(Ordering::Relaxed);
                ConstCounter::new(count).encode(encoder.encode_family(&[("", ""); 0])?)
            })?;
        }
        Ok(())
    }
}
