//! What is known about a recording: the phases of its experiment, where objects are, which way the camera went.
//!
//! `phases.csv`: time, phase, pass, objects present (`a+b`), object evaluated. `mask/<object>/<t>.png`: over 127 inside
//! the silhouette, also where an absent object would stand. `ignore/<t>.png`: over 127 where nothing is judged, as an
//! object's shade or a passer-by. `passes.csv`: time, pass. `boxes.json`, beside runs: per run and viewpoint what differs
//! from the first run.

use std::{
    collections::HashMap,
    path::{Path, PathBuf},
};

use serde::Deserialize;

use crate::model::report::PixelBox;

use super::{DatasetError, Entry, Recording, decode_error, list};

/// Stamps in truth files name frames, so they agree but for rounding, seconds.
const SAME_STAMP_S: f64 = 1e-4;

#[derive(Debug, Clone, Default)]
pub struct Truth {
    /// One for each entry of the recording, or none at all. From `phases.csv` or, with an empty phase, `passes.csv`.
    pub moments: Vec<Moment>,
    /// Masks by object, one for each entry of the recording, `None` where the object is out of view.
    masks: HashMap<String, Vec<Option<PathBuf>>>,
    /// Where nothing is judged: one for each entry, `None` where everything is, or none at all.
    ignored: Vec<Option<PathBuf>>,
    /// One list for each entry, or none at all.
    pub boxes: Vec<Vec<TruthBox>>,
}

/// Where in the experiment a frame lies.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Moment {
    pub phase: String,
    pub pass: String,
    pub present: Vec<String>,
    pub evaluated: Option<String>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ChangeKind {
    Added,
    Removed,
    Furniture,
}

/// What differs from the first run, drawn by hand.
#[derive(Debug, Clone, Deserialize)]
pub struct TruthBox {
    #[serde(rename = "box")]
    corners: [u32; 4],
    pub kind: ChangeKind,
    #[serde(default)]
    pub label: String,
    /// It was not there in the run before.
    #[serde(default)]
    pub new_since_previous: bool,
    /// Small or incidental.
    #[serde(default)]
    pub minor: bool,
}

impl TruthBox {
    pub fn pixel_box(&self) -> PixelBox {
        let [x_min, y_min, x_max, y_max] = self.corners;
        PixelBox {
            x_min,
            y_min,
            x_max,
            y_max,
        }
    }
}

impl Truth {
    /// Whatever there is; no truth at all is fine.
    pub(super) fn open(folder: &Path, entries: &[Entry]) -> Result<Self, DatasetError> {
        let moments = if folder.join("phases.csv").is_file() {
            moments(&folder.join("phases.csv"), entries, 5, |fields| Moment {
                phase: fields[1].to_owned(),
                pass: fields[2].to_owned(),
                present: fields[3]
                    .split('+')
                    .filter(|name| !name.is_empty())
                    .map(str::to_owned)
                    .collect(),
                evaluated: (!fields[4].is_empty()).then(|| fields[4].to_owned()),
            })?
        } else if folder.join("passes.csv").is_file() {
            let mut passes = moments(&folder.join("passes.csv"), entries, 2, |fields| Moment {
                pass: fields[1].to_owned(),
                ..Moment::default()
            })?;
            split_at_turns(&mut passes, entries);
            passes
        } else {
            Vec::new()
        };
        Ok(Self {
            moments,
            masks: masks(&folder.join("mask"), entries)?,
            ignored: of_entries(&folder.join("ignore"), entries),
            boxes: Vec::new(),
        })
    }

    /// Names of the objects with masks, sorted.
    pub fn objects(&self) -> Vec<&str> {
        let mut names: Vec<&str> = self.masks.keys().map(String::as_str).collect();
        names.sort_unstable();
        names
    }

    /// Inside the object's silhouette or not, a value a pixel; `None` if the object is out of view.
    ///
    /// # Errors
    /// A mask that cannot be read or has another size.
    pub fn mask(
        &self,
        object: &str,
        index: usize,
        (width, height): (usize, usize),
    ) -> Result<Option<Vec<bool>>, DatasetError> {
        let Some(Some(path)) = self.masks.get(object).and_then(|paths| paths.get(index)) else {
            return Ok(None);
        };
        let inside = read_mask(path, (width, height))?;
        Ok(inside.contains(&true).then_some(inside))
    }

    /// Where nothing is judged, a value a pixel; `None` if everything is.
    ///
    /// # Errors
    /// As [`Self::mask`].
    pub fn ignored(
        &self,
        index: usize,
        size: (usize, usize),
    ) -> Result<Option<Vec<bool>>, DatasetError> {
        match self.ignored.get(index) {
            Some(Some(path)) => read_mask(path, size).map(Some),
            _ => Ok(None),
        }
    }
}

fn read_mask(path: &Path, (width, height): (usize, usize)) -> Result<Vec<bool>, DatasetError> {
    let mask = image::open(path)
        .map_err(|source| decode_error(path, source))?
        .into_luma8();
    if mask.dimensions() != (width as u32, height as u32) {
        return Err(DatasetError::Content {
            path: path.to_owned(),
            got: format!("{}x{} pixels", mask.width(), mask.height()),
            expected: format!("{width}x{height} as the images"),
            hint: "draw masks on the images themselves",
        });
    }
    Ok(mask
        .into_raw()
        .into_iter()
        .map(|value| value > 127)
        .collect())
}

/// The pictures of a folder that have the names of the images they belong to, one for each entry.
fn of_entries(folder: &Path, entries: &[Entry]) -> Vec<Option<PathBuf>> {
    entries
        .iter()
        .map(|entry| {
            let name = entry.image.file_stem()?;
            let path = folder.join(name).with_added_extension("png");
            path.is_file().then_some(path)
        })
        .collect()
}

/// One for each entry, found by its stamp.
fn moments(
    path: &Path,
    entries: &[Entry],
    columns: usize,
    moment: impl Fn(&[&str]) -> Moment,
) -> Result<Vec<Moment>, DatasetError> {
    let mut stamped = Vec::new();
    let lines = list::lines(path, "it should be readable text")?;
    let count = lines.len();
    for (line, text) in lines {
        let fields: Vec<&str> = text.split(',').map(str::trim).collect();
        let stamp_s = fields[0].parse::<f64>().ok().filter(|s| s.is_finite());
        let (Some(stamp_s), true) = (stamp_s, fields.len() == columns) else {
            return Err(list::line_error(
                path,
                line,
                format!(
                    "`{text}` should be {columns} fields with commas, the first a stamp in seconds"
                ),
            ));
        };
        stamped.push((stamp_s, moment(&fields)));
    }
    entries
        .iter()
        .map(|entry| {
            stamped
                .iter()
                .find(|(stamp_s, _)| (stamp_s - entry.stamp_s).abs() < SAME_STAMP_S)
                .map(|(_, moment)| moment.clone())
                .ok_or_else(|| DatasetError::Content {
                    path: path.to_owned(),
                    got: format!(
                        "{count} lines, none for the frame at {:.6} s",
                        entry.stamp_s
                    ),
                    expected: "a line for each frame".to_owned(),
                    hint: "add one",
                })
        })
        .collect()
}

/// What a pass is called from where it turns back.
pub const WAY_BACK: &str = " back";

/// A pass that ends nearer to its start than halfway to its farthest pose goes there and back: its second half sees
/// nothing for the first time and gets a name of its own.
fn split_at_turns(moments: &mut [Moment], entries: &[Entry]) {
    let mut start = 0;
    for pass in moments.chunk_by_mut(|a, b| a.pass == b.pass) {
        let from_start_m: Vec<f64> = entries[start..start + pass.len()]
            .iter()
            .map(|entry| {
                let first = &entries[start].world_from_camera.translation.vector;
                (entry.world_from_camera.translation.vector - first).norm()
            })
            .collect();
        let turn = (0..pass.len())
            .max_by(|&a, &b| from_start_m[a].total_cmp(&from_start_m[b]))
            .expect("a chunk is not empty");
        let comes_back = from_start_m[pass.len() - 1] < from_start_m[turn] / 2.0;
        start += pass.len();
        if comes_back {
            for moment in &mut pass[turn + 1..] {
                moment.pass.push_str(WAY_BACK);
            }
        }
    }
}

fn masks(
    folder: &Path,
    entries: &[Entry],
) -> Result<HashMap<String, Vec<Option<PathBuf>>>, DatasetError> {
    let mut masks = HashMap::new();
    if !folder.is_dir() {
        return Ok(masks);
    }
    let read_error = |source| DatasetError::Read {
        path: folder.to_owned(),
        source,
        hint: "masks lie in mask/<object>/<stamp>.png",
    };
    for object in std::fs::read_dir(folder).map_err(read_error)? {
        let object = object.map_err(read_error)?;
        let paths = of_entries(&object.path(), entries);
        masks.insert(object.file_name().to_string_lossy().into_owned(), paths);
    }
    Ok(masks)
}

/// Boxes of a set of runs: run -> viewpoint -> boxes, where viewpoint n is a run's n-th frame.
pub(super) fn add_boxes(folder: &Path, runs: &mut [Recording]) -> Result<(), DatasetError> {
    let path = folder.join("boxes.json");
    if !path.is_file() {
        return Ok(());
    }
    let text = std::fs::read_to_string(&path).map_err(|source| DatasetError::Read {
        path: path.clone(),
        source,
        hint: "it should be readable text",
    })?;
    let mut boxes: HashMap<String, HashMap<usize, Vec<TruthBox>>> =
        serde_json::from_str(&text).map_err(|source| DatasetError::Boxes { path, source })?;
    for run in runs {
        let mut by_viewpoint = boxes.remove(&run.name).unwrap_or_default();
        run.truth.boxes = (0..run.entries.len())
            .map(|viewpoint| by_viewpoint.remove(&viewpoint).unwrap_or_default())
            .collect();
    }
    Ok(())
}
