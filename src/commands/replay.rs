//! `surprised replay`: a recording published as a robot would, frame by frame, with its own stamps.

use std::{
    ffi::OsStr,
    path::{Path, PathBuf},
    time::Duration,
};

use anyhow::{Context, anyhow, bail};
use tokio::time::{Instant, sleep_until};

use crate::{
    dataset::Recording,
    model::frame::Source,
    service::robot::{Answer, PictureFile, Robot},
    wire::{keys::CameraPath, proto},
};

/// To find a service, and to hear about a frame. Far longer than any frame takes.
const PATIENCE: Duration = Duration::from_secs(10);

#[derive(Debug, clap::Args)]
pub struct Arguments {
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
    fn take(&mut self, answer: Answer) {
        match answer {
            Answer::Report(report) => {
                self.reports += 1;
                self.regions += report.regions.len();
                self.surprising += usize::from(!report.regions.is_empty());
                report.regions.iter().for_each(|region| print(&report, region));
            }
            Answer::Rejected(rejection) => {
                self.refused += 1;
                eprintln!(
                    "frame {} refused ({}): {}",
                    rejection.sequence, rejection.code, rejection.detail
                );
            }
        }
    }
}

fn print(report: &proto::SurpriseReport, region: &proto::Region) {
    let Some(pixels) = region.r#box else { return };
    let place = region
        .center_in_world
        .as_ref()
        .map_or_else(String::new, |p| format!(", at {:.2} {:.2} {:.2} m", p.x, p.y, p.z));
    println!(
        "frame {} surprised: x {}..{}, y {}..{}, {:.1} nats{place}",
        report.sequence,
        pixels.x_min,
        pixels.x_max,
        pixels.y_min,
        pixels.y_max,
        region.peak_surprise
    );
}

/// # Errors
/// A recording that cannot be read, no service, and in lockstep frames that got no answer.
pub async fn run(arguments: Arguments) -> anyhow::Result<()> {
    let recording = Recording::open(&arguments.folder)?;
    let path = CameraPath::new(&arguments.place, &arguments.robot, &arguments.camera)
        .expect("clap checked the names");
    let session = session::open(&arguments.zenoh).await?;
    let mut robot = Robot::join(&session, &arguments.root, &path)
        .await
        .map_err(|error| anyhow!(error))?;
    if !robot.wait_for_service(PATIENCE).await.map_err(|error| anyhow!(error))? {
        bail!(
            "nobody takes frames at {}: is `surprised serve` running, and reached by -e?",
            path.key(&arguments.root, keys::FRAME)
        );
    }
    let mut tally = Tally::default();
    let started = Instant::now();
    for (index, entry) in recording.entries.iter().enumerate() {
        if !arguments.lockstep {
            let due_s = match arguments.rate {
                Some(rate) => index as f64 / rate,
                None => entry.stamp_s - recording.entries[0].stamp_s,
            };
            let due = started + Duration::from_secs_f64(due_s);
            while let Some(left) = due.checked_duration_since(Instant::now()) {
                if let Some(answer) = robot.answer(left).await {
                    tally.take(answer);
                }
            }
        }
        let frame = recording.frame(index, &path.source)?;
        robot.publish(&frame, picture_file(&entry.image)?).await.map_err(|error| anyhow!(error))?;
        tally.frames += 1;
        if arguments.lockstep {
            tally.hear_about(&mut robot, frame.sequence).await;
        }
    }
    if !arguments.lockstep && let Some(last) = tally.frames.checked_sub(1) {
        // The newest frame is never left out, so its answer is the last.
        tally.hear_about(&mut robot, last as u64).await;
    }
    println!("{tally}");
    Ok(())
}
