//! `surprised query`: asks a service's memory.

use std::{path::PathBuf, str::FromStr};

use anyhow::{Context, bail};
use clap::{Subcommand, ValueEnum};

use crate::{
    config::ConfigError,
    service::{client, session::ZenohOptions},
    wire::{decode, keys, picture, proto},
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
    /// The viewpoints of a place, as JSON
    Views(Place),
    /// What the service says about a place, as JSON
    Status(Place),
}

#[derive(Debug, clap::Args)]
struct Place {
    /// The place asked about.
    #[arg(long)]
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
    #[arg(long, value_name = "X,Y,Z,QX,QY,QZ,QW", allow_hyphen_values = true)]
    pose: Numbers<7>,
    /// Of the imagined camera, in pixels.
    #[arg(long, value_name = "FX,FY,CX,CY,WIDTH,HEIGHT")]
    intrinsics: Numbers<6>,
    /// What to show.
    #[arg(long, value_enum, default_value_t = Plane::Expected)]
    plane: Plane,
    /// Where to write the PNG.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
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
            Question::Views(place) => print(&place.ask("views", "format=json").await?),
            Question::Status(place) => print(&place.ask("status", "").await?),
        }
    }
}

fn print(json: &[u8]) -> anyhow::Result<()> {
    let value: serde_json::Value = serde_json::from_slice(json)?;
    println!("{}", serde_json::to_string_pretty(&value)?);
    Ok(())
}

impl Place {
    async fn ask(&self, question: &str, parameters: &str) -> anyhow::Result<Vec<u8>> {
        if !keys::is_root(&self.root) {
            return Err(ConfigError::Root(self.root.clone()).into());
        }
        if !keys::is_id(&self.place) {
            bail!("--place {}: a place is [a-z0-9_-]+", self.place);
        }
        let key = keys::memory(&self.root, &self.place, question);
        let answers = client::ask(&self.zenoh, &format!("{key}?{parameters}")).await?;
        answers
            .into_iter()
            .next()
            .map(|(_, answer)| answer)
            .context("the service's answer is empty")
    }
}

impl Prior {
    async fn run(self) -> anyhow::Result<()> {
        let plane = match self.plane {
            Plane::Expected => "expected",
            Plane::Uncertainty => "uncertainty",
            Plane::Coverage => "coverage",
            Plane::Depth => "depth",
        };
        let names = [
            "x", "y", "z", "qx", "qy", "qz", "qw", "fx", "fy", "cx", "cy", "width", "height",
        ];
        let mut parameters = format!("planes={plane}");
        for (name, value) in names
            .iter()
            .zip(self.pose.0.iter().chain(&self.intrinsics.0))
        {
            parameters += &format!(";{name}={value}");
        }
        let answer = self.place.ask("prior", &parameters).await?;
        let reply: proto::PriorReply = decode::message(&answer)?;
        let png = match self.plane {
            Plane::Expected => reply.expected.context("the reply has no image")?.data,
            Plane::Uncertainty => shown(reply.uncertainty, |bytes| float(bytes).sqrt() / 60.0)?,
            Plane::Coverage => shown(reply.coverage, |bytes| f32::from(bytes[0]) / 7.0)?,
            Plane::Depth => shown(reply.depth, |bytes| float(bytes) / 10.0)?,
        };
        std::fs::write(&self.out, png).with_context(|| self.out.display().to_string())?;
        println!(
            "{}: {:.1} % of the pixels are known, from viewpoints {:?}",
            self.out.display(),
            100.0 * reply.covered,
            reply.viewpoints_used
        );
        Ok(())
    }
}

fn float(bytes: &[u8]) -> f32 {
    <[u8; 4]>::try_from(bytes).map_or(0.0, f32::from_le_bytes)
}

/// A plane as a PNG; `share` of white from a pixel's bytes.
fn shown(image: Option<proto::Image>, share: impl Fn(&[u8]) -> f32) -> anyhow::Result<Vec<u8>> {
    let image = image.context("the reply has no such plane")?;
    let (width, height) = (image.width as usize, image.height as usize);
    let bytes_per_pixel = image.data.len() / (width * height).max(1);
    if bytes_per_pixel == 0 {
        bail!("the reply's plane is empty");
    }
    let values: Vec<f32> = image
        .data
        .chunks_exact(bytes_per_pixel)
        .map(share)
        .collect();
    Ok(picture::png(&picture::heat(width, height, &values, 1.0)))
}
