//! What a camera's frames do to the memory of their place.

use serde::{Deserialize, Serialize};

/// Every camera has one; it can be changed while frames come.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, Default, Hash, Serialize, Deserialize, clap::ValueEnum,
)]
#[serde(rename_all = "snake_case")]
pub enum Mode {
    /// Frames are compared with the memory and become part of it.
    #[default]
    Learn,
    /// Frames are compared, no viewpoint is written. The camera is here as any other, though: its visit goes on, so views
    /// that it wrote before count fully again once it has gone on from them, as for a camera that learns.
    Observe,
    /// Frames are compared and leave nothing behind, neither in the viewpoints nor in what is noted about the camera's
    /// visit: one frame is judged the same however often it comes and whatever came in between. Other cameras still
    /// learn; a memory that nobody may change is that of a place whose cameras all freeze.
    Freeze,
}

impl Mode {
    pub const ALL: [Self; 3] = [Self::Learn, Self::Observe, Self::Freeze];

    /// As on the wire.
    pub fn name(self) -> &'static str {
        match self {
            Self::Learn => "learn",
            Self::Observe => "observe",
            Self::Freeze => "freeze",
        }
    }

    /// `None`: there is no such mode.
    pub fn parse(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|mode| mode.name() == name)
    }
}
