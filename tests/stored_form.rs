//! A viewpoint is stored and read back bit for bit, and no bit of its object can change without being noticed.

mod reference;

use proptest::prelude::*;
use reference::{Random, scene};
use surprised::{
    memory::{
        Version,
        store::form::{self, FormError, Label},
    },
    model::{
        belief::Record,
        viewpoint::{Coarse, Mesh, MeshCut, Viewpoint},
    },
};

const PIXELS_MAX: usize = 8_000_000;

fn label() -> Label {
    Label {
        place: "lab".to_owned(),
        version: Version {
            epoch: 3,
            revision: 77,
        },
        settings_hash: 0x0123_4567_89ab_cdef,
    }
}

/// Records of any bits that are non-negative numbers, depths of any positive value, some without.
fn any_viewpoint(width: usize, height: usize, seed: u64) -> Viewpoint {
    let mut random = Random(seed);
    let camera = scene::camera(width, height);
    let mut bits = || random.below(1 << 16) as u16;
    let records = (0..camera.pixels())
        .map(|_| Record {
            spread: [0; 8].map(|_: u16| bits() % 0x7c00),
            level: [0; 8].map(|_: u16| bits() as i16),
        })
        .collect();
    let depth_m = (0..camera.pixels())
        .map(|_| match random.below(4) {
            0 => 0.0,
            1 => random.log_uniform(1e-3, 1e4) as f32,
            _ => random.uniform(1.0, 1.02) as f32,
        })
        .collect();
    let pose = scene::pose([0.1, -7.3, 1e-9], [0.3, 1.2, -2.0]);
    let mut viewpoint = scene::viewpoint(camera, &pose, depth_m, records);
    viewpoint.id = u64::MAX - 5;
    viewpoint.stamp_ns = -12;
    viewpoint.updates = 9;
    viewpoint.world_from_home = scene::pose([0.11, -7.3, 0.0], [0.3, 1.2, -2.0]);
    let cut = MeshCut {
        share: 0.05,
        inverse_depth: 0.003,
    };
    viewpoint.mesh = Mesh::new(camera, viewpoint.mesh.depth_m, cut);
    viewpoint.coarse = Coarse::new(&viewpoint.mesh, &viewpoint.records, cut);
    viewpoint
}

fn poses_have_the_same_bits(a: &Viewpoint, b: &Viewpoint) -> bool {
    let bits = |viewpoint: &Viewpoint| {
        [viewpoint.world_from_camera, viewpoint.world_from_home].map(|pose| {
            let q = pose.rotation.coords.map(f64::to_bits);
            (pose.translation.vector.map(f64::to_bits), q)
        })
    };
    bits(a) == bits(b)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]

    #[test]
    fn what_is_read_is_what_was_stored(
        width in 1usize..70,
        height in 1usize..40,
        seed in any::<u64>(),
    ) {
        let viewpoint = any_viewpoint(width, height, seed);
        let object = form::Encoder::default().encode(&label(), &viewpoint);
        let (read_label, read) = form::decode(&object, PIXELS_MAX).expect("it was just made");
        prop_assert_eq!(read_label, label());
        prop_assert!(poses_have_the_same_bits(&read, &viewpoint));
        prop_assert_eq!(read, viewpoint);
    }
}

/// A value's difference from the one before it, small ones of either sign as small numbers.
fn differences(values: impl Iterator<Item = u16>) -> Vec<u16> {
    let mut before = 0u16;
    let step = |value: u16| {
        let step = i32::from(value.wrapping_sub(before) as i16);
        before = value;
        (if step < 0 { -2 * step - 1 } else { 2 * step }) as u16
    };
    values.map(step).collect()
}

/// Written plainly from the description, so that no other order of bytes comes in by being faster: what earlier versions
/// stored stays readable.
#[test]
fn planes_lie_as_the_form_says() {
    let viewpoint = any_viewpoint(31, 17, 4);
    let mut planes = Vec::new();
    for value in 0..16 {
        planes.push(differences(viewpoint.records.iter().map(
            |record| match value {
                0..8 => record.spread[value],
                _ => record.level[value - 8] as u16,
            },
        )));
    }
    let depth = || {
        viewpoint
            .mesh
            .depth_m
            .iter()
            .map(|depth_m| depth_m.to_bits())
    };
    planes.push(depth().map(|bits| bits as u16).collect());
    planes.push(differences(depth().map(|bits| (bits >> 16) as u16)));
    let bytes: Vec<u8> = planes
        .iter()
        .flat_map(|plane| {
            let low = plane.iter().map(|value| *value as u8);
            low.chain(plane.iter().map(|value| (value >> 8) as u8))
        })
        .collect();

    let object = form::Encoder::default().encode(&label(), &viewpoint);
    let head = form::decode_head(&object).expect("it was just made");
    let packed = &object[head.bytes..object.len() - 8];
    let lies = zstd::bulk::decompress(packed, bytes.len()).expect("it was just packed");
    assert!(lies == bytes);
}

#[test]
fn an_encoder_makes_the_same_of_a_viewpoint_whatever_it_had_before() {
    let mut encoder = form::Encoder::default();
    for (width, height, seed) in [(40, 30, 1), (70, 50, 2), (9, 7, 3), (40, 30, 4)] {
        let viewpoint = any_viewpoint(width, height, seed);
        let alone = form::Encoder::default().encode(&label(), &viewpoint);
        assert!(encoder.encode(&label(), &viewpoint) == alone);
    }
}

#[test]
fn a_head_is_read_without_the_planes() {
    let viewpoint = any_viewpoint(40, 30, 1);
    let object = form::Encoder::default().encode(&label(), &viewpoint);
    let first = &object[..object.len().min(form::HEAD_BYTES_MAX)];
    let read = form::decode_head(first).expect("the head is whole");
    assert_eq!(read.head, viewpoint.head());
    assert_eq!(read.label, label());
    assert_eq!(read.object_bytes, object.len() as u64);
}

#[test]
fn a_belief_that_is_no_number_is_refused() {
    for (place, value) in [(0, 0x7c00), (3, 0x7e01), (7, 0x8001)] {
        let mut viewpoint = any_viewpoint(9, 7, 6);
        viewpoint.records[5].spread[place] = value;
        let object = form::Encoder::default().encode(&label(), &viewpoint);
        let error = form::decode(&object, PIXELS_MAX).expect_err("it is refused");
        assert!(error.to_string().contains("belief"), "{error}");
    }
}

#[test]
fn every_flipped_bit_is_found() {
    let object = form::Encoder::default().encode(&label(), &any_viewpoint(9, 7, 2));
    for bit in 0..8 * object.len() {
        let mut damaged = object.clone();
        damaged[bit / 8] ^= 1 << (bit % 8);
        assert!(
            form::decode(&damaged, PIXELS_MAX).is_err(),
            "bit {bit} of {} was flipped unnoticed",
            8 * object.len()
        );
    }
}

#[test]
fn flipped_bits_of_a_large_object_are_found_anywhere() {
    let object = form::Encoder::default().encode(&label(), &any_viewpoint(320, 240, 3));
    let mut random = Random(4);
    for _ in 0..400 {
        let mut damaged = object.clone();
        for _ in 0..1 + random.below(3) {
            damaged[random.below(object.len())] ^= 1 << random.below(8);
        }
        assert!(damaged == object || form::decode(&damaged, PIXELS_MAX).is_err());
    }
}

#[test]
fn every_truncation_and_every_appended_byte_is_found() {
    let object = form::Encoder::default().encode(&label(), &any_viewpoint(9, 7, 5));
    for length in 0..object.len() {
        assert!(
            form::decode(&object[..length], PIXELS_MAX).is_err(),
            "cut to {length} of {} bytes unnoticed",
            object.len()
        );
    }
    let mut longer = object.clone();
    longer.push(0);
    assert!(form::decode(&longer, PIXELS_MAX).is_err());
}

/// Makes both checksums right again, as somebody would who wants to be read.
fn sign(object: &mut [u8]) {
    let head_bytes = u32::from_le_bytes(object[12..16].try_into().expect("four bytes")) as usize;
    for end in [head_bytes, object.len()] {
        let sum = form::checksum(&object[..end - 8]).to_le_bytes();
        object[end - 8..end].copy_from_slice(&sum);
    }
}

#[test]
fn sizes_that_are_only_claimed_take_no_memory() {
    let object = form::Encoder::default().encode(&label(), &any_viewpoint(9, 7, 6));
    let with_size = |width: u32, height: u32| {
        let mut claimed = object.clone();
        claimed[208..212].copy_from_slice(&width.to_le_bytes());
        claimed[212..216].copy_from_slice(&height.to_le_bytes());
        sign(&mut claimed);
        form::decode(&claimed, PIXELS_MAX).map(|_| ())
    };
    assert_eq!(with_size(9, 7), Ok(()));
    assert_eq!(
        with_size(u32::MAX, u32::MAX),
        Err(FormError::Large {
            pixels: u64::from(u32::MAX) * u64::from(u32::MAX),
            most: PIXELS_MAX
        })
    );
    for (width, height) in [(9, 6), (9, 8), (3000, 2000), (0, 7)] {
        assert!(with_size(width, height).is_err(), "{width}x{height}");
    }
}

#[test]
fn a_relabelled_viewpoint_is_the_same_viewpoint() {
    let viewpoint = any_viewpoint(31, 17, 7);
    let object = form::Encoder::default().encode(&label(), &viewpoint);
    let other = Label {
        place: "a-much-longer-name".to_owned(),
        version: Version {
            epoch: 1,
            revision: 1,
        },
        settings_hash: 0,
    };
    let relabelled = form::relabel(&object, &other).expect("it is whole");
    let (read_label, read) = form::decode(&relabelled, PIXELS_MAX).expect("it was just made");
    assert_eq!((read_label, read), (other.clone(), viewpoint));
    let mut damaged = object;
    let last = damaged.len() - 20;
    damaged[last] ^= 1;
    assert!(form::relabel(&damaged, &other).is_err());
}
