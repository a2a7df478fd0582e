//! The stored form of what was said about a place's modes, so that a frozen place is still frozen after a crash:
//!
//! ```text
//! {"version": 1,
//!  "place": "freeze",                                                    or null
//!  "cameras": [{"robot": "anna", "camera": "head", "mode": "learn"}]}
//! line feed, checksum of everything before it as 16 hexadecimal digits
//! ```
//!
//! Small, for people to read as well; the checksum is the viewpoints' own.

use serde::{Deserialize, Serialize};

use super::form::{FormError, checksum};
use crate::model::{
    frame::Source,
    mode::{Mode, Modes},
};

const VERSION: u32 = 1;
/// At the end.
const SUM_BYTES: usize = 17;
/// Of some thousand cameras with the longest of names.
pub const BYTES_MAX: u64 = 1 << 20;

#[derive(Serialize, Deserialize)]
struct Stored {
    version: u32,
    place: Option<Mode>,
    cameras: Vec<Camera>,
}

/// What every version has.
#[derive(Deserialize)]
struct Versioned {
    version: u32,
}

#[derive(Serialize, Deserialize)]
struct Camera {
    robot: String,
    camera: String,
    mode: Mode,
}

pub fn encode(modes: &Modes) -> Vec<u8> {
    let cameras = modes.cameras.iter().map(|(source, &mode)| Camera {
        robot: source.robot.to_string(),
        camera: source.camera.to_string(),
        mode,
    });
    let stored = Stored {
        version: VERSION,
        place: modes.place,
        cameras: cameras.collect(),
    };
    let mut bytes = serde_json::to_vec(&stored).expect("names and words map to JSON");
    let sum = checksum(&bytes);
    bytes.extend(format!("\n{sum:016x}").bytes());
    bytes
}

/// # Errors
/// Bytes that were not written here, or damaged.
pub fn decode(bytes: &[u8]) -> Result<Modes, FormError> {
    let got = bytes.len();
    let short = FormError::Short { got };
    let (json, sum) = bytes.split_at(got.checked_sub(SUM_BYTES).ok_or(short)?);
    if sum != format!("\n{:016x}", checksum(json)).as_bytes() {
        return Err(FormError::Checksum { part: "modes" });
    }
    let wrong = |_| FormError::Value("modes");
    let Versioned { version } = serde_json::from_slice(json).map_err(wrong)?;
    if version != VERSION {
        return Err(FormError::Version(version));
    }
    let stored: Stored = serde_json::from_slice(json).map_err(wrong)?;
    let cameras = stored.cameras.into_iter().map(|camera| {
        let source = Source {
            robot: camera.robot.into(),
            camera: camera.camera.into(),
        };
        (source, camera.mode)
    });
    Ok(Modes {
        place: stored.place,
        cameras: cameras.collect(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_said_is_read_again_and_every_flipped_bit_and_every_cut_is_found() {
        let anna = Source {
            robot: "anna".into(),
            camera: "head".into(),
        };
        let modes = Modes::said(None, Mode::Freeze).then(&Modes::said(Some(&anna), Mode::Observe));
        let bytes = encode(&modes);
        assert_eq!(decode(&bytes), Ok(modes));
        for length in 0..bytes.len() {
            decode(&bytes[..length]).expect_err("it was cut");
        }
        for bit in 0..8 * bytes.len() {
            let mut damaged = bytes.clone();
            damaged[bit / 8] ^= 1 << (bit % 8);
            let error = decode(&damaged).expect_err("a bit was flipped");
            assert!(error.is_damage(), "bit {bit}: {error}");
        }
    }
}
