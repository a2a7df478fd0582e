enable f16;

// Stored beliefs where the card has half precision: the same bytes, read as what they are.

struct NativeRecord {
    /// Alpha, and beta of Y, Cb, Cr.
    spread: vec4<f16>,
    /// Sigma of Y, Cb, Cr, and p2.
    sigma: vec4<f16>,
    level: vec4<u32>,
}

@group(0) @binding(4) var<storage, read> record_arena: array<NativeRecord>;

fn stored_spread(pixel: u32) -> vec4<f32> {
    return vec4<f32>(record_arena[pixel].spread);
}

fn stored_sigma(pixel: u32) -> vec4<f32> {
    return vec4<f32>(record_arena[pixel].sigma);
}

fn stored_level(pixel: u32) -> vec4<u32> {
    return record_arena[pixel].level;
}
