//! A robot as seen from the robot: says that it is there, publishes frames, hears what the service says about each.
//! Recordings and simulated robots come to the service this way, over Zenoh like any other.

use std::time::Duration;

use tokio::{sync::mpsc, time::timeout};
use zenoh::{
    Session,
    bytes::Encoding,
    liveliness::LivelinessToken,
    pubsub::{Publisher, Subscriber},
    qos::CongestionControl,
};

use super::session::ZenohOptions;
use crate::{
    config::ConfigError,
    model::{
        camera::{Calibration, RigCalibration},
        frame::{Frame, RigFrame},
        refusal::{PLACE_HELD, Refusal},
    },
    wire::{
        decode, encode,
        keys::{self, CameraPath},
        proto,
    },
};

/// Answers that nobody took yet; more than a service can owe.
const ANSWERS_MAX: usize = 1024;
/// Reports have no pictures in them.
const ANSWER_BYTES_MAX: usize = 1 << 20;

/// A picture that is a file already and goes as it is.
#[derive(Debug, Clone)]
pub struct PictureFile {
    /// jpeg or png.
    pub encoding: &'static str,
    pub bytes: Vec<u8>,
}

/// What the service says about a frame.
#[derive(Debug, Clone)]
pub enum Answer {
    Report(proto::SurpriseReport),
    Rejected(proto::Rejection),
}

impl Answer {
    /// Of the frame that it is about; 0 where the service could not read it.
    pub fn sequence(&self) -> u64 {
        match self {
            Self::Report(report) => report.sequence,
            Self::Rejected(rejection) => rejection.sequence,
        }
    }

    /// Whether it comes from a service that only reads the place: the one that writes it may answer as well.
    pub fn is_of_a_reader(&self) -> bool {
        matches!(self, Self::Rejected(rejection) if rejection.code == PLACE_HELD)
    }
}

#[derive(Debug, thiserror::Error)]
pub enum RobotError {
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The session could not be opened, or is closed.
    #[error("Zenoh: {0}; see -c, -m, -e and -l")]
    Zenoh(#[from] zenoh::Error),
}

/// One camera of a robot with a session of its own. Gone from the network when dropped.
pub struct Robot {
    frames: Publisher<'static>,
    truth: Publisher<'static>,
    answers: mpsc::Receiver<Answer>,
    _subscribers: [Subscriber<()>; 2],
    _token: LivelinessToken,
    _session: Session,
}

impl Robot {
    /// # Errors
    /// Options that Zenoh refuses, or a session that cannot be opened.
    pub async fn connect(
        options: &ZenohOptions,
        root: &str,
        path: &CameraPath,
    ) -> Result<Self, RobotError> {
        if !keys::is_root(root) {
            return Err(ConfigError::Root(root.to_owned()).into());
        }
        let session = zenoh::open(options.config(ANSWER_BYTES_MAX)?).await?;
        let (sender, answers) = mpsc::channel(ANSWERS_MAX);
        let hear = |leaf, unpack: fn(&[u8]) -> Result<Answer, Refusal>| {
            let sender = sender.clone();
            session
                .declare_subscriber(path.key(root, leaf))
                .callback(move |sample| match unpack(&sample.payload().to_bytes()) {
                    // Full means that nobody takes answers: then the newest are lost.
                    Ok(answer) => drop(sender.try_send(answer)),
                    Err(refusal) => tracing::warn!(key = %sample.key_expr(), "{refusal}"),
                })
        };
        let subscribers = [
            hear(keys::REPORT, |bytes| {
                decode::message(bytes).map(Answer::Report)
            })
            .await?,
            hear(keys::REJECTED, |bytes| {
                decode::message(bytes).map(Answer::Rejected)
            })
            .await?,
        ];
        let frames = session
            .declare_publisher(path.key(root, keys::FRAME))
            .encoding(keys::encoding::<proto::Frame>())
            // Raw depth is larger than Zenoh's queue: what may be dropped would be, also on an idle network.
            .congestion_control(CongestionControl::Block)
            .await?;
        let truth = session
            .declare_publisher(path.key(root, keys::TRUTH))
            .encoding(Encoding::APPLICATION_JSON)
            .await?;
        let token = session.liveliness().declare_token(path.live(root)).await?;
        Ok(Self {
            frames,
            truth,
            answers,
            _subscribers: subscribers,
            _token: token,
            _session: session,
        })
    }

    /// Waits until some service subscribes to the frames; false if none does in time.
    ///
    /// # Errors
    /// A closed session.
    pub async fn wait_for_service(&self, patience: Duration) -> Result<bool, RobotError> {
        let changes = self.frames.matching_listener().await?;
        if self.frames.matching_status().await?.matching() {
            return Ok(true);
        }
        let matched = async {
            while let Ok(status) = changes.recv_async().await {
                if status.matching() {
                    return true;
                }
            }
            false
        };
        Ok(timeout(patience, matched).await.unwrap_or(false))
    }

    /// With its calibration. The image goes as `file` if there is one, else as raw pixels.
    ///
    /// # Errors
    /// A closed session.
    pub async fn publish(
        &self,
        frame: &Frame,
        file: Option<PictureFile>,
    ) -> Result<(), RobotError> {
        let mut message = encode::frame(frame);
        message.calibration = Some(encode::calibration(&Calibration {
            intrinsics: frame.intrinsics,
            distortion: None,
        }));
        self.put(message, file).await
    }

    /// A frame of a rig, with its calibration. The image goes as `file` if there is one, the side images as grey ones.
    ///
    /// # Errors
    /// A closed session.
    pub async fn publish_rig(
        &self,
        frame: &RigFrame,
        calibration: &RigCalibration,
        file: Option<PictureFile>,
    ) -> Result<(), RobotError> {
        let mut message = encode::rig_frame(frame);
        message.calibration = Some(encode::rig_calibration(calibration));
        self.put(message, file).await
    }

    async fn put(
        &self,
        mut message: proto::Frame,
        file: Option<PictureFile>,
    ) -> Result<(), RobotError> {
        if let Some(PictureFile { encoding, bytes }) = file {
            message.image = Some(proto::Image {
                encoding: encoding.to_owned(),
                data: bytes,
                ..proto::Image::default()
            });
        }
        Ok(self.frames.put(encode::bytes(&message)).await?)
    }

    /// What a simulated robot knows to be there, beside its frames.
    ///
    /// # Errors
    /// A closed session.
    pub async fn publish_truth(&self, truth: &serde_json::Value) -> Result<(), RobotError> {
        Ok(self.truth.put(truth.to_string()).await?)
    }

    /// The next answer; `None` if none comes in time.
    pub async fn answer(&mut self, patience: Duration) -> Option<Answer> {
        timeout(patience, self.answers.recv()).await.ok().flatten()
    }
}
