// Twin of src/model/belief.rs: a pixel's belief, its record, and the colour transform.

struct Belief {
    alpha: f32,
    beta: vec3<f32>,
    tau: vec3<f32>,
    sigma: vec3<f32>,
    tau2: vec3<f32>,
    p2: f32,
}

/// Eight halves, then eight 16-bit integers.
struct Record {
    spread: vec4<u32>,
    level: vec4<u32>,
}

const LEVEL_SCALE: f32 = 128.0;
/// Grey level that is stored as 0, of luminance; of Cb and Cr it is 0.
const LEVEL_OFFSET_Y: f32 = 128.0;
const SPREAD_MIN: f32 = 6.1035156e-5;
const SPREAD_MAX: f32 = 65504.0;
/// 2^-112: the difference of the exponent biases of f16 and f32.
const BIAS_SCALE_INVERSE: f32 = 1.925929944387236e-34;

/// 2^112.
const BIAS_SCALE: f32 = 5.192296858534828e33;

/// Two non-negative halves.
fn unpack_spread(word: u32) -> vec2<f32> {
    return vec2<f32>(bitcast<f32>((word & 0xffffu) << 13u), bitcast<f32>((word >> 16u) << 13u)) * BIAS_SCALE;
}

/// Nearest f16 of a value that f16 holds with full precision, or of 0; ties to even. `pack2x16float` may round another way.
fn f16_from_f32(value: f32) -> u32 {
    let bits = bitcast<u32>(value * BIAS_SCALE_INVERSE);
    return (bits + 0x0fffu + ((bits >> 13u) & 1u)) >> 13u;
}

fn pack_spread(low: f32, high: f32) -> u32 {
    return f16_from_f32(clamp(low, SPREAD_MIN, SPREAD_MAX)) | (f16_from_f32(clamp(high, SPREAD_MIN, SPREAD_MAX)) << 16u);
}

fn pack_level(low: f32, high: f32) -> u32 {
    let steps = vec2<i32>(clamp(round(vec2<f32>(low, high) * LEVEL_SCALE), vec2<f32>(-32768.0), vec2<f32>(32767.0)));
    return (bitcast<u32>(steps.x) & 0xffffu) | (bitcast<u32>(steps.y) << 16u);
}

fn pack(belief: Belief) -> Record {
    let p2 = f16_from_f32(clamp(belief.p2, 0.0, 1.0));
    let sigma_cr = f16_from_f32(clamp(belief.sigma.z, SPREAD_MIN, SPREAD_MAX));
    return Record(
        vec4<u32>(
            pack_spread(belief.alpha, belief.beta.x),
            pack_spread(belief.beta.y, belief.beta.z),
            pack_spread(belief.sigma.x, belief.sigma.y),
            sigma_cr | (p2 << 16u),
        ),
        vec4<u32>(
            pack_level(belief.tau.x - LEVEL_OFFSET_Y, belief.tau.y),
            pack_level(belief.tau.z, belief.tau2.x - LEVEL_OFFSET_Y),
            pack_level(belief.tau2.y, belief.tau2.z),
            0u,
        ),
    );
}

/// Two stored levels, without the offset.
fn unpack_level(word: u32) -> vec2<f32> {
    let steps = vec2<i32>(bitcast<i32>(word << 16u) >> 16u, bitcast<i32>(word) >> 16u);
    return vec2<f32>(steps) * (1.0 / LEVEL_SCALE);
}

/// JPEG 2000 irreversible colour transform of one RGB pixel, 0..255 -> Y 0..255, Cb and Cr centred on 0.
fn ycbcr_from_rgb(rgb: vec3<f32>) -> vec3<f32> {
    return vec3<f32>(
        0.299 * rgb.x + 0.587 * rgb.y + 0.114 * rgb.z,
        -0.16875 * rgb.x - 0.33126 * rgb.y + 0.5 * rgb.z,
        0.5 * rgb.x - 0.41869 * rgb.y - 0.08131 * rgb.z,
    );
}
