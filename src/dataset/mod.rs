//! Recordings on disk in TUM RGB-D layout, and the truth that some of them carry.
//!
//! A folder with `rgb.txt`, `depth.txt`, `groundtruth.txt` and `calibration.txt` is one recording; a folder of such
//! folders holds runs of one place, in the order of their names. Stamps are seconds; depth is 16 bit, metres * 5000,
//! 0 = none; poses are `t tx ty tz qx qy qz qw`, world_from_camera.

mod list;

pub mod truth;

use std::path::{Path, PathBuf};

use crate::model::{
    camera::Intrinsics,
    frame::{DepthSource, Frame, RgbImage, Source},
    pose::Pose,
};

use list::Stamped;
use truth::Truth;

/// Image and depth of one frame are at most this far apart, seconds: half the period of a 30 Hz sensor, as TUM's own
/// tools take it.
const IMAGE_TOLERANCE_S: f64 = 0.02;
/// Between two poses at most this far apart a pose is interpolated, seconds.
const POSE_GAP_S: f64 = 0.25;
/// Depth steps per metre.
const DEPTH_SCALE: f32 = 5000.0;

/// One camera's way through a place.
#[derive(Debug, Clone)]
pub struct Recording {
    /// The folder's own name.
    pub name: String,
    pub intrinsics: Intrinsics,
    pub entries: Vec<Entry>,
    /// Images without depth or pose near their stamp.
    pub skipped: usize,
    pub truth: Truth,
}

/// A frame that is still on disk.
#[derive(Debug, Clone)]
pub struct Entry {
    pub stamp_s: f64,
    pub image: PathBuf,
    pub depth: PathBuf,
    pub world_from_camera: Pose,
}

impl Entry {
    pub fn stamp_ns(&self) -> i64 {
        (self.stamp_s * 1e9).round() as i64
    }
}

#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    #[error("cannot read {path}: {source}; {hint}")]
    Read {
        path: PathBuf,
        source: std::io::Error,
        hint: &'static str,
    },
    #[error("{path}, line {line}: {problem}")]
    Line {
        path: PathBuf,
        line: usize,
        problem: String,
    },
    #[error(
        "cannot decode {path}: {source}; write the file again or remove its line from the list"
    )]
    Decode {
        path: PathBuf,
        source: image::ImageError,
    },
    #[error("{path} has {got}, but {expected} is expected; {hint}")]
    Content {
        path: PathBuf,
        got: String,
        expected: String,
        hint: &'static str,
    },
    #[error("cannot parse {path}: {source}; it maps viewpoints to lists of boxes")]
    Boxes {
        path: PathBuf,
        source: serde_json::Error,
    },
}

/// The recordings of a folder: itself, or the runs in it.
///
/// # Errors
/// What cannot be read, with file and line.
pub fn open(folder: &Path) -> Result<Vec<Recording>, DatasetError> {
    if folder.join("rgb.txt").is_file() {
        return Ok(vec![Recording::open(folder)?]);
    }
    let read_error = |source| DatasetError::Read {
        path: folder.to_owned(),
        source,
        hint: "give the folder that holds rgb.txt, or one with such folders in it",
    };
    let mut runs = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(read_error)? {
        let path = entry.map_err(read_error)?.path();
        if path.join("rgb.txt").is_file() {
            runs.push(path);
        }
    }
    if runs.is_empty() {
        return Err(read_error(std::io::Error::new(
            std::io::ErrorKind::NotFound,
            "neither rgb.txt nor folders with one are in it",
        )));
    }
    runs.sort();
    let mut recordings = runs
        .iter()
        .map(|run| Recording::open(run))
        .collect::<Result<Vec<_>, _>>()?;
    truth::add_boxes(folder, &mut recordings)?;
    Ok(recordings)
}

impl Recording {
    /// # Errors
    /// What cannot be read, with file and line; a recording in which no image has both depth and pose.
    pub fn open(folder: &Path) -> Result<Self, DatasetError> {
        let images = list::files(&folder.join("rgb.txt"))?;
        let depths = list::files(&folder.join("depth.txt"))?;
        let poses_path = folder.join("groundtruth.txt");
        let poses = list::poses(&poses_path)?;
        let mut entries = Vec::with_capacity(images.len());
        let total = images.len();
        for image in images {
            let depth = nearest(&depths, image.stamp_s, IMAGE_TOLERANCE_S);
            let pose = pose_at(&poses, image.stamp_s);
            if let (Some(depth), Some(world_from_camera)) = (depth, pose) {
                entries.push(Entry {
                    stamp_s: image.stamp_s,
                    image: folder.join(&image.value),
                    depth: folder.join(&depth.value),
                    world_from_camera,
                });
            }
        }
        let Some(first) = entries.first() else {
            return Err(DatasetError::Content {
                path: poses_path,
                got: format!(
                    "no pose and depth.txt no image for any of the {total} stamps of rgb.txt"
                ),
                expected: format!(
                    "a pose around and a depth image within {IMAGE_TOLERANCE_S} s of each"
                ),
                hint: "are all three on the same clock, in seconds?",
            });
        };
        let (width, height) = image::image_dimensions(&first.image)
            .map_err(|source| decode_error(&first.image, source))?;
        let intrinsics = list::calibration(
            &folder.join("calibration.txt"),
            width as usize,
            height as usize,
        )?;
        let name = folder
            .file_name()
            .map(|name| name.to_string_lossy().into_owned())
            .unwrap_or_default();
        let truth = Truth::open(folder, &entries)?;
        Ok(Self {
            name,
            intrinsics,
            skipped: total - entries.len(),
            entries,
            truth,
        })
    }

    /// Decodes a frame; `sequence` is its index.
    ///
    /// # Errors
    /// Files that cannot be read or are no 8-bit image and 16-bit depth of the recording's size.
    pub fn frame(&self, index: usize, source: &Source) -> Result<Frame, DatasetError> {
        let entry = &self.entries[index];
        let decoded =
            image::open(&entry.image).map_err(|error| decode_error(&entry.image, error))?;
        let rgb = decoded.into_rgb8();
        self.check_size(&entry.image, rgb.dimensions())?;
        let decoded =
            image::open(&entry.depth).map_err(|error| decode_error(&entry.depth, error))?;
        let image::DynamicImage::ImageLuma16(depth) = decoded else {
            return Err(DatasetError::Content {
                path: entry.depth.clone(),
                got: format!("{:?} pixels", decoded.color()),
                expected: "16-bit grey".to_owned(),
                hint: "depth counts 1/5000 metres",
            });
        };
        self.check_size(&entry.depth, depth.dimensions())?;
        Ok(Frame {
            source: source.clone(),
            stamp_ns: entry.stamp_ns(),
            sequence: index as u64,
            image: RgbImage {
                width: self.intrinsics.width,
                height: self.intrinsics.height,
                data: rgb.into_raw(),
            },
            depth: DepthSource::Given(
                depth
                    .into_raw()
                    .into_iter()
                    .map(|steps| f32::from(steps) / DEPTH_SCALE)
                    .collect(),
            ),
            intrinsics: self.intrinsics,
            world_from_camera: entry.world_from_camera,
            pose_noise: None,
        })
    }

    fn check_size(&self, path: &Path, size: (u32, u32)) -> Result<(), DatasetError> {
        let Intrinsics { width, height, .. } = self.intrinsics;
        if size == (width as u32, height as u32) {
            return Ok(());
        }
        Err(DatasetError::Content {
            path: path.to_owned(),
            got: format!("{}x{} pixels", size.0, size.1),
            expected: format!("{width}x{height} as the first image"),
            hint: "a recording has one calibration and so one size; register depth to the image",
        })
    }
}

fn decode_error(path: &Path, source: image::ImageError) -> DatasetError {
    match source {
        image::ImageError::IoError(source) => DatasetError::Read {
            path: path.to_owned(),
            source,
            hint: "the list names it: copy it or remove its line",
        },
        source => DatasetError::Decode {
            path: path.to_owned(),
            source,
        },
    }
}

/// The nearest in time, if it is near enough. `stamped` is sorted.
fn nearest<T>(stamped: &[Stamped<T>], stamp_s: f64, tolerance_s: f64) -> Option<&Stamped<T>> {
    let after = stamped.partition_point(|other| other.stamp_s < stamp_s);
    let distance_s = |other: &&Stamped<T>| (other.stamp_s - stamp_s).abs();
    stamped[after.saturating_sub(1)..(after + 1).min(stamped.len())]
        .iter()
        .min_by(|a, b| distance_s(a).total_cmp(&distance_s(b)))
        .filter(|other| distance_s(other) <= tolerance_s)
}

/// Interpolated between the poses before and after where those are close; else the nearest, as close as an image.
fn pose_at(poses: &[Stamped<Pose>], stamp_s: f64) -> Option<Pose> {
    let after = poses.partition_point(|pose| pose.stamp_s < stamp_s);
    if let (Some(before), Some(after)) = (
        after.checked_sub(1).and_then(|before| poses.get(before)),
        poses.get(after),
    ) {
        let gap_s = after.stamp_s - before.stamp_s;
        if gap_s <= POSE_GAP_S {
            let share = (stamp_s - before.stamp_s) / gap_s;
            return before
                .value
                .try_lerp_slerp(&after.value, share, f64::EPSILON);
        }
    }
    nearest(poses, stamp_s, IMAGE_TOLERANCE_S).map(|pose| pose.value)
}
