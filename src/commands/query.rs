//! `surprised query`: asks a service's memory.

use std::{
    fs,
    path::{Path, PathBuf},
    str::FromStr,
};

use anyhow::Context;
use clap::{Subcommand, ValueEnum};

use super::{output, replay::id};
use crate::{
    config::ConfigError,
    model,
    service::{client, session::ZenohOptions},
    wire::{
        decode,
        encode::{self, PriorPlane},
        keys::{self, CameraPath},
        picture, proto,
    },
};

/// Asks a service what it remembers
#[derive(Debug, clap::Args)]
pub struct Query {
    #[command(subcommand)]
    question: Question,
}

#[derive(Debug, Subcommand)]
enum Question {
    /// What would be seen from a pose, as a PNG
    Prior(Prior),
    /// How surprising a picture would be, as JSON; nothing is learnt
    Evaluate(Evaluate),
    /// The viewpoints of a place, as JSON
    Views(Place),
    /// What the service says about a place, as JSON
    Status(Place),
    /// From which poses a picture would teach most, as JSON, the best first
    NextView(NextView),
    /// How a camera's frames are taken, or are to be taken
    Mode(Mode),
    /// Takes a region, a span of time, or everything out of a place's memory, for good
    Forget(Forget),
}

#[derive(Debug, clap::Args)]
struct Place {
    /// The place asked about.
    #[arg(long, value_parser = id)]
    place: String,
    /// The Zenoh key below which the service is.
    #[arg(long, value_name = "KEY", default_value = "surprised")]
    root: String,
    #[command(flatten)]
    zenoh: ZenohOptions,
}

#[derive(Debug, clap::Args)]
struct Prior {
    #[command(flatten)]
    place: Place,
    /// world_from_camera: x,y,z in metres and the quaternion qx,qy,qz,qw; camera axes x right, y down, z forward.
    #[arg(long, value_name = POSE, allow_hyphen_values = true)]
    pose: Numbers<7>,
    /// Of the imagined camera, in pixels.
    #[arg(long, value_name = LENS, value_parser = lens)]
    intrinsics: Numbers<6>,
    /// What to show.
    #[arg(long, value_enum, default_value_t = Plane::Expected)]
    plane: Plane,
    /// Where to write the PNG.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

const POSE: &str = "X,Y,Z,QX,QY,QZ,QW";
const LENS: &str = "FX,FY,CX,CY,WIDTH,HEIGHT";

#[derive(Debug, clap::Args)]
struct Evaluate {
    #[command(flatten)]
    place: Place,
    /// The picture, a jpeg or png file.
    #[arg(long, value_name = "FILE")]
    image: PathBuf,
    /// Its depth, a 16 bit png of millimetres.
    #[arg(long, value_name = "FILE")]
    depth: PathBuf,
    /// Where it was taken: world_from_camera, as for `prior`.
    #[arg(long, value_name = POSE, allow_hyphen_values = true)]
    pose: Numbers<7>,
    /// Of the camera that took it, in pixels.
    #[arg(long, value_name = LENS, value_parser = lens)]
    intrinsics: Numbers<6>,
}

#[derive(Debug, clap::Args)]
struct NextView {
    #[command(flatten)]
    place: Place,
    /// A candidate: world_from_camera, as for `prior`; may be repeated.
    #[arg(
        long = "candidate", value_name = POSE, allow_hyphen_values = true,
        requires = "intrinsics", required_unless_present = "robot"
    )]
    candidates: Vec<Numbers<7>>,
    /// Of the imagined camera, in pixels; small ones rank as well.
    #[arg(long, value_name = LENS, value_parser = lens)]
    intrinsics: Option<Numbers<6>>,
    /// In place of candidates, a ring around where this robot was last.
    #[arg(long, requires = "camera", conflicts_with = "candidates")]
    robot: Option<String>,
    /// Which camera of the robot.
    #[arg(long, requires = "robot")]
    camera: Option<String>,
    /// Of the ring, metres; 0 turns on the spot.
    #[arg(long, default_value_t = 0.0, requires = "robot")]
    radius: f64,
    /// How many poses the ring has.
    #[arg(long, default_value_t = 8, requires = "robot")]
    count: u32,
}

#[derive(Debug, clap::Args)]
struct Mode {
    #[command(flatten)]
    place: Place,
    /// Whose; without it the whole place's.
    #[arg(long, requires = "camera")]
    robot: Option<String>,
    /// Which camera of the robot.
    #[arg(long, requires = "robot")]
    camera: Option<String>,
    /// What it is from now on.
    #[arg(long, value_enum)]
    set: Option<model::mode::Mode>,
}

#[derive(Debug, clap::Args)]
struct Forget {
    #[command(flatten)]
    place: Place,
    /// What lies in this ball of the world, metres.
    #[arg(long, value_name = "X,Y,Z,RADIUS", allow_hyphen_values = true)]
    sphere: Option<Numbers<4>>,
    /// What lies in this box along the world's axes, metres.
    #[arg(long = "box", value_name = "X,Y,Z,X,Y,Z", allow_hyphen_values = true)]
    bounds: Option<Numbers<6>>,
    /// What was written last from then on, seconds since 1970.
    #[arg(long, value_name = "SECONDS", value_parser = finite)]
    since: Option<f64>,
    /// What was written last before, seconds since 1970.
    #[arg(long, value_name = "SECONDS", value_parser = finite)]
    until: Option<f64>,
    /// The whole place.
    #[arg(long)]
    everything: bool,
}

/// So many numbers with commas between them.
#[derive(Debug, Clone, Copy)]
struct Numbers<const N: usize>([f64; N]);

impl<const N: usize> FromStr for Numbers<N> {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let numbers: Result<Vec<f64>, _> = text
            .split(',')
            .map(|number| number.trim().parse())
            .collect();
        numbers
            .ok()
            .and_then(|numbers| numbers.try_into().ok())
            .map(Self)
            .ok_or_else(|| format!("these must be {N} numbers with commas between them"))
    }
}

/// With a size in whole pixels.
fn lens(text: &str) -> Result<Numbers<6>, String> {
    let lens: Numbers<6> = text.parse()?;
    let [.., width, height] = lens.0;
    if width.fract() == 0.0 && height.fract() == 0.0 {
        Ok(lens)
    } else {
        Err("width and height must be whole numbers".to_owned())
    }
}

/// NaN would be a time of its own.
fn finite(text: &str) -> Result<f64, String> {
    let number = text.trim().parse().ok();
    number
        .filter(|number: &f64| number.is_finite())
        .ok_or_else(|| "this must be a finite number".to_owned())
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum Plane {
    /// The expected colours; what nobody saw is dark grey.
    Expected,
    /// Expected standard deviation, white at 60 grey levels.
    Uncertainty,
    /// How many viewpoints saw a pixel, white at seven.
    Coverage,
    /// Depth, white at ten metres.
    Depth,
}

impl Query {
    /// # Errors
    /// As [`client::ask`], and files that cannot be written.
    pub async fn run(self) -> anyhow::Result<()> {
        match self.question {
            Question::Prior(prior) => prior.run().await,
            Question::Evaluate(evaluate) => evaluate.run().await,
            Question::Views(place) => print(&place.ask("views", "format=json").await?),
            Question::Status(place) => print(&place.ask("status", "").await?),
            Question::NextView(next_view) => next_view.run().await,
            Question::Mode(mode) => mode.run().await,
            Question::Forget(forget) => forget.run().await,
        }
    }
}

fn print(json: &[u8]) -> anyhow::Result<()> {
    let value: serde_json::Value = serde_json::from_slice(json)?;
    output::line(serde_json::to_string_pretty(&value)?)
}

impl Place {
    async fn ask(&self, question: &str, parameters: &str) -> anyhow::Result<Vec<u8>> {
        self.ask_with(question, parameters, None).await
    }

    async fn ask_with(
        &self,
        question: &str,
        parameters: &str,
        request: Option<Vec<u8>>,
    ) -> anyhow::Result<Vec<u8>> {
        self.check()?;
        let key = keys::memory(&self.root, &self.place, question);
        self.get(&format!("{key}?{parameters}"), request).await
    }

    fn check(&self) -> anyhow::Result<()> {
        if !keys::is_root(&self.root) {
            return Err(ConfigError::Root(self.root.clone()).into());
        }
        Ok(())
    }

    async fn get(&self, selector: &str, request: Option<Vec<u8>>) -> anyhow::Result<Vec<u8>> {
        let answers = client::ask(&self.zenoh, selector, request).await?;
        answers
            .into_iter()
            .next()
            .map(|(_, answer)| answer)
            .context("the service's answer is empty")
    }
}

impl Numbers<7> {
    fn pose(&self) -> proto::Pose {
        let [x, y, z, qx, qy, qz, qw] = self.0;
        proto::Pose {
            position: Some(proto::Vector3 { x, y, z }),
            orientation: Some(proto::Quaternion {
                x: qx,
                y: qy,
                z: qz,
                w: qw,
            }),
        }
    }
}

impl Numbers<6> {
    fn lens(&self) -> proto::Intrinsics {
        let [fx, fy, cx, cy, width, height] = self.0;
        proto::Intrinsics {
            // Saturates; the service checks.
            width: width as u32,
            height: height as u32,
            fx,
            fy,
            cx,
            cy,
            ..proto::Intrinsics::default()
        }
    }
}

impl Evaluate {
    async fn run(self) -> anyhow::Result<()> {
        let file = |path: &Path, encoding: &str| -> anyhow::Result<proto::Image> {
            let data = fs::read(path).with_context(|| path.display().to_string())?;
            Ok(proto::Image {
                encoding: encoding.to_owned(),
                data,
                ..proto::Image::default()
            })
        };
        let is_png = |path: &Path| path.extension().is_some_and(|end| end == "png");
        let lens = self.intrinsics.lens();
        let sized = |image| proto::Image {
            width: lens.width,
            height: lens.height,
            ..image
        };
        let picture = if is_png(&self.image) { "png" } else { "jpeg" };
        let request = proto::EvaluateRequest {
            frame: Some(proto::Frame {
                stamp: Some(encode::timestamp(0)),
                image: Some(sized(file(&self.image, picture)?)),
                depth: Some(sized(file(&self.depth, "png")?)),
                world_from_camera: Some(self.pose.pose()),
                calibration: Some(proto::Calibration {
                    middle: Some(lens.clone()),
                    ..proto::Calibration::default()
                }),
                ..proto::Frame::default()
            }),
        };
        let bytes = encode::bytes(&request);
        let answer = self.place.ask_with("evaluate", "", Some(bytes)).await?;
        let reply: proto::EvaluateReply = decode::message(&answer)?;
        let report = reply.report.context("the reply has no report")?;
        output::line(serde_json::to_string_pretty(&encode::json(&report))?)
    }
}

impl NextView {
    async fn run(self) -> anyhow::Result<()> {
        let request = proto::NextViewRequest {
            candidates: self.candidates.iter().map(Numbers::pose).collect(),
            ring: self.robot.map(|robot| proto::Ring {
                around: None,
                robot,
                camera: self.camera.unwrap_or_default(),
                radius: self.radius,
                count: self.count,
            }),
            intrinsics: self.intrinsics.as_ref().map(Numbers::lens),
        };
        let bytes = encode::bytes(&request);
        let answer = self.place.ask_with("next_view", "format=json", Some(bytes));
        print(&answer.await?)
    }
}

impl Mode {
    async fn run(self) -> anyhow::Result<()> {
        self.place.check()?;
        let root = &self.place.root;
        let key = match (&self.robot, &self.camera) {
            (Some(robot), Some(camera)) => CameraPath::new(&self.place.place, robot, camera)
                .context("robots and cameras are [a-z0-9_-]+")?
                .key(root, keys::MODE),
            _ => keys::memory(root, &self.place.place, keys::MODE),
        };
        let set = self
            .set
            .map_or(String::new(), |mode| format!(";set={}", mode.name()));
        print(
            &self
                .place
                .get(&format!("{key}?format=json{set}"), None)
                .await?,
        )
    }
}

impl Forget {
    async fn run(self) -> anyhow::Result<()> {
        let stamp = |seconds: f64| encode::timestamp((seconds * 1e9).round() as i64);
        let point = |numbers: &[f64]| {
            Some(proto::Vector3 {
                x: numbers[0],
                y: numbers[1],
                z: numbers[2],
            })
        };
        let request = proto::ForgetRequest {
            sphere: self.sphere.map(|Numbers(sphere)| proto::Sphere {
                center: point(&sphere),
                radius: sphere[3],
            }),
            r#box: self.bounds.map(|Numbers(bounds)| proto::WorldBox {
                min: point(&bounds[..3]),
                max: point(&bounds[3..]),
            }),
            span: (self.since.is_some() || self.until.is_some()).then(|| proto::TimeSpan {
                since: self.since.map(stamp),
                until: self.until.map(stamp),
            }),
            everything: self.everything,
        };
        let bytes = encode::bytes(&request);
        let answer = self.place.ask_with("forget", "format=json", Some(bytes));
        print(&answer.await?)
    }
}

impl Prior {
    async fn run(self) -> anyhow::Result<()> {
        let (name, plane) = match self.plane {
            Plane::Expected => ("expected", PriorPlane::Expected),
            Plane::Uncertainty => ("uncertainty", PriorPlane::Uncertainty),
            Plane::Coverage => ("coverage", PriorPlane::Coverage),
            Plane::Depth => ("depth", PriorPlane::Depth),
        };
        let request = proto::PriorRequest {
            world_from_camera: Some(self.pose.pose()),
            intrinsics: Some(self.intrinsics.lens()),
            planes: vec![name.to_owned()],
        };
        let bytes = encode::bytes(&request);
        let answer = self.place.ask_with("prior", "", Some(bytes)).await?;
        let reply: proto::PriorReply = decode::message(&answer)?;
        let png = picture::plane_png(&reply, plane).context("the reply has no such plane")?;
        fs::write(&self.out, png).with_context(|| self.out.display().to_string())?;
        output::line(format_args!(
            "{}: {:.1} % of the pixels are known, from viewpoints {:?}",
            self.out.display(),
            100.0 * reply.covered,
            reply.viewpoints_used
        ))
    }
}
