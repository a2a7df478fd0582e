// One workgroup: the estimate begins, takes a Gauss-Newton step, or is judged. Each leaves the histogram at 0.

@group(0) @binding(0) var<uniform> level: Level;
@group(0) @binding(1) var<storage, read_write> estimate: Estimate;
@group(0) @binding(2) var<storage, read_write> histogram: array<u32>;
@group(0) @binding(3) var<storage, read> partial_sums: array<f32>;

var<workgroup> sums: array<f32, SUMS>;

fn clear_histogram(thread: u32) {
    for (var bin = thread; bin < BINS; bin += REFINE_THREADS) {
        histogram[bin] = 0u;
    }
}

/// How many levels catch the expected error; 0 when too little is predicted.
fn level_count() -> u32 {
    var total_count = 0u;
    for (var bin = 0u; bin < BINS; bin++) {
        total_count += histogram[bin];
    }
    if total_count < PIXELS_MIN {
        return 0u;
    }
    var rank = total_count / 2u;
    var middle = 0u;
    while rank >= histogram[middle] {
        rank -= histogram[middle];
        middle += 1u;
    }
    let from_position = level.image_focal.x * level.position_sd_m / depth_of_bin_m(middle);
    let from_rotation = level.image_focal.x * level.rotation_sd_rad;
    let error_px = length(vec2<f32>(from_position, from_rotation));
    return 2u + select(0u, 1u, error_px > THIRD_LEVEL_PX) + select(0u, 1u, error_px > FOURTH_LEVEL_PX);
}

@compute @workgroup_size(64, 1, 1)
fn begin(@builtin(local_invocation_index) thread: u32) {
    if thread == 0u {
        estimate.rotation = vec4<f32>(0.0, 0.0, 0.0, 1.0);
        estimate.translation = vec3<f32>(0.0);
        estimate.gain = 1.0;
        estimate.mismatch = vec2<f32>(0.0);
        estimate.mismatch_before = vec2<f32>(0.0);
        estimate.offset = 0.0;
        estimate.level_count = level_count();
        estimate.point_count = 0u;
        estimate.accepted = 0u;
    }
    storageBarrier();
    clear_histogram(thread);
}

/// Adds up what the workgroups have found. Nothing else may have been written where the level is not looked at.
fn add_up(thread: u32) {
    let pixels_per_group = REFINE_THREADS * REFINE_PIXELS;
    let groups = (level.width * level.height + pixels_per_group - 1u) / pixels_per_group;
    if thread < SUMS {
        var sum = 0.0;
        for (var group = 0u; group < groups; group++) {
            sum += partial_sums[group * SUMS + thread];
        }
        sums[thread] = sum;
    }
    workgroupBarrier();
}

@compute @workgroup_size(64, 1, 1)
fn step(@builtin(local_invocation_index) thread: u32) {
    clear_histogram(thread);
    add_up(thread);
    if thread != 0u || level.index >= estimate.level_count || sums[HESSIAN + 9u] < f32(PIXELS_MIN) {
        return;
    }
    let around = logarithm(estimate.rotation);
    let deviation = array<f32, 8>(
        estimate.translation.x, estimate.translation.y, estimate.translation.z,
        around.x, around.y, around.z,
        estimate.gain - 1.0, estimate.offset,
    );
    var normal: array<array<f32, 8>, 8>;
    var right: array<f32, 8>;
    var entry = 0u;
    for (var row = 0u; row < 8u; row++) {
        for (var column = row; column < 8u; column++) {
            normal[row][column] = sums[entry] * level.inverse_discount;
            normal[column][row] = normal[row][column];
            entry += 1u;
        }
        let certainty = level.certainty[row / 4u][row % 4u];
        normal[row][row] += certainty;
        right[row] = sums[HESSIAN + row] * level.inverse_discount - certainty * deviation[row];
    }
    let solution = solve_normal(&normal, right);
    if !solution.found {
        return;
    }
    // The template moved by d: the real camera sees its point X at (exp(d) E)^-1 X.
    let d = solution.d;
    let turn = exponential(vec3<f32>(d[3], d[4], d[5]));
    estimate.translation = rotated(turn, estimate.translation) + vec3<f32>(d[0], d[1], d[2]);
    estimate.rotation = normalize(composed(turn, estimate.rotation));
    estimate.gain += d[6];
    estimate.offset += d[7];
}

@compute @workgroup_size(64, 1, 1)
fn judge(@builtin(local_invocation_index) thread: u32) {
    clear_histogram(thread);
    add_up(thread);
    if thread != 0u || level.index >= estimate.level_count {
        return;
    }
    estimate.mismatch_before = estimate.mismatch;
    estimate.mismatch = vec2<f32>(sums[HESSIAN + 8u], sums[HESSIAN + 9u]);
    estimate.point_count = u32(sums[HESSIAN + 10u]);
}
