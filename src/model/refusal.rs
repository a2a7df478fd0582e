//! Why something from outside was refused: one word for programs, one sentence for people.

use super::frame::FrameError;

/// Another service writes this place.
pub const PLACE_HELD: &str = "place_held";

/// Says what is wrong and what to do. The memory is as it was before.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{detail}")]
pub struct Refusal {
    /// As in `Rejection.code`; one of a fixed set, so that it can be counted.
    pub code: &'static str,
    pub detail: String,
}

impl Refusal {
    pub fn new(code: &'static str, detail: impl Into<String>) -> Self {
        Self {
            code,
            detail: detail.into(),
        }
    }
}

impl From<FrameError> for Refusal {
    fn from(error: FrameError) -> Self {
        Self::new(error.code(), error.to_string())
    }
}
