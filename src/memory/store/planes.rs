//! Records and depths -> few bytes, and back bit for bit.
//!
//! ```text
//! zstd, level 1, of:  for each of the sixteen values of a record, then for the lower and the upper half of the depth's
//!                     32 bits: the lower bytes of all pixels, then the upper bytes
//! ```
//!
//! Each 16-bit value is written as its difference from the one before it in its plane, small ones of either sign as
//! small numbers; the depth's lower half is noise and stays as it is. The bench `store` compares this with others on
//! real viewpoints: it is the smallest of what takes less than a quarter of a frame's time.

use super::form::FormError;
use crate::model::belief::Record;

const LEVEL: i32 = 1;
const VALUES: usize = 16;
/// Two halves of the depth.
const PLANES: usize = VALUES + 2;
const DEPTH_LOWER: usize = VALUES;

/// More than any image of so many pixels takes packed: what cannot be compressed grows by less than a hundredth.
pub fn packed_bytes_max(pixels: usize) -> u64 {
    let split = (pixels * PLANES * 2) as u64;
    split + split / 100 + 1024
}

/// One depth for each record.
pub fn pack(records: &[Record], depth_m: &[f32]) -> Vec<u8> {
    assert_eq!(records.len(), depth_m.len(), "one depth a pixel");
    let pixels = records.len();
    let mut split = vec![0; pixels * PLANES * 2];
    if pixels > 0 {
        for (plane, bytes) in split.chunks_exact_mut(2 * pixels).enumerate() {
            match plane {
                0..8 => divide(bytes, records.iter().map(|record| record.spread[plane])),
                8..VALUES => divide(
                    bytes,
                    records.iter().map(|record| record.level[plane - 8] as u16),
                ),
                DEPTH_LOWER => {
                    let lower = depth_m.iter().map(|depth_m| depth_m.to_bits() as u16);
                    let (low, high) = bytes.split_at_mut(pixels);
                    for ((low, high), value) in low.iter_mut().zip(high).zip(lower) {
                        [*low, *high] = value.to_le_bytes();
                    }
                }
                _ => divide(
                    bytes,
                    depth_m
                        .iter()
                        .map(|depth_m| (depth_m.to_bits() >> 16) as u16),
                ),
            }
        }
    }
    zstd::bulk::compress(&split, LEVEL).expect("memory can be compressed into memory")
}

/// Of an image of so many pixels: no more memory is taken than that needs.
///
/// # Errors
/// Bytes that were not packed from as many pixels.
pub fn unpack(packed: &[u8], pixels: usize) -> Result<(Vec<Record>, Vec<f32>), FormError> {
    let wrong = FormError::Value("planes' size");
    let mut split = vec![0; pixels * PLANES * 2];
    match zstd::bulk::decompress_to_buffer(packed, &mut split) {
        Ok(bytes) if bytes == split.len() => {}
        _ => return Err(wrong),
    }
    let mut records = vec![Record::default(); pixels];
    let mut depth_bits = vec![0u32; pixels];
    for (plane, bytes) in split.chunks_exact(2 * pixels).enumerate() {
        let (low, high) = bytes.split_at(pixels);
        let values = low
            .iter()
            .zip(high)
            .map(|(&low, &high)| u16::from_le_bytes([low, high]));
        match plane {
            0..8 => {
                for (record, value) in records.iter_mut().zip(joined(values)) {
                    record.spread[plane] = value;
                }
            }
            8..VALUES => {
                for (record, value) in records.iter_mut().zip(joined(values)) {
                    record.level[plane - 8] = value as i16;
                }
            }
            DEPTH_LOWER => {
                for (bits, value) in depth_bits.iter_mut().zip(values) {
                    *bits |= u32::from(value);
                }
            }
            _ => {
                for (bits, value) in depth_bits.iter_mut().zip(joined(values)) {
                    *bits |= u32::from(value) << 16;
                }
            }
        }
    }
    let depth_m = depth_bits.into_iter().map(f32::from_bits).collect();
    Ok((records, depth_m))
}

/// Differences of neighbours, their lower and upper bytes apart.
fn divide(bytes: &mut [u8], values: impl Iterator<Item = u16>) {
    let (low, high) = bytes.split_at_mut(bytes.len() / 2);
    let mut before = 0u16;
    for ((low, high), value) in low.iter_mut().zip(high).zip(values) {
        let step = value.wrapping_sub(before) as i16;
        before = value;
        [*low, *high] = ((step << 1) ^ (step >> 15)).to_le_bytes();
    }
}

/// The inverse of [`divide`].
fn joined(steps: impl Iterator<Item = u16>) -> impl Iterator<Item = u16> {
    steps.scan(0u16, |before, coded| {
        let step = (coded >> 1) ^ (coded & 1).wrapping_neg();
        *before = before.wrapping_add(step);
        Some(*before)
    })
}
