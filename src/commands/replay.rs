//! `surprised replay`: a recording published as a robot would, frame by frame, with its own stamps.

use std::{
    ffi::OsStr,
    path::{Path, PathBuf},
    time::Duration,
};

use anyhow::{Context, ensure};
use tokio::time::Instant;

use super::output;
use crate::{
    dataset::Recording,
    service::{
        robot::{Answer, PictureFile, Robot},
        session::ZenohOptions,
    },
    wire::{
        keys::{self, CameraPath, is_id},
        proto,
    },
};

/// To find a service, and to hear about a frame. Far longer than any frame takes.
const PATIENCE: Duration = Duration::from_secs(10);
/// To hear from the service that writes the place when one that only reads it has refused the frame.
const WRITER_PATIENCE: Duration = Duration::from_secs(1);
const RATE_MIN_HZ: f64 = 0.01;
const RATE_MAX_HZ: f64 = 1000.0;

/// Publishes a recording as a robot would
#[derive(Debug, clap::Args)]
pub struct Replay {
    /// The recording: a folder with rgb.txt, depth.txt, groundtruth.txt and calibration.txt.
    folder: PathBuf,
    /// The place it was recorded in.
    #[arg(long, value_parser = id)]
    place: String,
    #[arg(long, value_parser = id)]
    robot: String,
    #[arg(long, value_parser = id, default_value = "front")]
    camera: String,
    /// Frames per second; as they were recorded if not given.
    #[arg(long, value_parser = rate, conflicts_with = "lockstep")]
    rate: Option<f64>,
    /// Wait for the report on each frame before the next, so that none is left out.
    #[arg(long)]
    lockstep: bool,
    /// The Zenoh key below which everything is.
    #[arg(long, value_name = "KEY", default_value = "surprised")]
    root: String,
    #[command(flatten)]
    zenoh: ZenohOptions,
}

/// A name that can be a chunk of a key.
pub fn id(text: &str) -> Result<String, String> {
    if is_id(text) {
        Ok(text.to_owned())
    } else {
        Err("names are made of a-z, 0-9, _ and -".to_owned())
    }
}

fn rate(text: &str) -> Result<f64, String> {
    text.parse()
        .ok()
        .filter(|rate| (RATE_MIN_HZ..=RATE_MAX_HZ).contains(rate))
        .ok_or_else(|| {
            format!("a rate lies between {RATE_MIN_HZ} and {RATE_MAX_HZ} frames per second")
        })
}

/// The image's file as it is, if the wire has its format.
fn picture_file(path: &Path) -> anyhow::Result<Option<PictureFile>> {
    let encoding = match path.extension().and_then(OsStr::to_str) {
        Some("jpg" | "jpeg") => "jpeg",
        Some("png") => "png",
        _ => return Ok(None),
    };
    let bytes = std::fs::read(path).with_context(|| format!("reading {}", path.display()))?;
    Ok(Some(PictureFile { encoding, bytes }))
}

/// What came of the frames.
#[derive(Debug, Default)]
struct Tally {
    frames: usize,
    reports: usize,
    refused: usize,
    unanswered: usize,
    regions: usize,
    surprising: usize,
}

impl Tally {
    fn take(&mut self, answer: &Answer) -> anyhow::Result<()> {
        match answer {
            Answer::Report(report) => {
                self.reports += 1;
                self.regions += report.regions.len();
                self.surprising += usize::from(!report.regions.is_empty());
                for region in &report.regions {
                    output::line(region_line(report.sequence, region))?;
                }
            }
            Answer::Rejected(rejection) => {
                self.refused += 1;
                eprintln!(
                    "frame {} refused ({}): {}",
                    rejection.sequence, rejection.code, rejection.detail
                );
            }
        }
        Ok(())
    }

    /// Waits for what the service says about a frame, and says so where it says nothing.
    async fn hear_about(&mut self, robot: &mut Robot, sequence: u64) -> anyhow::Result<()> {
        let mut end = Instant::now() + PATIENCE;
        let mut is_answered = false;
        while let Some(answer) = robot.answer(end - Instant::now()).await {
            self.take(&answer)?;
            if answer.sequence() != sequence {
                continue;
            }
            if !answer.is_of_a_reader() {
                return Ok(());
            }
            is_answered = true;
            end = end.min(Instant::now() + WRITER_PATIENCE);
        }
        if !is_answered {
            self.unanswered += 1;
            eprintln!("frame {sequence}: neither a report nor a rejection within {PATIENCE:?}");
        }
        Ok(())
    }
}

impl std::fmt::Display for Tally {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "{} frames, {} reports, {} refused; {} regions in {} frames",
            self.frames, self.reports, self.refused, self.regions, self.surprising
        )
    }
}

fn region_line(sequence: u64, region: &proto::Region) -> String {
    let pixels = region.r#box.unwrap_or_default();
    let center = region.center_in_world.map_or_else(String::new, |p| {
        format!(", at {:.2} {:.2} {:.2} m", p.x, p.y, p.z)
    });
    format!(
        "frame {sequence} surprised at x {}..{}, y {}..{}: {:.1} nats{center}",
        pixels.x_min, pixels.x_max, pixels.y_min, pixels.y_max, region.peak_surprise
    )
}

impl Replay {
    /// # Errors
    /// A recording that cannot be read, no service, and frames that got no answer.
    pub async fn run(self) -> anyhow::Result<()> {
        let recording = Recording::open(&self.folder)?;
        let path =
            CameraPath::new(&self.place, &self.robot, &self.camera).context("a name is no id")?;
        let mut robot = Robot::connect(&self.zenoh, &self.root, &path).await?;
        ensure!(
            robot.wait_for_service(PATIENCE).await?,
            "nobody takes frames at {}: is `surprised serve` running, with this --root, and does -e lead to it?",
            path.key(&self.root, keys::FRAME)
        );
        let mut tally = Tally::default();
        let started = Instant::now();
        for (index, entry) in recording.entries.iter().enumerate() {
            let frame = recording.frame(index, &path.source)?;
            let file = picture_file(&entry.image)?;
            if !self.lockstep {
                let due_s = match self.rate {
                    Some(rate) => index as f64 / rate,
                    None => entry.stamp_s - recording.entries[0].stamp_s,
                };
                let due = started + Duration::from_secs_f64(due_s);
                while let Some(answer) = robot.answer(due - Instant::now()).await {
                    tally.take(&answer)?;
                }
            }
            robot.publish(&frame, file).await?;
            tally.frames += 1;
            // The newest frame always gets its turn: when the last is answered, no more answers come.
            if self.lockstep || tally.frames == recording.entries.len() {
                tally.hear_about(&mut robot, frame.sequence).await?;
            }
        }
        output::line(&tally)?;
        if recording.skipped > 0 {
            eprintln!(
                "{} images without depth or pose were left out",
                recording.skipped
            );
        }
        ensure!(
            tally.unanswered == 0,
            "{} frames got no answer",
            tally.unanswered
        );
        Ok(())
    }
}
