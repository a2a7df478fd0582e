//! Hears whether another service that writes the place reports on this network.

use std::{
    sync::{Arc, Mutex, PoisonError},
    time::{Duration, Instant},
};

use zenoh::{Session, Wait, pubsub::Subscriber, sample::Locality};

use crate::wire::keys;

/// Robots send several frames a second, so a writer that has said nothing for so long has gone, or nobody it hears sends.
const SILENCE: Duration = Duration::from_secs(2);

pub(super) struct Writer {
    reported: Arc<Mutex<Option<Instant>>>,
    _subscriber: Subscriber<()>,
}

impl Writer {
    /// # Errors
    /// The session is closed.
    pub(super) fn listen(session: &Session, root: &str, place: &str) -> zenoh::Result<Self> {
        let reported = Arc::new(Mutex::new(None));
        let heard = reported.clone();
        let subscriber = session
            .declare_subscriber(keys::every_report(root, place))
            .allowed_origin(Locality::Remote)
            .callback(move |_| {
                *heard.lock().unwrap_or_else(PoisonError::into_inner) = Some(Instant::now());
            })
            .wait()?;
        Ok(Self {
            reported,
            _subscriber: subscriber,
        })
    }

    /// Whether it has reported lately.
    pub(super) fn is_heard(&self) -> bool {
        let reported = *self.reported.lock().unwrap_or_else(PoisonError::into_inner);
        reported.is_some_and(|at| at.elapsed() < SILENCE)
    }
}
