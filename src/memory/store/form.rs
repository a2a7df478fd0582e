//! The stored form of a viewpoint: one object that needs nothing beside it.
//!
//! ```text
//! offset  bytes
//!      0      8  magic: 0x89 "SVIEW" CR LF; it does not survive being treated as text
//!      8      4  version of this form: 1
//!     12      4  H: bytes of the head with its checksum
//!     16      8  bytes of the whole object
//!     24      8  id
//!     32      8  epoch of the lease under which it was written
//!     40      8  revision: rises with every change of the viewpoint
//!     48      8  updates: how many frames were written into it
//!     56      8  capture time of the last of them, nanoseconds since the epoch
//!     64     56  world_from_camera: position x y z (m), quaternion x y z w
//!    120     56  world_from_home: the same
//!    176     32  fx fy cx cy (pixels)
//!    208      8  width, height
//!    216      8  where the mesh is cut: share, inverse depth (1/m)
//!    224      8  hash of the settings it was learnt with
//!    232     ..  place, robot, camera: each its length (2 bytes) and UTF-8
//!    H-8      8  checksum of everything before
//!      H     ..  planes: see `planes`
//!     -8      8  checksum of everything before
//! ```
//!
//! Numbers are little-endian; poses and pixels `f64`, the mesh's cut `f32`. Checksums are CRC-64/NVME: every change
//! within 64 neighbouring bits is found, others but for one in 2^64. The head has its own, so that a place's index can
//! be made of the heads alone. What follows from the planes (the mesh's triangles, the coarse picture) is not stored.

use nalgebra::{Quaternion, Translation3, UnitQuaternion};

use super::planes::{self, Packer};
use crate::{
    memory::Version,
    model::{
        belief::Record,
        camera::Intrinsics,
        frame::Source,
        pose::{Pose, pose_from_parts},
        viewpoint::{Head, MeshCut, Viewpoint},
    },
};

const MAGIC: [u8; 8] = *b"\x89SVIEW\r\n";
const VERSION: u32 = 1;
const CHECKSUM_BYTES: usize = 8;
/// Names are ids of at most 64 bytes; a head of another program's making may be somewhat longer.
pub const HEAD_BYTES_MAX: usize = 4096;
/// Up to where a head says how long it is.
const PREFIX_BYTES: usize = 24;

/// What is beside the viewpoint's own in its head.
#[derive(Debug, Clone, PartialEq)]
pub struct Label {
    pub place: String,
    pub version: Version,
    pub settings_hash: u64,
}

/// Why bytes are no stored viewpoint.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum FormError {
    #[error("{got} bytes are too few for a stored viewpoint")]
    Short { got: usize },
    #[error("it does not begin as a stored viewpoint does")]
    Magic,
    #[error("it is of version {0} of the stored form, which this program does not know")]
    Version(u32),
    #[error("it has {got} bytes but says {said}")]
    Length { got: u64, said: u64 },
    #[error("the checksum of its {part} is wrong")]
    Checksum { part: &'static str },
    #[error("its object is larger than image_pixels_max allows")]
    TooLong,
    #[error("its {0} is impossible")]
    Value(&'static str),
    #[error("its image of {pixels} pixels is larger than image_pixels_max = {most}")]
    Large { pixels: u64, most: usize },
}

impl FormError {
    /// False for what another program, or this one with other settings, can read.
    pub fn is_damage(&self) -> bool {
        !matches!(self, Self::Version(_) | Self::Large { .. } | Self::TooLong)
    }
}

/// A head as read, and where the planes lie.
#[derive(Debug, Clone, PartialEq)]
pub struct ReadHead {
    pub label: Label,
    pub head: Head,
    pub joined: MeshCut,
    /// Of the head with its checksum.
    pub bytes: usize,
    pub object_bytes: u64,
}

pub fn checksum(bytes: &[u8]) -> u64 {
    crc_fast::crc64_nvme(bytes)
}

/// Keeps its working memory from one viewpoint to the next.
#[derive(Default)]
pub struct Encoder {
    packer: Packer,
}

impl Encoder {
    /// The whole object.
    pub fn encode(&mut self, label: &Label, viewpoint: &Viewpoint) -> Vec<u8> {
        let planes = self
            .packer
            .pack(&viewpoint.records, &viewpoint.mesh.depth_m);
        assemble(label, &viewpoint.head(), viewpoint.mesh.joined, planes)
    }
}

/// The same viewpoint under another label; its planes are not touched.
///
/// # Errors
/// As [`decode_head`], and a wrong checksum of the object.
pub fn relabel(bytes: &[u8], label: &Label) -> Result<Vec<u8>, FormError> {
    let read = decode_head(bytes)?;
    let planes = checked_planes(bytes, &read)?;
    Ok(assemble(label, &read.head, read.joined, planes))
}

fn assemble(label: &Label, head: &Head, joined: MeshCut, planes: &[u8]) -> Vec<u8> {
    let mut out = Vec::with_capacity(512 + planes.len());
    out.extend(MAGIC);
    out.extend(VERSION.to_le_bytes());
    // Both lengths are known at the end.
    out.extend([0; 12]);
    for number in [
        head.id,
        label.version.epoch,
        label.version.revision,
        head.updates,
    ] {
        out.extend(number.to_le_bytes());
    }
    out.extend(head.stamp_ns.to_le_bytes());
    for pose in [&head.world_from_camera, &head.world_from_home] {
        let [x, y, z] = pose.translation.vector.into();
        let q = pose.rotation.coords;
        for number in [x, y, z, q.x, q.y, q.z, q.w] {
            out.extend(number.to_le_bytes());
        }
    }
    let camera = &head.intrinsics;
    for number in [camera.fx, camera.fy, camera.cx, camera.cy] {
        out.extend(number.to_le_bytes());
    }
    for size in [camera.width, camera.height] {
        // Images are far smaller: image_pixels_max is below 2^26.
        out.extend((size as u32).to_le_bytes());
    }
    out.extend(joined.share.to_le_bytes());
    out.extend(joined.inverse_depth.to_le_bytes());
    out.extend(label.settings_hash.to_le_bytes());
    for name in [&*label.place, &*head.source.robot, &*head.source.camera] {
        out.extend((name.len() as u16).to_le_bytes());
        out.extend(name.as_bytes());
    }
    let head_bytes = out.len() + CHECKSUM_BYTES;
    assert!(head_bytes <= HEAD_BYTES_MAX, "names are short");
    let object_bytes = (head_bytes + planes.len() + CHECKSUM_BYTES) as u64;
    out[12..16].copy_from_slice(&(head_bytes as u32).to_le_bytes());
    out[16..24].copy_from_slice(&object_bytes.to_le_bytes());
    out.extend(checksum(&out).to_le_bytes());
    out.extend(planes);
    out.extend(checksum(&out).to_le_bytes());
    out
}

/// The head alone, of bytes that hold at least it: [`HEAD_BYTES_MAX`] always do.
///
/// # Errors
/// Bytes that are no head of a stored viewpoint, or damaged.
pub fn decode_head(bytes: &[u8]) -> Result<ReadHead, FormError> {
    if bytes.len() < PREFIX_BYTES {
        return Err(FormError::Short { got: bytes.len() });
    }
    let mut reader = Reader(bytes);
    if reader.take::<8>()? != MAGIC {
        return Err(FormError::Magic);
    }
    let version = reader.u32()?;
    let head_bytes = reader.u32()? as usize;
    let object_bytes = reader.u64()?;
    if !(PREFIX_BYTES + CHECKSUM_BYTES..=HEAD_BYTES_MAX).contains(&head_bytes) {
        return Err(FormError::Value("head's length"));
    }
    let Some(head) = bytes.get(..head_bytes) else {
        return Err(FormError::Short { got: bytes.len() });
    };
    let (content, sum) = head.split_at(head_bytes - CHECKSUM_BYTES);
    if sum != checksum(content).to_le_bytes() {
        return Err(FormError::Checksum { part: "head" });
    }
    // Up to here every version is the same, so that a damaged one is no other one.
    if version != VERSION {
        return Err(FormError::Version(version));
    }
    let mut reader = Reader(&content[PREFIX_BYTES..]);
    let id = reader.u64()?;
    let version = Version {
        epoch: reader.u64()?,
        revision: reader.u64()?,
    };
    let updates = reader.u64()?;
    let stamp_ns = reader.u64()? as i64;
    let world_from_camera = reader.pose()?;
    let world_from_home = reader.pose()?;
    let [fx, fy, cx, cy] = reader.numbers()?;
    let (width, height) = (reader.u32()?, reader.u32()?);
    let joined = MeshCut {
        share: f32::from_bits(reader.u32()?),
        inverse_depth: f32::from_bits(reader.u32()?),
    };
    let settings_hash = reader.u64()?;
    let place = reader.name()?.to_owned();
    let robot = reader.name()?.into();
    let camera = reader.name()?.into();
    if !reader.0.is_empty() {
        return Err(FormError::Value("head's length"));
    }
    let focal = |value: f64| value.is_finite() && value > 0.0;
    if !focal(fx) || !focal(fy) || !cx.is_finite() || !cy.is_finite() {
        return Err(FormError::Value("camera"));
    }
    if width == 0 || height == 0 {
        return Err(FormError::Value("image size"));
    }
    Ok(ReadHead {
        label: Label {
            place,
            version,
            settings_hash,
        },
        head: Head {
            id,
            world_from_camera,
            world_from_home,
            intrinsics: Intrinsics {
                width: width as usize,
                height: height as usize,
                fx,
                fy,
                cx,
                cy,
            },
            source: Source { robot, camera },
            stamp_ns,
            updates,
        },
        joined,
        bytes: head_bytes,
        object_bytes,
    })
}

/// The whole viewpoint. No more memory is taken than an image of `pixels_max` needs.
///
/// # Errors
/// Bytes that are no stored viewpoint, or damaged anywhere.
pub fn decode(bytes: &[u8], pixels_max: usize) -> Result<(Label, Viewpoint), FormError> {
    let read = decode_head(bytes)?;
    let packed = checked_planes(bytes, &read)?;
    let Intrinsics { width, height, .. } = read.head.intrinsics;
    let pixels = width as u64 * height as u64;
    if pixels > pixels_max as u64 {
        return Err(FormError::Large {
            pixels,
            most: pixels_max,
        });
    }
    let (records, depth_m) = planes::unpack(packed, pixels as usize)?;
    // One infinite belief would spoil pixels that do not see it: what weighs nothing is summed too.
    if !records.iter().all(Record::is_sound) {
        return Err(FormError::Value("belief"));
    }
    let viewpoint = Viewpoint::from_stored(read.head, depth_m, read.joined, records);
    Ok((read.label, viewpoint))
}

/// # Errors
/// Bytes that are no stored viewpoint, or damaged anywhere.
pub fn check(bytes: &[u8]) -> Result<(), FormError> {
    checked_planes(bytes, &decode_head(bytes)?).map(|_| ())
}

/// The planes of an object whose length and checksum are right.
fn checked_planes<'a>(bytes: &'a [u8], read: &ReadHead) -> Result<&'a [u8], FormError> {
    let (got, said) = (bytes.len() as u64, read.object_bytes);
    if got != said || bytes.len() < read.bytes + CHECKSUM_BYTES {
        return Err(FormError::Length { got, said });
    }
    let (content, sum) = bytes.split_at(bytes.len() - CHECKSUM_BYTES);
    if sum != checksum(content).to_le_bytes() {
        return Err(FormError::Checksum { part: "planes" });
    }
    Ok(&content[read.bytes..])
}

/// What has not been read yet.
struct Reader<'a>(&'a [u8]);

impl<'a> Reader<'a> {
    fn take<const N: usize>(&mut self) -> Result<[u8; N], FormError> {
        let (taken, rest) = self
            .0
            .split_first_chunk()
            .ok_or(FormError::Value("head's length"))?;
        self.0 = rest;
        Ok(*taken)
    }

    fn u32(&mut self) -> Result<u32, FormError> {
        Ok(u32::from_le_bytes(self.take()?))
    }

    fn u64(&mut self) -> Result<u64, FormError> {
        Ok(u64::from_le_bytes(self.take()?))
    }

    fn numbers<const N: usize>(&mut self) -> Result<[f64; N], FormError> {
        let mut numbers = [0.0; N];
        for number in &mut numbers {
            *number = f64::from_le_bytes(self.take()?);
        }
        Ok(numbers)
    }

    fn pose(&mut self) -> Result<Pose, FormError> {
        let position = self.numbers()?;
        let quaternion: [f64; 4] = self.numbers()?;
        // Checked as every pose from outside is, but not normalised again: that would change its last bits.
        pose_from_parts(position, quaternion).ok_or(FormError::Value("pose"))?;
        let [x, y, z, w] = quaternion;
        Ok(Pose::from_parts(
            Translation3::from(position),
            UnitQuaternion::new_unchecked(Quaternion::new(w, x, y, z)),
        ))
    }

    fn name(&mut self) -> Result<&'a str, FormError> {
        let length = u16::from_le_bytes(self.take()?).into();
        let (name, rest) = self
            .0
            .split_at_checked(length)
            .ok_or(FormError::Value("name"))?;
        self.0 = rest;
        std::str::from_utf8(name).map_err(|_| FormError::Value("name"))
    }
}
