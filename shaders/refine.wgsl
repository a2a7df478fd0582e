// Twin of src/stages/refine/mod.rs: what is expected and what was observed at one resolution, how a point is seen by an
// estimate, and the solution of the normal equations.

const REFINE_VIEWS: u32 = 3u;
const SENSOR_VARIANCE: f32 = 9.0;
const TUKEY: f32 = 4.685;
const NORMAL_FROM_MEDIAN: f32 = 1.4826;
const SCALE_MIN: f32 = 0.1;
const SCALE_MAX: f32 = 3.0;
const RESIDUAL_CAP: f32 = 4.0;
const CORRECTION_SD_MAX: f32 = 20.0;
const MISMATCH_MAX: f32 = 2.0;
const PIXELS_MIN: u32 = 200u;
const THIRD_LEVEL_PX: f32 = 2.5;
const FOURTH_LEVEL_PX: f32 = 4.0;
const DEPTH_TOLERANCE: f32 = 0.03;

/// Medians are found in histograms: of magnitudes up to those whose scale is beyond its bound, in even steps, and of
/// depths by their exponent and seven bits of the mantissa, from 0.02 m on.
const BINS: u32 = 2048u;
const MAGNITUDE_MAX: f32 = 2.0234723;
const DEPTH_BITS_FIRST: u32 = 15523u;
const DEPTH_BITS_SHIFT: u32 = 16u;

/// Products of two of eight derivatives.
const HESSIAN: u32 = 36u;
/// Those, the gradient; sum and number of capped residuals, number of comparable pixels.
const SUMS: u32 = 47u;
/// Invocations of a workgroup, and pixels of each.
const REFINE_THREADS: u32 = 64u;
const REFINE_PIXELS: u32 = 16u;

/// What a view says of a pixel.
struct Said {
    depth_m: f32,
    luminance: f32,
    variance: f32,
    weight: f32,
}

/// A comparable pixel: everything about it that does not change while the pose does.
struct Point {
    in_camera: vec3<f32>,
    /// d tau / d translation and d tau / d rotation of the template, without the gain.
    along: vec3<f32>,
    around: vec3<f32>,
    luminance: f32,
    inverse_sd: f32,
}

/// Luminance, variance with their disagreement, and depth of the views near the middle depth.
fn merge_said(said: ptr<function, array<Said, REFINE_VIEWS>>, count: u32) -> vec3<f32> {
    for (var i = 1u; i < count; i++) {
        for (var j = i; j > 0u && (*said)[j].depth_m < (*said)[j - 1u].depth_m; j--) {
            let nearer = (*said)[j];
            (*said)[j] = (*said)[j - 1u];
            (*said)[j - 1u] = nearer;
        }
    }
    let middle = (*said)[(count - 1u) / 2u].depth_m;
    var total = 0.0;
    var depth_m = 0.0;
    var luminance = 0.0;
    var square = 0.0;
    var variance = 0.0;
    for (var i = 0u; i < count; i++) {
        let here = (*said)[i];
        if abs(here.depth_m - middle) <= DEPTH_TOLERANCE * middle {
            total += here.weight;
            depth_m += here.weight * here.depth_m;
            luminance += here.weight * here.luminance;
            square += here.weight * here.luminance * here.luminance;
            variance += here.weight * here.variance;
        }
    }
    luminance /= total;
    let disagreement = max(square / total - luminance * luminance, 0.0);
    return vec3<f32>(luminance, variance / total + disagreement, depth_m / total);
}

/// A pixel of a level from itself and its neighbours.
fn point_of(level: Level, x: u32, y: u32, here: vec4<f32>, slope: vec2<f32>) -> Point {
    let slope_x = slope.x * level.focal.x;
    let slope_y = slope.y * level.focal.y;
    let z = here.z;
    let a = (f32(x) - level.center.x) / level.focal.x;
    let b = (f32(y) - level.center.y) / level.focal.y;
    // grad tau * d pi / d X, X = z (a, b, 1), then [I | -[X]x].
    let along = vec3<f32>(slope_x / z, slope_y / z, -(slope_x * a + slope_y * b) / z);
    let in_camera = vec3<f32>(a * z, b * z, z);
    return Point(in_camera, along, cross(in_camera, along), here.x, inverseSqrt(here.y + SENSOR_VARIANCE));
}

/// Tukey's weight of a residual, with that of the predicted variance.
fn weight_of(normalised: f32, inverse_sd: f32, scale: f32) -> f32 {
    let share = normalised / (TUKEY * scale);
    let tukey = 1.0 - share * share;
    return select(0.0, tukey * tukey * inverse_sd * inverse_sd / (scale * scale), abs(share) < 1.0);
}

fn bin_of_magnitude(magnitude: f32) -> u32 {
    return u32(clamp(magnitude * (f32(BINS) / MAGNITUDE_MAX), 0.0, f32(BINS - 1u)));
}

/// Where in the bin the median lies, as if its members were spread evenly.
fn scale_in_bin(bin: u32, below: u32, members: u32, total_count: u32) -> f32 {
    let inside = (f32(total_count) / 2.0 - f32(below)) / f32(max(members, 1u));
    let median = (f32(bin) + inside) * (MAGNITUDE_MAX / f32(BINS));
    return clamp(NORMAL_FROM_MEDIAN * median, SCALE_MIN, SCALE_MAX);
}

fn bin_of_depth(depth_m: f32) -> u32 {
    return clamp(bitcast<u32>(depth_m) >> DEPTH_BITS_SHIFT, DEPTH_BITS_FIRST, DEPTH_BITS_FIRST + BINS - 1u) - DEPTH_BITS_FIRST;
}

fn depth_of_bin_m(bin: u32) -> f32 {
    // The middle.
    return bitcast<f32>(((bin + DEPTH_BITS_FIRST) << DEPTH_BITS_SHIFT) | 0x8000u);
}

fn rotated(rotation: vec4<f32>, v: vec3<f32>) -> vec3<f32> {
    return v + 2.0 * cross(rotation.xyz, cross(rotation.xyz, v) + rotation.w * v);
}

/// One after the other, `last` first.
fn composed(first: vec4<f32>, last: vec4<f32>) -> vec4<f32> {
    let vector = first.w * last.xyz + last.w * first.xyz + cross(first.xyz, last.xyz);
    return vec4<f32>(vector, first.w * last.w - dot(first.xyz, last.xyz));
}

/// Rotation vector, radians. A series where it is small, because built-in functions lose digits there.
fn logarithm(rotation: vec4<f32>) -> vec3<f32> {
    let square = dot(rotation.xyz, rotation.xyz);
    if square < 0.01 {
        return 2.0 * rotation.xyz * (1.0 + square * (1.0 / 6.0 + square * (0.075 + square * (15.0 / 336.0))));
    }
    let sine = sqrt(square);
    return 2.0 * atan2(sine, rotation.w) / sine * rotation.xyz;
}

/// Of a rotation vector up to a radian; longer ones are cut.
fn exponential(vector: vec3<f32>) -> vec4<f32> {
    let length_square = dot(vector, vector);
    let cut = vector * inverseSqrt(max(length_square, 1.0));
    let s = min(length_square, 1.0);
    let sine = cut * (0.5 - s * (1.0 / 48.0 - s * (1.0 / 3840.0 - s / 645120.0)));
    return vec4<f32>(sine, sqrt(1.0 - dot(sine, sine)));
}

/// Whether an estimate explains the image better than the given pose and lies within what the noise allows.
fn is_accepted(level: Level, found: Estimate) -> bool {
    if found.point_count < PIXELS_MIN || min(found.mismatch.y, found.mismatch_before.y) <= 0.0 {
        return false;
    }
    let before = found.mismatch_before.x / found.mismatch_before.y;
    let after = found.mismatch.x / found.mismatch.y;
    let moved = abs(found.translation) < vec3<f32>(CORRECTION_SD_MAX * level.position_sd_m);
    let turned = abs(logarithm(found.rotation)) < vec3<f32>(CORRECTION_SD_MAX * level.rotation_sd_rad);
    return after < MISMATCH_MAX && after < before && all(moved) && all(turned);
}

/// A view as the real camera sees it, from how the given one does: its rows are taken out of the image, moved, and
/// projected again.
fn seen_really(view: View, level: Level, found: Estimate) -> View {
    let focal = level.image_focal;
    let center = level.image_center;
    let x = (view.h_x - center.x * view.h_z) / focal.x;
    let y = (view.h_y - center.y * view.h_z) / focal.y;
    let back = vec4<f32>(-found.rotation.xyz, found.rotation.w);
    var rows = array<vec4<f32>, 3>();
    for (var column = 0u; column < 4u; column++) {
        var given = vec3<f32>(x[column], y[column], view.h_z[column]);
        if column == 3u {
            given -= found.translation;
        }
        let real = rotated(back, given);
        for (var axis = 0u; axis < 3u; axis++) {
            rows[axis][column] = real[axis];
        }
    }
    var seen = view;
    seen.h_x = focal.x * rows[0] + center.x * rows[2];
    seen.h_y = focal.y * rows[1] + center.y * rows[2];
    seen.h_z = rows[2];
    return seen;
}

struct Solution {
    found: bool,
    d: array<f32, 8>,
}

/// Solves a symmetric positive definite system by Cholesky's decomposition, scaled so that its diagonal is 1: metres,
/// radians and grey levels differ by far more than single precision bears.
fn solve_normal(normal: ptr<function, array<array<f32, 8>, 8>>, right: array<f32, 8>) -> Solution {
    var solution: Solution;
    var scale: array<f32, 8>;
    for (var i = 0u; i < 8u; i++) {
        if (*normal)[i][i] <= 0.0 {
            return solution;
        }
        scale[i] = inverseSqrt((*normal)[i][i]);
    }
    for (var i = 0u; i < 8u; i++) {
        for (var j = 0u; j <= i; j++) {
            var sum = (*normal)[i][j] * scale[i] * scale[j];
            for (var k = 0u; k < j; k++) {
                sum -= (*normal)[i][k] * (*normal)[j][k];
            }
            if i > j {
                (*normal)[i][j] = sum / (*normal)[j][j];
            } else {
                if !(sum > 0.0) {
                    return solution;
                }
                (*normal)[i][i] = sqrt(sum);
            }
        }
    }
    var d: array<f32, 8>;
    for (var i = 0u; i < 8u; i++) {
        var sum = right[i] * scale[i];
        for (var k = 0u; k < i; k++) {
            sum -= (*normal)[i][k] * d[k];
        }
        d[i] = sum / (*normal)[i][i];
    }
    for (var back = 0u; back < 8u; back++) {
        let i = 7u - back;
        var sum = d[i];
        for (var k = i + 1u; k < 8u; k++) {
            sum -= (*normal)[k][i] * d[k];
        }
        d[i] = sum / (*normal)[i][i];
    }
    for (var i = 0u; i < 8u; i++) {
        solution.d[i] = d[i] * scale[i];
    }
    solution.found = true;
    return solution;
}
