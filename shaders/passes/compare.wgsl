// The pixels of a level against the estimate: their depths, their residuals' magnitudes, and their normal equations.

@group(0) @binding(0) var<uniform> level: Level;
@group(0) @binding(1) var<uniform> estimate: Estimate;
@group(0) @binding(2) var<storage, read> pyramid: array<vec4<f32>>;
/// Starts at 0.
@group(0) @binding(3) var<storage, read_write> histogram: array<atomic<u32>>;
/// SUMS of every workgroup.
@group(0) @binding(4) var<storage, read_write> partial_sums: array<f32>;

var<workgroup> bins: array<atomic<u32>, BINS>;
var<workgroup> counts: array<u32, REFINE_THREADS>;
var<workgroup> parts: array<f32, REFINE_THREADS * SUMS>;
var<workgroup> scale: f32;

/// Of this thread's pixels the first; the next one is REFINE_THREADS further.
fn first_pixel(group: vec3<u32>, thread: u32) -> u32 {
    return group.x * REFINE_THREADS * REFINE_PIXELS + thread;
}

fn flush(thread: u32) {
    for (var bin = thread; bin < BINS; bin += REFINE_THREADS) {
        let members = atomicLoad(&bins[bin]);
        if members > 0u {
            atomicAdd(&histogram[bin], members);
        }
    }
}

@compute @workgroup_size(64, 1, 1)
fn depths(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let first = first_pixel(group, thread);
    for (var i = 0u; i < REFINE_PIXELS; i++) {
        let pixel = first + i * REFINE_THREADS;
        if pixel < level.width * level.height {
            let depth_m = pyramid[level.first + pixel].z;
            if depth_m > 0.0 {
                atomicAdd(&bins[bin_of_depth(depth_m)], 1u);
            }
        }
    }
    workgroupBarrier();
    flush(thread);
}

/// A pixel against the estimate.
struct Compared {
    /// Predicted together with its four neighbours.
    comparable: bool,
    /// And seen by the estimate within the image.
    inside: bool,
    residual: f32,
    point: Point,
}

fn compared(pixel: u32) -> Compared {
    var found: Compared;
    let x = pixel % level.width;
    let y = pixel / level.width;
    if x < 1u || y < 1u || x + 1u >= level.width || y + 1u >= level.height {
        return found;
    }
    let at = level.first + pixel;
    let here = pyramid[at];
    let left = pyramid[at - 1u];
    let right = pyramid[at + 1u];
    let up = pyramid[at - level.width];
    let down = pyramid[at + level.width];
    if min(min(here.z, min(left.z, right.z)), min(up.z, down.z)) <= 0.0 {
        return found;
    }
    found.comparable = true;
    found.point = point_of(level, x, y, here, vec2<f32>(right.x - left.x, down.x - up.x) / 2.0);
    // In the real camera.
    let conjugate = vec4<f32>(-estimate.rotation.xyz, estimate.rotation.w);
    let q = rotated(conjugate, found.point.in_camera - estimate.translation);
    if q.z <= 0.0 {
        return found;
    }
    let u = level.focal.x * q.x / q.z + level.center.x;
    let v = level.focal.y * q.y / q.z + level.center.y;
    if u >= 0.0 && v >= 0.0 && u < f32(level.width - 1u) && v < f32(level.height - 1u) {
        found.inside = true;
        let column = u32(u);
        let row = u32(v);
        let first = level.first + row * level.width + column;
        let across = u - f32(column);
        let upper = mix(pyramid[first].w, pyramid[first + 1u].w, across);
        let lower = mix(pyramid[first + level.width].w, pyramid[first + level.width + 1u].w, across);
        let observed = mix(upper, lower, v - f32(row));
        found.residual = observed - estimate.gain * here.x - estimate.offset;
    }
    return found;
}

@compute @workgroup_size(64, 1, 1)
fn magnitudes(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    if level.index >= estimate.level_count {
        return;
    }
    let first = first_pixel(group, thread);
    for (var i = 0u; i < REFINE_PIXELS; i++) {
        let pixel = first + i * REFINE_THREADS;
        if pixel < level.width * level.height {
            let here = compared(pixel);
            if here.inside {
                atomicAdd(&bins[bin_of_magnitude(abs(here.residual) * here.point.inverse_sd)], 1u);
            }
        }
    }
    workgroupBarrier();
    flush(thread);
}

/// Leaves the residuals' scale in `scale`: every workgroup for itself, which costs less than waiting for one.
fn find_scale(thread: u32) {
    let bins_per_thread = BINS / REFINE_THREADS;
    var sum = 0u;
    for (var i = 0u; i < bins_per_thread; i++) {
        sum += atomicLoad(&histogram[thread * bins_per_thread + i]);
    }
    counts[thread] = sum;
    workgroupBarrier();
    if thread == 0u {
        var total_count = 0u;
        for (var i = 0u; i < REFINE_THREADS; i++) {
            total_count += counts[i];
        }
        var below = 0u;
        var part = 0u;
        while part + 1u < REFINE_THREADS && 2u * (below + counts[part]) < total_count {
            below += counts[part];
            part += 1u;
        }
        var bin = part * bins_per_thread;
        var members = atomicLoad(&histogram[bin]);
        while bin + 1u < BINS && 2u * (below + members) < total_count {
            below += members;
            bin += 1u;
            members = atomicLoad(&histogram[bin]);
        }
        scale = scale_in_bin(bin, below, members, total_count);
    }
    workgroupBarrier();
}

@compute @workgroup_size(64, 1, 1)
fn accumulate(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    if level.index >= estimate.level_count {
        return;
    }
    find_scale(thread);
    var sums: array<f32, SUMS>;
    let first = first_pixel(group, thread);
    for (var i = 0u; i < REFINE_PIXELS; i++) {
        let pixel = first + i * REFINE_THREADS;
        if pixel < level.width * level.height {
            let here = compared(pixel);
            if here.comparable {
                sums[HESSIAN + 10u] += 1.0;
            }
            if here.inside {
                let point = here.point;
                let normalised = here.residual * point.inverse_sd;
                let weight = weight_of(normalised, point.inverse_sd, scale);
                let along = estimate.gain * point.along;
                let around = estimate.gain * point.around;
                var j = array<f32, 8>(
                    along.x, along.y, along.z, around.x, around.y, around.z, point.luminance, 1.0,
                );
                var entry = 0u;
                for (var row = 0u; row < 8u; row++) {
                    let weighted = weight * j[row];
                    sums[HESSIAN + row] += weighted * here.residual;
                    for (var column = row; column < 8u; column++) {
                        sums[entry] += weighted * j[column];
                        entry += 1u;
                    }
                }
                sums[HESSIAN + 8u] += min(abs(normalised), RESIDUAL_CAP);
                sums[HESSIAN + 9u] += 1.0;
            }
        }
    }
    for (var entry = 0u; entry < SUMS; entry++) {
        parts[thread * SUMS + entry] = sums[entry];
    }
    workgroupBarrier();
    if thread < SUMS {
        var sum = 0.0;
        for (var other = 0u; other < REFINE_THREADS; other++) {
            sum += parts[other * SUMS + thread];
        }
        partial_sums[group.x * SUMS + thread] = sum;
    }
}
