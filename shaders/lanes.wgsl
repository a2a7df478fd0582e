// Twin of src/lanes.rs: `ln` and `exp2` from the same polynomials, because the built-in ones may be off by more
// than a belief can bear. Rounding is the built-in one: the trick with a large number does not survive compilers that
// reorder.

const LN2_HIGH: f32 = 0.6933594;
const LN2_LOW: f32 = -2.1219444e-4;
const LN_2: f32 = 0.6931471805599453;
const LOG2_E: f32 = 1.4426950408889634;

/// Natural logarithm of a positive normal number.
fn ln(x: f32) -> f32 {
    // Split into 2^exponent * m, sqrt(1/2) <= m < sqrt(2).
    let offset = bitcast<u32>(x) - 0x3f3504f3u;
    let whole = bitcast<i32>(offset) >> 23u;
    let m = bitcast<f32>(bitcast<u32>(x) - (bitcast<u32>(whole) << 23u)) - 1.0;
    let exponent = f32(whole);
    let square = m * m;
    let fourth = square * square;
    let highest = (7.0376836e-2 * m - 1.151461e-1) * square + (1.1676999e-1 * m - 1.2420141e-1);
    let middle = (1.4249323e-1 * m - 1.6668057e-1) * square + (2.0000715e-1 * m - 2.4999994e-1);
    let p = (highest * fourth + middle) * m + 3.3333331e-1;
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

/// 2^x for -126 <= x <= 127; anything outside.
fn exp2_of(x: f32) -> f32 {
    let whole = round(x);
    let f = x - whole;
    let square = f * f;
    let high = 1.3300264e-3 * f + 9.669708e-3;
    let middle = 5.55056e-2 * f + 2.4022281e-1;
    let fraction = (high * square + middle) * square + LN_2 * f + 1.0;
    return bitcast<f32>(bitcast<i32>(fraction) + (i32(whole) << 23u));
}
