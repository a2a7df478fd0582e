// The observed image: three bytes a pixel, row by row, in words.

fn image_byte(index: u32) -> f32 {
    return f32((image[index / 4u] >> (8u * (index % 4u))) & 0xffu);
}

/// Y, Cb, Cr.
fn observe(pixel: u32) -> vec3<f32> {
    let first = 3u * pixel;
    return ycbcr_from_rgb(vec3<f32>(image_byte(first), image_byte(first + 1u), image_byte(first + 2u)));
}
