//! The text files of a recording: one record a line, words separated by blanks, `#` starts a comment.

use std::path::{Path, PathBuf};

use crate::model::{
    camera::Intrinsics,
    pose::{Pose, pose_from_parts},
};

use super::DatasetError;

#[derive(Debug, Clone)]
pub struct Stamped<T> {
    pub stamp_s: f64,
    pub value: T,
}

/// Lines that are neither empty nor comments, with their number from 1.
pub fn lines(path: &Path, hint: &'static str) -> Result<Vec<(usize, String)>, DatasetError> {
    let text = std::fs::read_to_string(path).map_err(|source| DatasetError::Read {
        path: path.to_owned(),
        source,
        hint,
    })?;
    Ok(text
        .lines()
        .enumerate()
        .map(|(index, line)| (index + 1, line.trim().to_owned()))
        .filter(|(_, line)| !line.is_empty() && !line.starts_with('#'))
        .collect())
}

pub fn line_error(path: &Path, line: usize, problem: impl Into<String>) -> DatasetError {
    DatasetError::Line {
        path: path.to_owned(),
        line,
        problem: problem.into(),
    }
}

/// `count` finite numbers.
fn numbers<const COUNT: usize>(
    path: &Path,
    line: usize,
    text: &str,
    names: &str,
) -> Result<[f64; COUNT], DatasetError> {
    let parsed: Option<Vec<f64>> = text
        .split_whitespace()
        .map(|word| word.parse().ok().filter(|number: &f64| number.is_finite()))
        .collect();
    parsed
        .and_then(|numbers| numbers.try_into().ok())
        .ok_or_else(|| {
            line_error(
                path,
                line,
                format!("`{text}` should be {COUNT} numbers: {names}"),
            )
        })
}

fn sorted<T>(mut stamped: Vec<Stamped<T>>) -> Vec<Stamped<T>> {
    stamped.sort_by(|a, b| a.stamp_s.total_cmp(&b.stamp_s));
    stamped
}

/// `timestamp filename`, in the order of time.
pub fn files(path: &Path) -> Result<Vec<Stamped<PathBuf>>, DatasetError> {
    lines(path, "a recording lists its files as `timestamp filename`")?
        .into_iter()
        .map(|(line, text)| {
            let parsed = text
                .split_once(char::is_whitespace)
                .and_then(|(stamp, name)| {
                    let stamp_s: f64 = stamp.parse().ok()?;
                    stamp_s.is_finite().then(|| Stamped {
                        stamp_s,
                        value: PathBuf::from(name.trim()),
                    })
                });
            parsed.ok_or_else(|| {
                line_error(
                    path,
                    line,
                    format!("`{text}` should be `timestamp filename`, the stamp in seconds"),
                )
            })
        })
        .collect::<Result<Vec<_>, _>>()
        .map(sorted)
}

/// `timestamp tx ty tz qx qy qz qw`, in the order of time.
pub fn poses(path: &Path) -> Result<Vec<Stamped<Pose>>, DatasetError> {
    lines(path, "a recording has its poses in it")?
        .into_iter()
        .map(|(line, text)| {
            let [stamp_s, x, y, z, qx, qy, qz, qw] =
                numbers(path, line, &text, "timestamp tx ty tz qx qy qz qw")?;
            let value = pose_from_parts([x, y, z], [qx, qy, qz, qw]).ok_or_else(|| {
                line_error(
                    path,
                    line,
                    "the quaternion (qx qy qz qw, the last four) does not have length 1: normalise it",
                )
            })?;
            Ok(Stamped { stamp_s, value })
        })
        .collect::<Result<Vec<_>, _>>()
        .map(sorted)
}

/// `fx fy cx cy` of images of that size.
pub fn calibration(path: &Path, width: usize, height: usize) -> Result<Intrinsics, DatasetError> {
    let lines = lines(path, "it holds one line: fx fy cx cy, pixels")?;
    let Some((line, text)) = lines.first() else {
        return Err(line_error(path, 1, "is empty: write fx fy cx cy, pixels"));
    };
    let [fx, fy, cx, cy] = numbers(path, *line, text, "fx fy cx cy")?;
    if fx <= 0.0 || fy <= 0.0 {
        return Err(line_error(
            path,
            *line,
            format!("focal lengths must be positive, not {fx} and {fy}"),
        ));
    }
    Ok(Intrinsics {
        width,
        height,
        fx,
        fy,
        cx,
        cy,
    })
}
