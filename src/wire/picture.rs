//! Planes of numbers as pictures for people.

use std::io::Cursor;

use image::{ExtendedColorType, ImageEncoder, codecs::png::PngEncoder};

use crate::{
    model::{
        belief::{CHANNELS, rgb_from_ycbcr},
        frame::RgbImage,
    },
    stages::interpolate::prior::{ALPHA, BETA, COVERAGE, Prior, TAU},
    wire::{encode::PriorPlane, proto},
};

/// What nobody saw is shown in a grey that stands back.
const UNSEEN_RGB: [u8; 3] = [40, 40, 40];

/// An RGB png. Fast rather than small: it is looked at once.
pub fn png(rgb: &RgbImage) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    PngEncoder::new(&mut bytes)
        .write_image(
            &rgb.data,
            rgb.width as u32,
            rgb.height as u32,
            ExtendedColorType::Rgb8,
        )
        .expect("writing to memory does not fail");
    bytes.into_inner()
}

/// Tau in RGB.
pub fn expected_rgb(prior: &Prior) -> RgbImage {
    let mut data = Vec::with_capacity(prior.width * prior.height * 3);
    for y in 0..prior.height {
        let row = prior.row(y);
        for x in 0..prior.width {
            data.extend_from_slice(&if row.plane(COVERAGE)[x] > 0.0 {
                rgb_from_ycbcr([TAU, TAU + 1, TAU + 2].map(|plane| row.plane(plane)[x]))
            } else {
                UNSEEN_RGB
            });
        }
    }
    RgbImage {
        width: prior.width,
        height: prior.height,
        data,
    }
}

/// Expected variance, beta/alpha summed over the channels (eq. 11); squared grey levels.
pub fn uncertainty(prior: &Prior) -> impl Iterator<Item = f32> {
    (0..prior.height).flat_map(|y| {
        let row = prior.row(y);
        (0..prior.width).map(move |x| {
            let beta: f32 = (0..CHANNELS).map(|c| row.plane(BETA + c)[x]).sum();
            beta / row.plane(ALPHA)[x]
        })
    })
}

/// Black through red and yellow to white as values rise from 0 to `full`.
pub fn heat(width: usize, height: usize, values: &[f32], full: f32) -> RgbImage {
    let data = values
        .iter()
        .flat_map(|value| {
            let heat = 3.0 * (value / full).clamp(0.0, 1.0);
            [0.0, 1.0, 2.0].map(|start| ((heat - start).clamp(0.0, 1.0) * 255.0).round() as u8)
        })
        .collect();
    RgbImage {
        width,
        height,
        data,
    }
}

/// Standard deviation, grey levels, viewpoints, and metres that are shown white.
const UNCERTAINTY_FULL: f32 = 60.0;
const COVERAGE_FULL: f32 = 7.0;
const DEPTH_FULL_M: f32 = 10.0;

/// One plane of a reply as a PNG; `None` if it was not asked for, or is no picture.
pub fn plane_png(reply: &proto::PriorReply, plane: PriorPlane) -> Option<Vec<u8>> {
    let float = |bytes: &[u8]| <[u8; 4]>::try_from(bytes).map_or(0.0, f32::from_le_bytes);
    let shown = |image: Option<&proto::Image>, bytes: usize, share: &dyn Fn(&[u8]) -> f32| {
        let image = image?;
        let values: Vec<f32> = image.data.chunks_exact(bytes).map(share).collect();
        let (width, height) = (image.width as usize, image.height as usize);
        (values.len() == width * height).then(|| png(&heat(width, height, &values, 1.0)))
    };
    match plane {
        PriorPlane::Expected => Some(reply.expected.as_ref()?.data.clone()),
        PriorPlane::Uncertainty => shown(reply.uncertainty.as_ref(), 4, &|bytes| {
            float(bytes).sqrt() / UNCERTAINTY_FULL
        }),
        PriorPlane::Coverage => shown(reply.coverage.as_ref(), 1, &|bytes| {
            f32::from(bytes[0]) / COVERAGE_FULL
        }),
        PriorPlane::Depth => shown(reply.depth.as_ref(), 4, &|bytes| {
            float(bytes) / DEPTH_FULL_M
        }),
        PriorPlane::Parameters => None,
    }
}
