//! Simulated robots on their way: every camera renders its next frame, publishes it when it is due and hears what the
//! service says; a judge compares that with what really happened.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Arc,
    time::{Duration, SystemTime, UNIX_EPOCH},
};

use anyhow::{Context, ensure};
use clap::ValueEnum;
use image::codecs::jpeg::JpegEncoder;
use serde_json::json;
use tokio::{
    sync::{mpsc, watch},
    task::JoinSet,
    time::Instant,
};

use super::output;
use crate::{
    model::{
        frame::{DepthSource, Frame, RgbImage, RigFrame, Source},
        report::PixelBox,
    },
    service::{
        robot::{Answer, PictureFile, Robot},
        session::ZenohOptions,
    },
    simulation::{
        judge::{Judge, Verdict},
        script::{Capture, FRAMES_PER_SECOND, Script, Views},
        tracker::Marker,
    },
    wire::{
        keys::{self, CameraPath},
        proto,
    },
};

/// To find a service, and to hear about a frame. Far longer than any frame takes.
const PATIENCE: Duration = Duration::from_secs(30);
/// Frames whose truth is kept until the answer comes; a service answers within a few.
const UNANSWERED_MAX: usize = 64;
const JPEG_QUALITY: u8 = 92;

/// What happens on the simulated table.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Story {
    /// Table I of the paper: a glass comes, a black cup comes and goes; 1283 frames.
    Tabletop,
    /// Section V-C of the paper: 316 frames to learn, then cup, milk and coffee come and go; 1416 frames.
    Objects,
    /// Endless: things come and go as the seed says.
    Patrol,
}

/// Which robots, in which world.
#[derive(Debug, Clone, clap::Args)]
pub struct WorldOptions {
    /// What happens on the table.
    #[arg(long, value_enum, default_value_t = Story::Patrol)]
    pub script: Story,
    /// Everything random follows from it.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// How many robots drive around the table.
    #[arg(long, default_value_t = 2, value_parser = clap::value_parser!(u8).range(1..=32))]
    pub robots: u8,
    /// Frames of each robot; without it the whole script.
    #[arg(long)]
    pub frames: Option<u64>,
}

impl WorldOptions {
    pub fn script(&self) -> Script {
        match self.script {
            Story::Tabletop => Script::tabletop(self.seed),
            Story::Objects => Script::objects(self.seed),
            Story::Patrol => Script::patrol(self.seed),
        }
        .with_robots(usize::from(self.robots))
    }
}

/// When frames are published.
#[derive(Debug, Clone, clap::Args)]
pub struct PaceOptions {
    /// Frames per second of each robot; real time if not given.
    #[arg(long, value_name = "HZ", value_parser = rate, conflicts_with = "lockstep")]
    pub rate: Option<f64>,
    /// Wait for the report on each frame before the next, as fast as that goes.
    #[arg(long)]
    pub lockstep: bool,
}

fn rate(text: &str) -> Result<f64, String> {
    text.parse()
        .ok()
        .filter(|rate| (0.01..=1000.0).contains(rate))
        .ok_or_else(|| "a rate lies between 0.01 and 1000 frames per second".to_owned())
}

/// What the robots' heads carry.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sensors {
    /// A depth camera; the robot tells its pose.
    Depth,
    /// Three cameras and a tracked plate (the paper's Fig. 3): depth and pose are the service's to find.
    Rig,
}

/// Where the robots publish.
#[derive(Debug, Clone)]
pub struct Network {
    pub zenoh: ZenohOptions,
    pub root: String,
    pub place: String,
}

/// What came of a run.
#[derive(Debug, Clone, Default, serde::Serialize)]
pub struct Summary {
    #[serde(flatten)]
    pub verdict: Verdict,
    pub frames: u64,
    pub reports: u64,
    pub refused: u64,
    /// Frames published more than one frame's time after they were due.
    pub late: u64,
    pub seconds: f64,
}

impl std::fmt::Display for Summary {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "{} of {} placed things noticed, {} false alarms; {} frames, {} reports, {} refused, {} late, {:.1} s",
            self.verdict.noticed,
            self.verdict.placed,
            self.verdict.false_alarms,
            self.frames,
            self.reports,
            self.refused,
            self.late,
            self.seconds
        )
    }
}

/// From a camera's task to the judge.
#[expect(clippy::large_enum_variant, reason = "most are answers")]
enum News {
    Published {
        late: bool,
    },
    Answered {
        station: usize,
        capture: Arc<Capture>,
        answer: Answer,
    },
}

/// Drives every camera of the script until its frames are over or `stop` turns true, and prints a line for each new
/// surprise.
///
/// # Errors
/// No service, a closed session, or a frame without an answer in lockstep.
pub async fn drive(
    script: Script,
    frames: Option<u64>,
    sensors: Sensors,
    pace: &PaceOptions,
    network: &Network,
    stop: watch::Receiver<bool>,
) -> anyhow::Result<Summary> {
    let script = Arc::new(script);
    let started = Instant::now();
    // A few frames of every camera: the judge is faster than any of them.
    let (sender, mut news) = mpsc::channel(256);
    let mut cameras = JoinSet::new();
    for station in 0..script.stations.len() {
        let camera = Camera {
            script: script.clone(),
            station,
            frames: frames.or(script.frames).unwrap_or(u64::MAX),
            hz: pace.rate.unwrap_or(FRAMES_PER_SECOND),
            lockstep: pace.lockstep,
            sensors,
            network: network.clone(),
            news: sender.clone(),
            unanswered: BTreeMap::new(),
        };
        cameras.spawn(camera.run(stop.clone()));
    }
    drop(sender);
    let mut desk = Desk {
        judge: Judge::new(&script),
        script: script.clone(),
        announced: BTreeSet::new(),
        summary: Summary::default(),
    };
    while let Some(item) = news.recv().await {
        desk.take(item)?;
    }
    while let Some(ended) = cameras.join_next().await {
        ended.context("a simulated camera failed")??;
    }
    Ok(Summary {
        verdict: desk.judge.verdict(),
        seconds: started.elapsed().as_secs_f64(),
        ..desk.summary
    })
}

/// Where all news come together.
struct Desk {
    judge: Judge,
    script: Arc<Script>,
    announced: BTreeSet<u64>,
    summary: Summary,
}

impl Desk {
    fn take(&mut self, news: News) -> anyhow::Result<()> {
        match news {
            News::Published { late } => {
                self.summary.frames += 1;
                self.summary.late += u64::from(late);
            }
            News::Answered {
                station,
                capture,
                answer: Answer::Report(report),
            } => {
                self.summary.reports += 1;
                self.judge_report(station, &capture, &report)?;
            }
            News::Answered {
                station,
                answer: Answer::Rejected(rejection),
                ..
            } => {
                self.summary.refused += 1;
                let robot = &self.script.stations[station].robot;
                eprintln!(
                    "{robot}: frame {} refused ({}): {}",
                    rejection.sequence, rejection.code, rejection.detail
                );
            }
        }
        Ok(())
    }

    fn judge_report(
        &mut self,
        station: usize,
        capture: &Capture,
        report: &proto::SurpriseReport,
    ) -> anyhow::Result<()> {
        let regions: Vec<(u64, PixelBox)> = report
            .regions
            .iter()
            .map(|region| {
                let pixels = region.r#box.unwrap_or_default();
                let pixel_box = PixelBox {
                    x_min: pixels.x_min,
                    y_min: pixels.y_min,
                    x_max: pixels.x_max,
                    y_max: pixels.y_max,
                };
                (region.id, pixel_box)
            })
            .collect();
        let reasons = self.judge.take(station, capture, &regions);
        for (region, reason) in report.regions.iter().zip(reasons) {
            if !self.announced.insert(region.id) {
                continue;
            }
            let pixels = region.r#box.unwrap_or_default();
            let place = region.center_in_world.map_or_else(String::new, |at| {
                format!(" at ({:+.2}, {:+.2}, {:+.2}) m", at.x, at.y, at.z)
            });
            output::line(format_args!(
                "{}/{} frame {}: surprised by {:.1} nats{place}, pixels {}..{} x {}..{} - {}",
                report.robot,
                report.camera,
                report.sequence,
                region.peak_surprise,
                pixels.x_min,
                pixels.x_max,
                pixels.y_min,
                pixels.y_max,
                reason.unwrap_or("nothing changed here"),
            ))?;
        }
        Ok(())
    }
}

/// One camera of one simulated robot.
struct Camera {
    script: Arc<Script>,
    station: usize,
    frames: u64,
    hz: f64,
    lockstep: bool,
    sensors: Sensors,
    network: Network,
    news: mpsc::Sender<News>,
    /// By sequence.
    unanswered: BTreeMap<u64, Arc<Capture>>,
}

impl Camera {
    async fn run(mut self, mut stop: watch::Receiver<bool>) -> anyhow::Result<()> {
        let station = self.script.stations[self.station].clone();
        let path = CameraPath::new(&self.network.place, &station.robot, &station.camera)
            .context("names are made of a-z, 0-9, _ and -")?;
        let mut robot = Robot::connect(&self.network.zenoh, &self.network.root, &path).await?;
        ensure!(
            robot.wait_for_service(PATIENCE).await?,
            "nobody takes frames at {}: is `surprised serve` running, with this --root, and does -e lead to it?",
            path.key(&self.network.root, keys::FRAME)
        );
        // The script's clock starts anew with every run; a robot's must not go back.
        let epoch_ns = SystemTime::now()
            .duration_since(UNIX_EPOCH)
            .map_or(0, |since| since.as_nanos() as i64)
            - self.script.stamp_ns(0);
        let started = Instant::now();
        let mut next = self.render(0);
        for number in 0..self.frames {
            let capture = Arc::new(next.await.context("rendering failed")?);
            next = self.render(number + 1);
            if *stop.borrow() {
                break;
            }
            let mut late = false;
            if !self.lockstep {
                let due = started + Duration::from_secs_f64(number as f64 / self.hz);
                late = Instant::now() > due + Duration::from_secs_f64(1.0 / self.hz);
                if !self.hear_until(&mut robot, due, &mut stop).await? {
                    break;
                }
            }
            let stamp_ns = capture.stamp_ns + epoch_ns;
            let file = Some(jpeg(&capture.middle.image)?);
            match self.sensors {
                Sensors::Depth => match self.frame(&capture, stamp_ns) {
                    Some(frame) => robot.publish(&frame, file).await?,
                    // The tracker lost the plate: the robot does not know where it is.
                    None => continue,
                },
                Sensors::Rig => {
                    if let Some(frame) = rig_frame(&capture, stamp_ns) {
                        let calibration = station.rig.calibration();
                        robot.publish_rig(&frame, &calibration, file).await?;
                    }
                }
            }
            robot
                .publish_truth(&truth(&self.script, &capture, stamp_ns))
                .await?;
            self.unanswered.insert(number, capture);
            while self.unanswered.len() > UNANSWERED_MAX {
                self.unanswered.pop_first();
            }
            self.tell(News::Published { late }).await?;
            let last = number + 1 == self.frames;
            if self.lockstep || last {
                self.hear_about(&mut robot, number, &mut stop).await?;
            }
        }
        Ok(())
    }

    fn render(&self, number: u64) -> tokio::task::JoinHandle<Capture> {
        let (script, station) = (self.script.clone(), self.station);
        let views = match self.sensors {
            Sensors::Depth => Views::Middle,
            Sensors::Rig => Views::Triple,
        };
        tokio::task::spawn_blocking(move || script.capture(station, number, views))
    }

    /// As a robot with a depth camera has it: depth as measured, pose from its own tracker; `None` where that has none.
    fn frame(&self, capture: &Capture, stamp_ns: i64) -> Option<Frame> {
        let at = &self.script.stations[self.station];
        let (world_from_camera, _) = self.script.localised(self.station, capture).ok()?;
        Some(Frame {
            source: Source {
                robot: at.robot.as_str().into(),
                camera: at.camera.as_str().into(),
            },
            stamp_ns,
            sequence: capture.sequence,
            image: capture.middle.image.clone(),
            depth: DepthSource::Given(capture.depth_m.clone()),
            intrinsics: at.rig.intrinsics,
            world_from_camera,
            pose_noise: None,
        })
    }

    async fn tell(&self, news: News) -> anyhow::Result<()> {
        self.news.send(news).await.context("the judge has gone")
    }

    async fn take(&mut self, answer: Answer) -> anyhow::Result<()> {
        match self.unanswered.remove(&answer.sequence()) {
            Some(capture) => {
                let station = self.station;
                self.tell(News::Answered {
                    station,
                    capture,
                    answer,
                })
                .await
            }
            None => Ok(()),
        }
    }

    /// Takes answers until then; false if the run is to stop.
    async fn hear_until(
        &mut self,
        robot: &mut Robot,
        until: Instant,
        stop: &mut watch::Receiver<bool>,
    ) -> anyhow::Result<bool> {
        loop {
            let patience = until.saturating_duration_since(Instant::now());
            let answer = tokio::select! {
                answer = robot.answer(patience) => answer,
                _ = stop.changed() => return Ok(false),
            };
            match answer {
                Some(answer) => self.take(answer).await?,
                None => return Ok(true),
            }
        }
    }

    /// Takes answers until this frame's has come.
    async fn hear_about(
        &mut self,
        robot: &mut Robot,
        number: u64,
        stop: &mut watch::Receiver<bool>,
    ) -> anyhow::Result<()> {
        let end = Instant::now() + PATIENCE;
        while self.unanswered.contains_key(&number) {
            let answer = tokio::select! {
                answer = robot.answer(end.saturating_duration_since(Instant::now())) => answer,
                _ = stop.changed() => return Ok(()),
            };
            let answer = answer.with_context(|| {
                format!("frame {number}: neither a report nor a rejection within {PATIENCE:?}")
            })?;
            self.take(answer).await?;
        }
        Ok(())
    }
}

/// What the rig's three cameras and the tracker saw; `None` where only the middle camera was rendered.
fn rig_frame(capture: &Capture, stamp_ns: i64) -> Option<RigFrame> {
    let (left, right) = capture.sides.as_ref()?;
    Some(RigFrame {
        stamp_ns,
        sequence: capture.sequence,
        image: capture.middle.image.clone(),
        left: left.image.grey(),
        right: right.image.grey(),
        marker_in_world: capture.markers.iter().map(Marker::tracked).collect(),
    })
}

fn jpeg(image: &RgbImage) -> anyhow::Result<PictureFile> {
    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(&mut bytes, JPEG_QUALITY).encode(
        &image.data,
        image.width as u32,
        image.height as u32,
        image::ExtendedColorType::Rgb8,
    )?;
    Ok(PictureFile {
        encoding: "jpeg",
        bytes,
    })
}

/// What really is there, for whoever judges from elsewhere.
fn truth(script: &Script, capture: &Capture, stamp_ns: i64) -> serde_json::Value {
    let pose = &capture.world_from_camera;
    let (p, q) = (pose.translation.vector, pose.rotation.coords);
    json!({
        "stamp_ns": stamp_ns,
        "sequence": capture.sequence,
        "world_from_camera": {"position": [p.x, p.y, p.z], "orientation_xyzw": [q.x, q.y, q.z, q.w]},
        "phase": capture.moment.phase,
        "pass": capture.direction(),
        "present": script.present(&capture.moment),
    })
}
