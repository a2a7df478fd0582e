//! What goes out for one camera: a report for every frame, blocking and urgent; maps only while someone subscribes,
//! dropped when the way is congested; and why frames were refused.

use zenoh::{
    Session, Wait,
    pubsub::Publisher,
    qos::{CongestionControl, Priority},
};

use crate::{
    model::{refusal::Refusal, report::Report},
    pipeline::Maps,
    wire::{
        encode,
        keys::{self, CameraPath},
        proto::{Image, Rejection, StampedImage, SurpriseReport},
    },
};

type Encode = fn(&Maps) -> Image;

/// Leaf below the camera's `surprise`, and what it shows.
const MAPS: [(&str, Encode); 5] = [
    ("surprise/map", encode::surprise),
    ("surprise/blocks", encode::blocks),
    ("surprise/expected", |maps| encode::expected(&maps.prior)),
    ("surprise/uncertainty", |maps| {
        encode::uncertainty(&maps.prior)
    }),
    ("surprise/coverage", |maps| encode::coverage(&maps.prior)),
];

#[derive(Debug)]
pub struct CameraPublisher {
    reports: Publisher<'static>,
    rejections: Publisher<'static>,
    maps: Vec<(Publisher<'static>, Encode)>,
}

impl CameraPublisher {
    /// # Errors
    /// The session is closed.
    pub fn new(session: &Session, root: &str, camera: &CameraPath) -> zenoh::Result<Self> {
        let reports = session
            .declare_publisher(camera.key(root, keys::REPORT))
            .encoding(keys::encoding::<SurpriseReport>())
            .congestion_control(CongestionControl::Block)
            .priority(Priority::InteractiveHigh)
            .express(true)
            .wait()?;
        let rejections = session
            .declare_publisher(camera.key(root, keys::REJECTED))
            .encoding(keys::encoding::<Rejection>())
            .congestion_control(CongestionControl::Drop)
            .wait()?;
        let maps = MAPS
            .into_iter()
            .map(|(leaf, encode)| {
                session
                    .declare_publisher(camera.key(root, leaf))
                    .encoding(keys::encoding::<StampedImage>())
                    .congestion_control(CongestionControl::Drop)
                    .priority(Priority::Background)
                    .wait()
                    .map(|publisher| (publisher, encode))
            })
            .collect::<zenoh::Result<_>>()?;
        Ok(Self {
            reports,
            rejections,
            maps,
        })
    }

    pub fn report(&self, report: &SurpriseReport) {
        sent(self.reports.put(encode::bytes(report)).wait());
    }

    /// `maps` is asked only if somebody wants one.
    pub fn maps<'a>(&self, report: &Report, maps: impl Fn() -> &'a Maps) {
        for (publisher, encode) in &self.maps {
            if !publisher
                .matching_status()
                .wait()
                .is_ok_and(|status| status.matching())
            {
                continue;
            }
            let image = StampedImage {
                stamp: Some(encode::timestamp(report.stamp_ns)),
                sequence: report.sequence,
                image: Some(encode(maps())),
            };
            sent(publisher.put(encode::bytes(&image)).wait());
        }
    }

    /// `key`: that brought what was refused.
    pub fn refused(&self, key: &str, refusal: &Refusal, stamp_ns: i64, sequence: u64) {
        let rejection = encode::rejection(key, refusal, stamp_ns, sequence);
        sent(self.rejections.put(encode::bytes(&rejection)).wait());
    }
}

/// Only a session that is closing refuses; the service notices that elsewhere.
fn sent(result: zenoh::Result<()>) {
    if let Err(error) = result {
        tracing::debug!("not published: {error}");
    }
}
