//! What a camera's frames do to the memory of their place.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::frame::Source;

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

/// What was said about the modes of a place and of single cameras in it. What was not said is for the settings.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Modes {
    /// For all cameras of which nothing was said since.
    pub place: Option<Mode>,
    pub cameras: BTreeMap<Source, Mode>,
}

impl Modes {
    /// One thing that is said: of a camera, or of all of them.
    pub fn said(source: Option<&Source>, mode: Mode) -> Self {
        match source {
            None => Self {
                place: Some(mode),
                cameras: BTreeMap::new(),
            },
            Some(source) => Self {
                place: None,
                cameras: BTreeMap::from([(source.clone(), mode)]),
            },
        }
    }

    pub fn is_empty(&self) -> bool {
        self.place.is_none() && self.cameras.is_empty()
    }

    pub fn of(&self, source: &Source) -> Option<Mode> {
        self.cameras.get(source).copied().or(self.place)
    }

    /// What holds after this and then `later` was said. What is said of all cameras overrules what was said of single
    /// ones before.
    #[must_use]
    pub fn then(&self, later: &Self) -> Self {
        let mut all = match later.place {
            Some(_) => Self::default(),
            None => self.clone(),
        };
        all.place = later.place.or(self.place);
        for (source, mode) in &later.cameras {
            all.cameras.insert(source.clone(), *mode);
        }
        all
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_later_word_holds_and_one_for_all_overrules_those_for_single_cameras() {
        let [anna, bert] = ["anna", "bert"].map(|robot| Source {
            robot: robot.into(),
            camera: "head".into(),
        });
        let both = Modes::said(Some(&anna), Mode::Observe).then(&Modes::said(None, Mode::Freeze));
        assert_eq!(
            (both.of(&anna), both.of(&bert)),
            (Some(Mode::Freeze), Some(Mode::Freeze))
        );
        let both = both.then(&Modes::said(Some(&bert), Mode::Learn));
        assert_eq!(
            (both.of(&anna), both.of(&bert)),
            (Some(Mode::Freeze), Some(Mode::Learn))
        );
        // However it is put together.
        let later = Modes::said(None, Mode::Freeze).then(&Modes::said(Some(&bert), Mode::Learn));
        assert_eq!(Modes::said(Some(&anna), Mode::Observe).then(&later), both);
        assert_eq!(Modes::default().of(&anna), None);
    }
}
