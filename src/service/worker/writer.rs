//! Hears which cameras another service, one that writes the place, reports on in this network.

use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex, PoisonError},
    time::{Duration, Instant},
};

use zenoh::{Session, Wait, pubsub::Subscriber, sample::Locality};

use crate::{
    model::frame::Source,
    service::inbox::CAMERAS_MAX,
    wire::keys::{self, CameraPath},
};

/// Robots send several frames a second, so a writer that has said nothing for so long has gone, or nobody it hears sends.
const SILENCE: Duration = Duration::from_secs(2);

pub(super) struct Writer {
    /// When; of as many cameras as a place has room for.
    reported: Arc<Mutex<BTreeMap<Source, Instant>>>,
    _subscriber: Subscriber<()>,
}

impl Writer {
    /// # Errors
    /// The session is closed.
    pub(super) fn listen(session: &Session, root: &str, place: &str) -> zenoh::Result<Self> {
        let reported = Arc::new(Mutex::new(BTreeMap::new()));
        let (heard, root_heard) = (reported.clone(), root.to_owned());
        let subscriber = session
            .declare_subscriber(keys::every_report(root, place))
            .allowed_origin(Locality::Remote)
            .callback(move |sample| {
                // A camera's keys have one chunk below it, a report's two.
                let camera = sample.key_expr().as_str().strip_suffix(keys::REPORT);
                let path = camera.and_then(|camera| CameraPath::parse(&root_heard, camera));
                let Some(path) = path else {
                    return;
                };
                let mut heard = heard.lock().unwrap_or_else(PoisonError::into_inner);
                if heard.len() < CAMERAS_MAX || heard.contains_key(&path.source) {
                    heard.insert(path.source, Instant::now());
                }
            })
            .wait()?;
        Ok(Self {
            reported,
            _subscriber: subscriber,
        })
    }

    /// Whether it has reported on this camera lately.
    pub(super) fn reports_on(&self, source: &Source) -> bool {
        let reported = self.reported.lock().unwrap_or_else(PoisonError::into_inner);
        reported
            .get(source)
            .is_some_and(|at| at.elapsed() < SILENCE)
    }
}
