//! Questions to a service from outside, as `surprised query` asks them.

use std::time::Duration;

use zenoh::query::QueryConsolidation;

use super::session::ZenohOptions;
use crate::config::ConfigError;

/// A place may be busy with a large frame or two.
const ANSWER_WITHIN: Duration = Duration::from_secs(10);
/// Priors with all their planes.
const ANSWER_BYTES_MAX: usize = 1 << 29;

#[derive(Debug, thiserror::Error)]
pub enum AskError {
    #[error(transparent)]
    Config(#[from] ConfigError),
    #[error("Zenoh: {0}; see -c, -m, -e and -l")]
    Zenoh(#[source] zenoh::Error),
    #[error("the service refused {key}: {reason}")]
    Refused { key: String, reason: String },
    #[error(
        "nobody answered {key} within {} s: is the service running, and does -e lead to it?",
        ANSWER_WITHIN.as_secs()
    )]
    Silence { key: String },
}

/// Gets `selector`, with a request as bytes of its message if it needs one, and returns the replies, each with the key
/// it came on.
///
/// # Errors
/// No session, a refusal, or no answer at all.
pub async fn ask(
    options: &ZenohOptions,
    selector: &str,
    request: Option<Vec<u8>>,
) -> Result<Vec<(String, Vec<u8>)>, AskError> {
    let session = zenoh::open(options.config(ANSWER_BYTES_MAX)?)
        .await
        .map_err(AskError::Zenoh)?;
    let mut get = session
        .get(selector)
        .consolidation(QueryConsolidation::AUTO)
        .timeout(ANSWER_WITHIN);
    if let Some(request) = request {
        get = get.payload(request);
    }
    let replies = get.await.map_err(AskError::Zenoh)?;
    let mut answers = Vec::new();
    while let Ok(reply) = replies.recv_async().await {
        match reply.into_result() {
            Ok(sample) => answers.push((
                sample.key_expr().to_string(),
                sample.payload().to_bytes().into_owned(),
            )),
            Err(error) => {
                let reason = String::from_utf8_lossy(&error.payload().to_bytes()).into_owned();
                return Err(AskError::Refused {
                    key: selector.to_owned(),
                    reason,
                });
            }
        }
    }
    if answers.is_empty() {
        return Err(AskError::Silence {
            key: selector.to_owned(),
        });
    }
    if let Err(error) = session.close().await {
        tracing::debug!("the session was closed already: {error}");
    }
    Ok(answers)
}
