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

use zstd::{
    bulk::Compressor,
    zstd_safe::{CParameter, compress_bound},
};

use super::form::FormError;
use crate::{
    isa::{Isa, for_each_isa},
    model::belief::Record,
};

const LEVEL: i32 = 1;
/// Entries of the table of what came before, as a power of two: it fits into a core's first cache. Four times as many,
/// as the level has by itself, take a quarter more time for at most three hundredths less bytes.
const HASH_LOG: u32 = 12;
const VALUES: usize = 16;
const RECORD_BYTES: usize = 2 * VALUES;
/// Of a pixel, with its depth.
const PIXEL_BYTES: usize = RECORD_BYTES + 4;
/// Records that are taken apart at once: a byte of each is a word.
const GROUP: usize = 8;
/// Records whose bytes are gathered before they go to their planes: a cache line each. Word by word takes 1.6 times as
/// long, as a processor remembers few of the pages that it writes to.
const TILE: usize = 64;

/// More than any image of so many pixels takes packed: what cannot be compressed grows by less than a hundredth.
pub fn packed_bytes_max(pixels: usize) -> u64 {
    let split = (pixels * PIXEL_BYTES) as u64;
    split + split / 100 + 1024
}

/// Packs one after the other into the same memory: some megabytes from the system are a thousand page faults.
pub struct Packer {
    zstd: Compressor<'static>,
    split: Vec<u8>,
    packed: Vec<u8>,
}

impl Default for Packer {
    fn default() -> Self {
        let mut zstd = Compressor::new(LEVEL).expect("the level is one");
        zstd.set_parameter(CParameter::HashLog(HASH_LOG))
            .expect("the table's size is in bounds");
        Self {
            zstd,
            split: Vec::new(),
            packed: Vec::new(),
        }
    }
}

impl Packer {
    /// One depth for each record.
    pub fn pack(&mut self, records: &[Record], depth_m: &[f32]) -> &[u8] {
        assert_eq!(records.len(), depth_m.len(), "one depth a pixel");
        let pixels = records.len();
        self.split.resize(pixels * PIXEL_BYTES, 0);
        let (of_records, of_depth) = self.split.split_at_mut(pixels * RECORD_BYTES);
        split_records(Isa::detect(), records, of_records);
        split_depth(Isa::detect(), depth_m, of_depth);
        self.packed.clear();
        self.packed.reserve(compress_bound(self.split.len()));
        self.zstd
            .compress_to_buffer(&self.split, &mut self.packed)
            .expect("memory can be compressed into memory");
        &self.packed
    }
}

/// Of an image of so many pixels: no more memory is taken than that needs.
///
/// # Errors
/// Bytes that were not packed from as many pixels.
pub fn unpack(packed: &[u8], pixels: usize) -> Result<(Vec<Record>, Vec<f32>), FormError> {
    let wrong = FormError::Value("planes' size");
    let mut split = vec![0; pixels * PIXEL_BYTES];
    match zstd::bulk::decompress_to_buffer(packed, &mut split) {
        Ok(bytes) if bytes == split.len() => {}
        _ => return Err(wrong),
    }
    let (of_records, of_depth) = split.split_at(pixels * RECORD_BYTES);
    let mut records = vec![Record::default(); pixels];
    join_records(Isa::detect(), of_records, &mut records);
    let mut depth_m = vec![0.0; pixels];
    join_depth(Isa::detect(), of_depth, &mut depth_m);
    Ok((records, depth_m))
}

for_each_isa! {
    fn split_records(records: &[Record], planes: &mut [u8]) = split_records_kernel;
}

for_each_isa! {
    fn join_records(planes: &[u8], records: &mut [Record]) = join_records_kernel;
}

for_each_isa! {
    fn split_depth(depth_m: &[f32], planes: &mut [u8]) = split_depth_kernel;
}

for_each_isa! {
    fn join_depth(planes: &[u8], depth_m: &mut [f32]) = join_depth_kernel;
}

/// The difference of a value from the one before it; small ones of either sign are small.
#[inline(always)]
fn coded(value: u16, before: u16) -> u16 {
    let step = value.wrapping_sub(before) as i16;
    ((step << 1) ^ (step >> 15)) as u16
}

/// The inverse of [`coded`].
#[inline(always)]
fn decoded(coded: u16, before: u16) -> u16 {
    let step = (coded >> 1) ^ (coded & 1).wrapping_neg();
    before.wrapping_add(step)
}

/// The bytes of eight records, in words.
type Group = [[u64; RECORD_BYTES / 8]; GROUP];

/// Makes a word of the same byte of each record, and the other way round: byte `8 * w + k` of record `r` is byte `r` of
/// word `w` of row `k`.
#[inline(always)]
fn transpose(rows: &mut Group) {
    exchange::<4, 32>(rows, 0x0000_0000_ffff_ffff);
    exchange::<2, 16>(rows, 0x0000_ffff_0000_ffff);
    exchange::<1, 8>(rows, 0x00ff_00ff_00ff_00ff);
}

/// Of rows so far apart: the upper parts of one with the lower parts of the other.
#[inline(always)]
fn exchange<const APART: usize, const SHIFT: u32>(rows: &mut Group, mask: u64) {
    for upper in 0..GROUP {
        if upper & APART != 0 {
            continue;
        }
        let lower = upper + APART;
        for word in 0..RECORD_BYTES / 8 {
            let (a, b) = (rows[upper][word], rows[lower][word]);
            let swapped = ((a >> SHIFT) ^ b) & mask;
            rows[upper][word] = a ^ (swapped << SHIFT);
            rows[lower][word] = b ^ swapped;
        }
    }
}

#[inline(always)]
fn split_records_kernel(records: &[Record], planes: &mut [u8]) {
    let pixels = records.len();
    let mut before = [0u16; VALUES];
    let mut step = |record: &Record| {
        let values: [u16; VALUES] = bytemuck::cast(*record);
        let mut steps = [0u16; VALUES];
        for lane in 0..VALUES {
            steps[lane] = coded(values[lane], before[lane]).to_le();
        }
        before = values;
        steps
    };
    let (tiles, rest) = records.as_chunks::<TILE>();
    for (index, tile) in tiles.iter().enumerate() {
        let mut bytes = [[0u8; TILE]; RECORD_BYTES];
        let (groups, _) = tile.as_chunks::<GROUP>();
        for (at, group) in (0..TILE).step_by(GROUP).zip(groups) {
            let mut rows = Group::default();
            for (row, record) in rows.iter_mut().zip(group) {
                let words: [u64; RECORD_BYTES / 8] = bytemuck::cast(step(record));
                *row = words.map(u64::from_le);
            }
            transpose(&mut rows);
            for (k, row) in rows.iter().enumerate() {
                for (w, word) in row.iter().enumerate() {
                    bytes[8 * w + k][at..at + GROUP].copy_from_slice(&word.to_le_bytes());
                }
            }
        }
        for (plane, bytes) in bytes.iter().enumerate() {
            planes[plane * pixels + TILE * index..][..TILE].copy_from_slice(bytes);
        }
    }
    for (record, pixel) in rest.iter().zip(TILE * tiles.len()..) {
        let bytes: [u8; RECORD_BYTES] = bytemuck::cast(step(record));
        for (plane, byte) in bytes.into_iter().enumerate() {
            planes[plane * pixels + pixel] = byte;
        }
    }
}

#[inline(always)]
fn join_records_kernel(planes: &[u8], records: &mut [Record]) {
    let pixels = records.len();
    let mut before = [0u16; VALUES];
    let mut join = |steps: [u16; VALUES]| -> Record {
        for lane in 0..VALUES {
            before[lane] = decoded(u16::from_le(steps[lane]), before[lane]);
        }
        bytemuck::cast(before)
    };
    let (groups, rest) = records.as_chunks_mut::<GROUP>();
    let grouped = GROUP * groups.len();
    for (index, group) in groups.iter_mut().enumerate() {
        let mut rows = Group::default();
        for (k, row) in rows.iter_mut().enumerate() {
            for (w, word) in row.iter_mut().enumerate() {
                let at = (8 * w + k) * pixels + GROUP * index;
                let mut bytes = [0; GROUP];
                bytes.copy_from_slice(&planes[at..at + GROUP]);
                *word = u64::from_le_bytes(bytes);
            }
        }
        transpose(&mut rows);
        for (row, record) in rows.iter().zip(group) {
            *record = join(bytemuck::cast(row.map(u64::to_le)));
        }
    }
    for (record, pixel) in rest.iter_mut().zip(grouped..) {
        let bytes: [u8; RECORD_BYTES] = std::array::from_fn(|plane| planes[plane * pixels + pixel]);
        *record = join(bytemuck::cast(bytes));
    }
}

#[inline(always)]
fn split_depth_kernel(depth_m: &[f32], planes: &mut [u8]) {
    let [low, mid, upper_low, upper_high] = quarters_mut(planes);
    for ((depth_m, low), mid) in depth_m.iter().zip(low).zip(mid) {
        [*low, *mid, _, _] = depth_m.to_bits().to_le_bytes();
    }
    let mut before = 0;
    for ((depth_m, low), high) in depth_m.iter().zip(upper_low).zip(upper_high) {
        let value = (depth_m.to_bits() >> 16) as u16;
        [*low, *high] = coded(value, before).to_le_bytes();
        before = value;
    }
}

#[inline(always)]
fn join_depth_kernel(planes: &[u8], depth_m: &mut [f32]) {
    let pixels = depth_m.len();
    let mut before = 0;
    for (pixel, depth_m) in depth_m.iter_mut().enumerate() {
        let [low, mid, upper_low, upper_high] =
            [0, 1, 2, 3].map(|plane| planes[plane * pixels + pixel]);
        before = decoded(u16::from_le_bytes([upper_low, upper_high]), before);
        let [upper_low, upper_high] = before.to_le_bytes();
        *depth_m = f32::from_le_bytes([low, mid, upper_low, upper_high]);
    }
}

fn quarters_mut(bytes: &mut [u8]) -> [&mut [u8]; 4] {
    let (first, second) = bytes.split_at_mut(bytes.len() / 2);
    let (a, b) = first.split_at_mut(first.len() / 2);
    let (c, d) = second.split_at_mut(second.len() / 2);
    [a, b, c, d]
}
