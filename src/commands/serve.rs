//! `surprised serve`: the service, until a signal ends it.

use tokio::signal::unix::{SignalKind, signal};

use super::options::ServiceOptions;
use crate::service;

/// Remembers what robots see and reports what surprises them
#[derive(Debug, clap::Args)]
pub struct Serve {
    #[command(flatten)]
    options: ServiceOptions,
}

impl Serve {
    /// Until SIGINT or SIGTERM.
    ///
    /// # Errors
    /// As [`service::serve`].
    pub async fn run(self) -> anyhow::Result<()> {
        let stop = stop_signal()?;
        Ok(service::serve(self.options.options(true)?, stop).await?)
    }
}

/// Ends when the process is told to stop.
///
/// # Errors
/// Signals that cannot be listened to.
pub fn stop_signal() -> std::io::Result<impl Future<Output = ()>> {
    let mut interrupt = signal(SignalKind::interrupt())?;
    let mut terminate = signal(SignalKind::terminate())?;
    Ok(async move {
        tokio::select! {
            _ = interrupt.recv() => tracing::info!("SIGINT: stopping"),
            _ = terminate.recv() => tracing::info!("SIGTERM: stopping"),
        }
    })
}
