// Stored beliefs where the card has no half precision of its own: 32 bytes a pixel, halves taken apart.

@group(0) @binding(4) var<storage, read> record_arena: array<Record>;

/// Alpha, and beta of Y, Cb, Cr.
fn stored_spread(pixel: u32) -> vec4<f32> {
    let words = record_arena[pixel].spread;
    return vec4<f32>(unpack_spread(words.x), unpack_spread(words.y));
}

/// Sigma of Y, Cb, Cr, and p2.
fn stored_sigma(pixel: u32) -> vec4<f32> {
    let words = record_arena[pixel].spread;
    return vec4<f32>(unpack_spread(words.z), unpack_spread(words.w));
}

fn stored_level(pixel: u32) -> vec4<u32> {
    return record_arena[pixel].level;
}
