//! A box of a frame and its surroundings, small enough to keep: as it was seen and as it was expected.

use image::{ImageBuffer, Rgb, imageops};

use crate::{
    model::{event::Picture, frame::RgbImage, report::PixelBox},
    stages::interpolate::prior::Prior,
};

/// Least surroundings on every side, pixels; otherwise half of the box.
const MARGIN_MIN_PX: u32 = 16;
/// Shrunk to at most [`Picture::SIDE_MAX`] a side.
pub fn picture(image: &RgbImage, prior: Option<&Prior>, pixel_box: PixelBox) -> Picture {
    let (x, y) = (
        around(pixel_box.x_min, pixel_box.x_max, image.width),
        around(pixel_box.y_min, pixel_box.y_max, image.height),
    );
    let seen = shrunk(x, y, |x, y| {
        let at = 3 * (y * image.width + x);
        [image.data[at], image.data[at + 1], image.data[at + 2]]
    });
    let expected = prior.map(|prior| shrunk(x, y, |x, y| prior.row(y).expected_rgb(x)));
    Picture { seen, expected }
}

/// First and last plus one pixel along one side of the image.
fn around(min: u32, max: u32, size: usize) -> (u32, u32) {
    let margin = (max.saturating_sub(min) / 2).max(MARGIN_MIN_PX);
    (min.saturating_sub(margin), (max + margin).min(size as u32))
}

fn shrunk(x: (u32, u32), y: (u32, u32), rgb: impl Fn(usize, usize) -> [u8; 3]) -> RgbImage {
    let (width, height) = (x.1.saturating_sub(x.0), y.1.saturating_sub(y.0));
    let crop = ImageBuffer::from_fn(width, height, |column, row| {
        Rgb(rgb((x.0 + column) as usize, (y.0 + row) as usize))
    });
    let longer = width.max(height);
    let small = if longer <= Picture::SIDE_MAX {
        crop
    } else {
        let side = |side: u32| (side * Picture::SIDE_MAX / longer).max(1);
        imageops::thumbnail(&crop, side(width), side(height))
    };
    RgbImage {
        width: small.width() as usize,
        height: small.height() as usize,
        data: small.into_raw(),
    }
}
