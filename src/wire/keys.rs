//! Where messages travel: key expressions below a root, and the encodings that name the messages.
//!
//! ```text
//! <root>/<place>/<robot>/<camera>/{calibration|frame|pose|markers|truth} from robots
//! <root>/<place>/<robot>/<camera>/surprise/{report|map|...|rejected} from the service
//! <root>/<place>/<robot>/<camera>/mode                               put and queryable
//! <root>/<place>/@memory/{prior|evaluate|views|status|...}           queryables
//! <root>/<place>/@events/<id>                                        events, put and queryable
//! <root>/<place>/@live/robot/<robot>/<camera>                        liveliness of cameras
//! <root>/<place>/@live/service/<session>                             liveliness of services
//! ```

use std::sync::Arc;

use zenoh::{bytes::Encoding, key_expr::KeyExpr};

use crate::model::frame::Source;

/// Longer names help nobody and every one of them is kept.
pub const ID_LENGTH_MAX: usize = 64;

pub const FRAME: &str = "frame";
pub const CALIBRATION: &str = "calibration";
pub const POSE: &str = "pose";
pub const MARKERS: &str = "markers";
/// What a camera's frames do to the memory.
pub const MODE: &str = "mode";
/// What really is there, as JSON; from simulated robots only.
pub const TRUTH: &str = "truth";
pub const REPORT: &str = "surprise/report";
pub const REJECTED: &str = "surprise/rejected";

/// Names of places, robots and cameras: `[a-z0-9_-]+`.
pub fn is_id(text: &str) -> bool {
    (1..=ID_LENGTH_MAX).contains(&text.len())
        && text
            .bytes()
            .all(|byte| matches!(byte, b'a'..=b'z' | b'0'..=b'9' | b'_' | b'-'))
}

/// A root may have several chunks, but none that stands for more than itself.
pub fn is_root(text: &str) -> bool {
    KeyExpr::try_from(text).is_ok_and(|key| !key.is_wild())
}

/// A camera at a place.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct CameraPath {
    pub place: Arc<str>,
    pub source: Source,
}

impl CameraPath {
    /// `None` where a name is not an id.
    pub fn new(place: &str, robot: &str, camera: &str) -> Option<Self> {
        [place, robot, camera].into_iter().all(is_id).then(|| Self {
            place: place.into(),
            source: Source {
                robot: robot.into(),
                camera: camera.into(),
            },
        })
    }

    /// Of `<root>/<place>/<robot>/<camera>/<leaf>`.
    pub fn parse(root: &str, key: &str) -> Option<Self> {
        let mut chunks = below(root, key)?.split('/');
        let path = Self::new(chunks.next()?, chunks.next()?, chunks.next()?)?;
        (chunks.next().is_some() && chunks.next().is_none()).then_some(path)
    }

    /// Of a camera's liveliness token.
    pub fn parse_live(root: &str, key: &str) -> Option<Self> {
        let mut chunks = below(root, key)?.split('/');
        let place = chunks.next()?;
        if (chunks.next()?, chunks.next()?) != ("@live", "robot") {
            return None;
        }
        let path = Self::new(place, chunks.next()?, chunks.next()?)?;
        chunks.next().is_none().then_some(path)
    }

    pub fn key(&self, root: &str, leaf: &str) -> String {
        let Source { robot, camera } = &self.source;
        format!("{root}/{}/{robot}/{camera}/{leaf}", self.place)
    }

    /// The token that says this camera is there.
    pub fn live(&self, root: &str) -> String {
        let Source { robot, camera } = &self.source;
        format!("{root}/{}/@live/robot/{robot}/{camera}", self.place)
    }
}

fn below<'a>(root: &str, key: &'a str) -> Option<&'a str> {
    key.strip_prefix(root)?.strip_prefix('/')
}

/// A leaf of every camera.
pub fn every_camera(root: &str, leaf: &str) -> String {
    format!("{root}/*/*/*/{leaf}")
}

/// The reports on every camera of a place.
pub fn every_report(root: &str, place: &str) -> String {
    format!("{root}/{place}/*/*/{REPORT}")
}

/// The tokens of every camera.
pub fn every_live_camera(root: &str) -> String {
    format!("{root}/*/@live/robot/*/*")
}

pub fn live_service(root: &str, place: &str, session: &str) -> String {
    format!("{root}/{place}/@live/service/{session}")
}

pub fn memory(root: &str, place: &str, question: &str) -> String {
    format!("{root}/{place}/@memory/{question}")
}

/// `id`: an event's, or `*`.
pub fn event(root: &str, place: &str, id: impl std::fmt::Display) -> String {
    format!("{root}/{place}/@events/{id}")
}

/// Place and question of a [`memory`] key; `None` where the place is not an id.
pub fn parse_memory<'a>(root: &str, key: &'a str) -> Option<(&'a str, &'a str)> {
    let (place, question) = below(root, key)?.split_once("/@memory/")?;
    is_id(place).then_some((place, question))
}

/// `application/protobuf;surprised.v1.<Message>`.
pub fn encoding<M: prost::Name>() -> Encoding {
    Encoding::APPLICATION_PROTOBUF.with_schema(M::full_name())
}
