// Twin of src/lanes.rs: `ln` and `exp` from the same polynomials, because the built-in ones may be off by more
// than a belief can bear. Rounding is the built-in one: the trick with a large number does not survive compilers that
// reorder.

const LN2_HIGH: f32 = 0.6933594;
const LN2_LOW: f32 = -2.1219444e-4;
const LOG2_E: f32 = 1.4426950408889634;

/// Natural logarithm of a positive normal number.
fn ln(x: f32) -> f32 {
    // Split into 2^exponent * m, sqrt(1/2) <= m < sqrt(2).
    let offset = bitcast<u32>(x) - 0x3f3504f3u;
    let whole = bitcast<i32>(offset) >> 23u;
    let m = bitcast<f32>(bitcast<u32>(x) - (bitcast<u32>(whole) << 23u)) - 1.0;
    let exponent = f32(whole);
    var p = 7.0376836e-2;
    p = p * m - 1.151461e-1;
    p = p * m + 1.1676999e-1;
    p = p * m - 1.2420141e-1;
    p = p * m + 1.4249323e-1;
    p = p * m - 1.6668057e-1;
    p = p * m + 2.0000715e-1;
    p = p * m - 2.4999994e-1;
    p = p * m + 3.3333331e-1;
    let square = m * m;
    let tail = p * m * square + exponent * LN2_LOW - 0.5 * square;
    return exponent * LN2_HIGH + (m + tail);
}

/// ln(1 + x), x >= 0.
fn ln_1p(x: f32) -> f32 {
    // 1 + x would lose the digits of a small x.
    if x < 0.03 {
        return x * (1.0 - x * (0.5 - x * (1.0 / 3.0 - x * (0.25 - x * 0.2))));
    }
    return ln(1.0 + x);
}

/// e^x for -87 <= x <= 87; clamped outside.
fn exp_of(x_unbounded: f32) -> f32 {
    let x = clamp(x_unbounded, -87.0, 87.0);
    let n = round(x * LOG2_E);
    let r = x - n * LN2_HIGH - n * LN2_LOW;
    var p = 1.9875691e-4;
    p = p * r + 1.3981999e-3;
    p = p * r + 8.333452e-3;
    p = p * r + 4.1665796e-2;
    p = p * r + 1.6666666e-1;
    p = p * r + 5e-1;
    let fraction = p * r * r + r + 1.0;
    return fraction * bitcast<f32>(u32(i32(n) + 127) << 23u);
}
