//! A service, a session that plays the robots, and a scene for them to see.

use std::{future::Future, net::SocketAddr, time::Duration};

use surprised::{
    config::{Preset, Settings},
    engine::EngineKind,
    memory::store::Store,
    model::{
        camera::{Calibration, Intrinsics},
        frame::{DepthSource, Frame, RgbImage, Source},
        pose::Pose,
    },
    service::{Options, ServeError, Service, access::HttpAccess, session::ZenohOptions},
    wire::{
        decode, encode,
        keys::{self, CameraPath},
        proto::{self, Rejection, SurpriseReport},
    },
};
use tokio::{sync::oneshot, task::JoinHandle, time::timeout};
use zenoh::{Session, handlers::FifoChannelHandler, pubsub::Subscriber, sample::Sample};

/// Of everything that is awaited: far more than it takes, so that only a lost message fails.
pub const PATIENCE: Duration = Duration::from_secs(30);

pub const CAMERA: Intrinsics = Intrinsics {
    width: 64,
    height: 48,
    fx: 60.0,
    fy: 60.0,
    cx: 31.5,
    cy: 23.5,
};

pub const SECOND: i64 = 1_000_000_000;

/// Some time in 2026.
pub const NOON: i64 = 1_790_000_000 * SECOND;

pub type Samples = Subscriber<FifoChannelHandler<Sample>>;

pub struct Rig {
    pub session: Session,
    pub http: SocketAddr,
    endpoints: Vec<String>,
    stop: oneshot::Sender<()>,
    service: JoinHandle<Result<(), ServeError>>,
}

impl Rig {
    pub async fn start(settings: &[&str]) -> Self {
        Self::remembering(settings, None).await
    }

    /// Where its memory lasts.
    pub async fn remembering(settings: &[&str], store: Option<Store>) -> Self {
        Self::in_network(settings, store, &[]).await
    }

    /// On one network with another one, which hears what this session puts.
    pub async fn beside(other: &Self, store: Option<Store>) -> Self {
        Self::in_network(&[], store, &other.endpoints).await
    }

    async fn in_network(settings: &[&str], store: Option<Store>, others: &[String]) -> Self {
        let settings: Vec<String> = settings.iter().map(|&pair| pair.to_owned()).collect();
        let alone = ["scouting/gossip/enabled:false".to_owned()];
        let service = Service::start(Options {
            store,
            engine: EngineKind::Cpu,
            settings: Settings::layered(Preset::Robust, None, &settings).expect("good settings"),
            root: "test/surprised".to_owned(),
            http: Some(([127, 0, 0, 1], 0).into()),
            http_access: HttpAccess::default(),
            zenoh: ZenohOptions {
                listen: vec!["tcp/127.0.0.1:0".to_owned()],
                connect: others.to_vec(),
                cfg: alone.to_vec(),
                ..ZenohOptions::default()
            },
        })
        .await
        .expect("the service starts");
        let http = service.http_addr().expect("HTTP is on");
        let endpoints = service.locators().to_vec();
        let everywhere = [&endpoints[..], others].concat();
        let mut config = zenoh::Config::default();
        for (key, value) in [
            ("connect/endpoints", format!("{everywhere:?}")),
            ("listen/endpoints", "[]".to_owned()),
            ("scouting/multicast/enabled", "false".to_owned()),
            ("scouting/gossip/enabled", "false".to_owned()),
        ] {
            config.insert_json5(key, &value).expect("a known key");
        }
        let (stop, stopped) = oneshot::channel::<()>();
        let service = tokio::spawn(service.run(async move {
            drop(stopped.await);
        }));
        let session = zenoh::open(config).await.expect("a session opens");
        Self {
            session,
            http,
            endpoints,
            stop,
            service,
        }
    }

    /// Stops the service and returns what it came to.
    pub async fn stop(self) -> Result<(), ServeError> {
        self.stop.send(()).expect("the service runs");
        let result = patient(self.service).await.expect("no panic");
        self.session.close().await.expect("the session closes");
        result
    }

    pub async fn subscribe(&self, camera: &CameraPath, leaf: &str) -> Samples {
        self.session
            .declare_subscriber(camera.key(ROOT, leaf))
            .await
            .expect("a subscriber")
    }

    pub async fn put<M: encode::Named>(&self, camera: &CameraPath, leaf: &str, message: &M) {
        self.session
            .put(camera.key(ROOT, leaf), encode::bytes(message))
            .encoding(keys::encoding::<M>())
            .congestion_control(zenoh::qos::CongestionControl::Block)
            .await
            .expect("put");
    }

    pub async fn put_calibration(&self, camera: &CameraPath) {
        self.put(camera, keys::CALIBRATION, &calibration()).await;
    }

    /// Everything put before has reached the service when this returns: queries travel behind it.
    pub async fn status(&self, place: &str) -> serde_json::Value {
        serde_json::from_slice(&self.ask(&keys::memory(ROOT, place, "status")).await)
            .expect("status is JSON")
    }

    /// The status once it is as it should be.
    pub async fn status_when(
        &self,
        place: &str,
        there: impl Fn(&serde_json::Value) -> bool,
    ) -> serde_json::Value {
        patient(async {
            loop {
                let status = self.status(place).await;
                if there(&status) {
                    return status;
                }
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
        })
        .await
    }

    pub async fn ask(&self, selector: &str) -> Vec<u8> {
        self.try_ask(selector, None).await.expect("an answer")
    }

    pub async fn try_ask(
        &self,
        selector: &str,
        payload: Option<Vec<u8>>,
    ) -> Result<Vec<u8>, String> {
        let mut get = self.session.get(selector).timeout(PATIENCE);
        if let Some(payload) = payload {
            get = get.payload(payload);
        }
        let replies = get.await.expect("a get");
        let reply = patient(replies.recv_async()).await.expect("a reply");
        match reply.into_result() {
            Ok(sample) => Ok(sample.payload().to_bytes().into_owned()),
            Err(error) => Err(String::from_utf8_lossy(&error.payload().to_bytes()).into_owned()),
        }
    }
}

pub const ROOT: &str = "test/surprised";

pub fn camera(place: &str, robot: &str) -> CameraPath {
    CameraPath::new(place, robot, "head").expect("good ids")
}

pub async fn patient<T>(future: impl Future<Output = T>) -> T {
    timeout(PATIENCE, future).await.expect("it comes")
}

pub async fn next<M: prost::Message + Default + prost::Name>(samples: &Samples) -> M {
    let sample = patient(samples.recv_async()).await.expect("a sample");
    assert_eq!(*sample.encoding(), keys::encoding::<M>());
    decode::message(&sample.payload().to_bytes()).expect("it decodes")
}

pub async fn next_report(samples: &Samples) -> SurpriseReport {
    next(samples).await
}

pub async fn next_rejection(samples: &Samples) -> Rejection {
    next(samples).await
}

pub fn calibration() -> proto::Calibration {
    encode::calibration(&Calibration {
        intrinsics: CAMERA,
        distortion: None,
    })
}

/// What a camera `x` metres right of the origin sees of a textured wall two metres ahead.
pub fn wall(camera: &CameraPath, sequence: u64, x_m: f64) -> Frame {
    let depth_m = 2.0;
    let mut data = Vec::new();
    for v in 0..CAMERA.height {
        for u in 0..CAMERA.width {
            let point = CAMERA.unproject(u as f64, v as f64, depth_m);
            let (x, y) = (point.x + x_m, point.y);
            let wave =
                |phase: f64| (128.0 + 60.0 * (9.0 * x + phase).sin() * (7.0 * y).cos()) as u8;
            data.extend([wave(0.0), wave(1.0), wave(2.0)]);
        }
    }
    Frame {
        source: Source {
            robot: camera.source.robot.clone(),
            camera: camera.source.camera.clone(),
        },
        stamp_ns: NOON + sequence as i64 * SECOND / 10,
        sequence,
        image: RgbImage {
            width: CAMERA.width,
            height: CAMERA.height,
            data,
        },
        depth: DepthSource::Given(vec![depth_m as f32; CAMERA.pixels()]),
        intrinsics: CAMERA,
        world_from_camera: Pose::translation(x_m, 0.0, 0.0),
        pose_noise: None,
    }
}

/// With something in the middle that was not there.
pub fn changed(mut frame: Frame) -> Frame {
    for v in 18..30 {
        for u in 26..38 {
            let at = 3 * (v * CAMERA.width + u);
            frame.image.data[at..at + 3].copy_from_slice(&[255, 0, 0]);
        }
    }
    frame
}

pub fn posed(camera: &CameraPath, sequence: u64) -> proto::Frame {
    encode::frame(&wall(camera, sequence, 0.0))
}

/// Whose pose is to come on the `pose` key.
pub fn poseless(camera: &CameraPath, sequence: u64) -> proto::Frame {
    proto::Frame {
        world_from_camera: None,
        ..posed(camera, sequence)
    }
}
