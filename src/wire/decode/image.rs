//! Unpacks pictures: `Image` -> RGB bytes or depth in metres. Everything is measured before memory is taken for it.

use std::io::Cursor;

use image::{DynamicImage, ImageDecoder, ImageFormat, ImageReader};

use super::{Limits, shortened, size};
use crate::{
    model::{
        frame::{GreyImage, RgbImage},
        refusal::Refusal,
    },
    stages::interpolate::sample::SIDE_MAX,
    wire::proto::Image,
};

const METRES_PER_MILLIMETRE: f32 = 1e-3;
/// A decoder may take this much for each pixel beside its result: 16 bit RGBA, twice.
const DECODER_BYTES_PER_PIXEL: u64 = 16;

/// jpeg, png, rgb8, bgr8 or mono8, which has no chrominance.
///
/// # Errors
/// Unknown encodings, sizes and byte counts that disagree, pictures above the limit, broken files.
pub fn colour(image: &Image, limits: Limits) -> Result<RgbImage, Refusal> {
    let (width, height, data) = match image.encoding.as_str() {
        "jpeg" => compressed_colour(image, ImageFormat::Jpeg, limits)?,
        "png" => compressed_colour(image, ImageFormat::Png, limits)?,
        "rgb8" => raw(image, limits, 3, 3, |row, data| data.extend_from_slice(row))?,
        "bgr8" => raw(image, limits, 3, 3, |row, data| {
            data.extend(row.chunks_exact(3).flat_map(|bgr| [bgr[2], bgr[1], bgr[0]]));
        })?,
        "mono8" => raw(image, limits, 1, 3, |row, data| {
            data.extend(row.iter().flat_map(|&grey| [grey; 3]));
        })?,
        other => {
            return Err(Refusal::new(
                "image_encoding",
                format!(
                    "the image encoding `{}` is unknown: use jpeg, png, rgb8, bgr8 or mono8",
                    shortened(other)
                ),
            ));
        }
    };
    Ok(RgbImage {
        width,
        height,
        data,
    })
}

/// The luminance of what [`colour`] takes.
///
/// # Errors
/// As [`colour`].
pub fn grey(image: &Image, limits: Limits) -> Result<GreyImage, Refusal> {
    if image.encoding != "mono8" {
        return Ok(colour(image, limits)?.grey());
    }
    let (width, height, data) = raw(image, limits, 1, 1, |row, data| data.extend_from_slice(row))?;
    Ok(GreyImage {
        width,
        height,
        data,
    })
}

/// Width, height and metres: 16UC1, 32FC1 or a png of 16 bit millimetres. What is not a positive number is 0, none.
///
/// # Errors
/// As [`colour`].
pub fn depth_m(image: &Image, limits: Limits) -> Result<(usize, usize, Vec<f32>), Refusal> {
    let from_mm = |mm: u16| f32::from(mm) * METRES_PER_MILLIMETRE;
    Ok(match image.encoding.as_str() {
        "16UC1" => raw(image, limits, 2, 1, |row, data| {
            data.extend(
                row.chunks_exact(2)
                    .map(|mm| from_mm(u16::from_le_bytes([mm[0], mm[1]]))),
            );
        })?,
        "32FC1" => raw(image, limits, 4, 1, |row, data| {
            data.extend(
                row.chunks_exact(4)
                    .map(|z| f32::from_le_bytes([z[0], z[1], z[2], z[3]]))
                    .map(|z| if z.is_finite() && z > 0.0 { z } else { 0.0 }),
            );
        })?,
        "png" => {
            let picture = compressed(image, ImageFormat::Png, limits)?;
            let DynamicImage::ImageLuma16(millimetres) = picture else {
                return Err(Refusal::new(
                    "depth_encoding",
                    "a depth png must have one channel of 16 bits, millimetres",
                ));
            };
            let (width, height) = millimetres.dimensions();
            let depth_m = millimetres.into_raw().into_iter().map(from_mm).collect();
            (width as usize, height as usize, depth_m)
        }
        other => {
            return Err(Refusal::new(
                "depth_encoding",
                format!(
                    "the depth encoding `{}` is unknown: use 16UC1 (millimetres), 32FC1 (metres) or png (16 bit millimetres)",
                    shortened(other)
                ),
            ));
        }
    })
}

/// Rows of a raw picture, appended one by one.
fn raw<T>(
    image: &Image,
    limits: Limits,
    bytes_per_pixel: usize,
    values_per_pixel: usize,
    append: impl Fn(&[u8], &mut Vec<T>),
) -> Result<(usize, usize, Vec<T>), Refusal> {
    let (width, height) = bounded(image.width, image.height, limits)?;
    // Sides are at most SIDE_MAX, so none of these products overflows 64 bits.
    let row_bytes = width * bytes_per_pixel;
    let step = match image.step as usize {
        0 => row_bytes,
        step => step,
    };
    if step < row_bytes {
        return Err(Refusal::new(
            "step",
            format!(
                "a step of {step} bytes is shorter than a row of {width} {} pixels, {row_bytes} bytes: 0 means packed",
                image.encoding
            ),
        ));
    }
    let expected = step as u64 * height as u64;
    // Some drivers leave out the padding of the last row.
    let least = step as u64 * (height as u64 - 1) + row_bytes as u64;
    let got = image.data.len() as u64;
    if got != expected && got != least {
        return Err(Refusal::new(
            "byte_count",
            format!(
                "{got} bytes came for {width}x{height} {} pixels with a step of {step}, but {expected} are needed",
                image.encoding
            ),
        ));
    }
    let mut data = Vec::with_capacity(width * height * values_per_pixel);
    for row in image.data.chunks(step) {
        append(&row[..row_bytes], &mut data);
    }
    Ok((width, height, data))
}

fn compressed_colour(
    image: &Image,
    format: ImageFormat,
    limits: Limits,
) -> Result<(usize, usize, Vec<u8>), Refusal> {
    let picture = compressed(image, format, limits)?.into_rgb8();
    let (width, height) = picture.dimensions();
    Ok((width as usize, height as usize, picture.into_raw()))
}

/// A jpeg or png whose header was checked before its pixels were touched.
fn compressed(image: &Image, format: ImageFormat, limits: Limits) -> Result<DynamicImage, Refusal> {
    let broken = |error: image::ImageError| {
        Refusal::new(
            "image_data",
            format!(
                "the {} cannot be decoded: {error}; was it cut short on its way?",
                image.encoding
            ),
        )
    };
    let mut reader = ImageReader::with_format(Cursor::new(image.data.as_slice()), format);
    let mut decoder_limits = image::Limits::no_limits();
    decoder_limits.max_alloc =
        Some(limits.image_pixels_max as u64 * DECODER_BYTES_PER_PIXEL + (1 << 20));
    reader.limits(decoder_limits);
    let decoder = reader.into_decoder().map_err(broken)?;
    let (width, height) = decoder.dimensions();
    bounded(width, height, limits)?;
    let claimed = (image.width, image.height);
    if claimed != (0, 0) && claimed != (width, height) {
        return Err(Refusal::new(
            "image_size",
            format!(
                "the {} has {width}x{height} pixels but the message says {}x{}: set both alike, or the message's to 0",
                image.encoding, image.width, image.height
            ),
        ));
    }
    if format == ImageFormat::Jpeg && !ends(&image.data) {
        return Err(Refusal::new(
            "image_data",
            "the jpeg has no end (FF D9): was it cut short on its way?",
        ));
    }
    DynamicImage::from_decoder(decoder).map_err(broken)
}

/// Whether a jpeg is there to its end: the decoder makes grey of what is not. Some cameras pad with zeros.
fn ends(jpeg: &[u8]) -> bool {
    let padding = jpeg.iter().rev().take_while(|byte| **byte == 0).count();
    jpeg[..jpeg.len() - padding].ends_with(&[0xff, 0xd9])
}

/// Sides that can be used and not too many pixels.
fn bounded(width: u32, height: u32, limits: Limits) -> Result<(usize, usize), Refusal> {
    let (width, height) = size(width, height)?;
    if width * height > limits.image_pixels_max {
        return Err(Refusal::new(
            "image_too_large",
            format!(
                "{width}x{height} pixels are more than image_pixels_max = {}: send smaller pictures, or raise the setting (sides up to {SIDE_MAX})",
                limits.image_pixels_max
            ),
        ));
    }
    Ok((width, height))
}
