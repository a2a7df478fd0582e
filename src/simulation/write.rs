//! Writes a script as a recording in TUM RGB-D layout with phases and masks.
//!
//! ```text
//! rgb/<t>.jpg  depth/<t>.png (16 bit, metres * 5000, 0 = none)  mask/<item>/<t>.png (0 or 255)
//! ignore/<t>.png (255: shade, mirror image or refraction of what comes and goes, or a person)
//! rgb.txt  depth.txt  groundtruth.txt (t tx ty tz qx qy qz qw, world_from_camera)  calibration.txt  phases.csv
//! ```

use std::{
    fs::{self, File},
    io::{BufWriter, Write},
    ops::Range,
    path::{Path, PathBuf},
};

use image::{ExtendedColorType, ImageEncoder, codecs::jpeg::JpegEncoder, codecs::png::PngEncoder};

use super::script::{Capture, Script, Views};
use crate::{
    isa::Isa,
    model::pose::Pose,
    stages::depth::{InverseDepthRange, SidesDepth},
};

pub const DEPTH_UNITS_PER_METRE: f32 = 5000.0;

/// What poses and depth are written.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Truth {
    /// As the robot has them: pose from the tracked LEDs, depth as measured. Frames whose LEDs do not give a pose are
    /// left out, as a robot would have to.
    Measured,
    /// As a robot without a depth camera: the same pose, depth from its three cameras among these hypotheses.
    Computed(InverseDepthRange),
    /// As they are; depth to the first surface, glass included.
    Exact,
}

#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    pub station: usize,
    /// From 0; every `step`-th of them is written.
    pub frames: Range<u64>,
    pub step: u64,
    pub truth: Truth,
    /// 1 to 100.
    pub jpeg_quality: u8,
}

impl Options {
    /// The whole script as its first robot has it; of an endless one, `at_most` frames.
    pub fn whole(script: &Script, at_most: u64) -> Self {
        Self {
            station: 0,
            frames: 0..script.frames.unwrap_or(at_most).min(at_most),
            step: 1,
            truth: Truth::Measured,
            jpeg_quality: 92,
        }
    }
}

#[derive(Debug, thiserror::Error)]
pub enum WriteError {
    #[error("cannot write {}: {source}", path.display())]
    Io {
        path: PathBuf,
        source: std::io::Error,
    },
    #[error("cannot encode {}: {source}", path.display())]
    Encode {
        path: PathBuf,
        source: image::ImageError,
    },
    #[error("the script has {stations} stations, there is no number {station}")]
    NoStation { station: usize, stations: usize },
    #[error("every 0th frame was asked for: the step must be 1 or more")]
    Step,
}

/// What was written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Summary {
    pub frames: u64,
    /// Left out because the LEDs gave no pose.
    pub without_pose: u64,
}

/// Writes a recording into `dir`, which is made if need be; files of the same names are replaced.
pub fn recording(dir: &Path, script: &Script, options: &Options) -> Result<Summary, WriteError> {
    if options.step == 0 {
        return Err(WriteError::Step);
    }
    let Some(station) = script.stations.get(options.station) else {
        return Err(WriteError::NoStation {
            station: options.station,
            stations: script.stations.len(),
        });
    };
    let names: Vec<_> = script.story.items.iter().map(|item| item.name).collect();
    for folder in ["rgb".into(), "depth".into(), "ignore".into()]
        .into_iter()
        .chain(names.iter().map(|name| format!("mask/{name}")))
    {
        let path = dir.join(folder);
        fs::create_dir_all(&path).map_err(|source| WriteError::Io { path, source })?;
    }
    let camera = &station.rig.intrinsics;
    let mut calibration = List::create(dir, "calibration.txt", "# fx fy cx cy")?;
    calibration.line(&format!(
        "{} {} {} {}",
        camera.fx, camera.fy, camera.cx, camera.cy
    ))?;
    calibration.finish()?;
    let mut rgb = List::create(dir, "rgb.txt", "# timestamp filename")?;
    let mut depth = List::create(dir, "depth.txt", "# timestamp filename")?;
    let mut poses = List::create(dir, "groundtruth.txt", "# timestamp tx ty tz qx qy qz qw")?;
    let mut phases = List::create(
        dir,
        "phases.csv",
        "# timestamp,phase,pass,present,evaluated",
    )?;

    let mut summary = Summary {
        frames: 0,
        without_pose: 0,
    };
    let (views, mut computed) = match options.truth {
        Truth::Computed(range) => (Views::Triple, Some(SidesDepth::new(range, Isa::detect()))),
        Truth::Measured | Truth::Exact => (Views::Middle, None),
    };
    for frame in options.frames.clone().step_by(options.step as usize) {
        let capture = script.capture(options.station, frame, views);
        let world_from_camera = if options.truth == Truth::Exact {
            capture.world_from_camera
        } else if let Ok((world_from_camera, _)) = script.localised(options.station, &capture) {
            world_from_camera
        } else {
            summary.without_pose += 1;
            continue;
        };
        let sides = script.sides(options.station, &capture);
        let depth_m = match (&mut computed, &sides) {
            (Some(computed), Some(sides)) => {
                let image = &capture.middle.image;
                &computed.compute(camera, image, sides, None).depth_m
            }
            _ if options.truth == Truth::Exact => &capture.middle.depth_m,
            _ => &capture.depth_m,
        };
        let stamp = stamp_text(capture.stamp_ns);
        write_images(dir, &stamp, &capture, depth_m, &names, options.jpeg_quality)?;
        let touched = script.touched(options.station, &capture);
        write_grey(
            dir.join(format!("ignore/{stamp}.png")),
            &around_items(touched, &capture.middle.masks),
            (camera.width, camera.height),
        )?;
        rgb.line(&format!("{stamp} rgb/{stamp}.jpg"))?;
        depth.line(&format!("{stamp} depth/{stamp}.png"))?;
        poses.line(&format!("{stamp} {}", pose_text(&world_from_camera)))?;
        let moment = &capture.moment;
        phases.line(&format!(
            "{stamp},{},{},{},{}",
            moment.phase,
            capture.direction(),
            script.present(moment),
            moment.evaluated.map_or("", |item| names[item]),
        ))?;
        summary.frames += 1;
    }
    for list in [rgb, depth, poses, phases] {
        list.finish()?;
    }
    Ok(summary)
}

/// Seconds with six decimals, as file names and lists have them.
pub fn stamp_text(stamp_ns: i64) -> String {
    let micros = (stamp_ns + 500) / 1000;
    format!("{}.{:06}", micros / 1_000_000, micros % 1_000_000)
}

fn pose_text(pose: &Pose) -> String {
    let t = pose.translation.vector;
    let q = pose.rotation.coords;
    format!(
        "{:.6} {:.6} {:.6} {:.7} {:.7} {:.7} {:.7}",
        t.x, t.y, t.z, q.x, q.y, q.z, q.w
    )
}

fn write_images(
    dir: &Path,
    stamp: &str,
    capture: &Capture,
    depth_m: &[f32],
    names: &[&str],
    jpeg_quality: u8,
) -> Result<(), WriteError> {
    let image = &capture.middle.image;
    let (width, height) = (image.width as u32, image.height as u32);
    encode(dir.join(format!("rgb/{stamp}.jpg")), |file| {
        JpegEncoder::new_with_quality(file, jpeg_quality).write_image(
            &image.data,
            width,
            height,
            ExtendedColorType::Rgb8,
        )
    })?;
    let depth: Vec<u8> = depth_m
        .iter()
        // The cast saturates; beyond 13.1 m there is nothing in the room.
        .flat_map(|&z| ((z * DEPTH_UNITS_PER_METRE).round() as u16).to_ne_bytes())
        .collect();
    encode(dir.join(format!("depth/{stamp}.png")), |file| {
        PngEncoder::new(file).write_image(&depth, width, height, ExtendedColorType::L16)
    })?;
    for (name, mask) in names.iter().zip(&capture.middle.masks) {
        let path = dir.join(format!("mask/{name}/{stamp}.png"));
        write_grey(path, mask, (image.width, image.height))?;
    }
    Ok(())
}

/// What is touched but part of no item.
fn around_items(mut touched: Vec<u8>, masks: &[Vec<u8>]) -> Vec<u8> {
    for mask in masks {
        for (touched, &item) in touched.iter_mut().zip(mask) {
            *touched &= !item;
        }
    }
    touched
}

fn write_grey(
    path: PathBuf,
    values: &[u8],
    (width, height): (usize, usize),
) -> Result<(), WriteError> {
    encode(path, |file| {
        let (width, height) = (width as u32, height as u32);
        PngEncoder::new(file).write_image(values, width, height, ExtendedColorType::L8)
    })
}

fn encode(
    path: PathBuf,
    write: impl FnOnce(&mut BufWriter<File>) -> image::ImageResult<()>,
) -> Result<(), WriteError> {
    let file = match File::create(&path) {
        Ok(file) => file,
        Err(source) => return Err(WriteError::Io { path, source }),
    };
    let mut file = BufWriter::new(file);
    if let Err(source) = write(&mut file) {
        return Err(WriteError::Encode { path, source });
    }
    file.flush()
        .map_err(|source| WriteError::Io { path, source })
}

/// A text file, line by line.
struct List {
    path: PathBuf,
    file: BufWriter<File>,
}

impl List {
    fn create(dir: &Path, name: &str, head: &str) -> Result<Self, WriteError> {
        let path = dir.join(name);
        match File::create(&path) {
            Ok(file) => {
                let mut list = Self {
                    path,
                    file: BufWriter::new(file),
                };
                list.line(head)?;
                Ok(list)
            }
            Err(source) => Err(WriteError::Io { path, source }),
        }
    }

    fn line(&mut self, text: &str) -> Result<(), WriteError> {
        writeln!(self.file, "{text}").map_err(|source| WriteError::Io {
            path: self.path.clone(),
            source,
        })
    }

    fn finish(mut self) -> Result<(), WriteError> {
        self.file.flush().map_err(|source| WriteError::Io {
            path: self.path,
            source,
        })
    }
}
