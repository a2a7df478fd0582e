// The exposure gain of the frame, and how many pixels were seen: a histogram in workgroup memory, then its median.

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> rules: Rules;
@group(0) @binding(2) var<storage, read> prior_level: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> prior_earlier: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> image: array<u32>;
/// The bins, then how many pixels were seen. Starts at 0.
@group(0) @binding(5) var<storage, read_write> histogram: array<atomic<u32>>;
@group(0) @binding(6) var<storage, read_write> exposure: Exposure;

const THREADS: u32 = 256u;
/// Pixels of a thread: many, because every workgroup adds up to 2048 bins to the others'.
const PIXELS_PER_THREAD: u32 = 32u;

var<workgroup> bins: array<atomic<u32>, BINS>;
var<workgroup> seen: atomic<u32>;
var<workgroup> sums: array<u32, THREADS>;

@compute @workgroup_size(256, 1, 1)
fn expose(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    // Workgroup memory starts at 0.
    let pixels = frame.width * frame.height;
    let first = group.x * THREADS * PIXELS_PER_THREAD + thread;
    for (var i = 0u; i < PIXELS_PER_THREAD; i++) {
        let pixel = first + i * THREADS;
        if pixel < pixels {
            let coverage = prior_earlier[pixel].w;
            let expected = prior_level[pixel].x;
            let observed = observe(pixel).x;
            if coverage > 0.0 {
                atomicAdd(&seen, 1u);
            }
            if comparable(expected, coverage, observed) {
                atomicAdd(&bins[bin_of(expected, observed)], 1u);
            }
        }
    }
    workgroupBarrier();
    for (var bin = thread; bin < BINS; bin += THREADS) {
        let members = atomicLoad(&bins[bin]);
        if members > 0u {
            atomicAdd(&histogram[bin], members);
        }
    }
    if thread == 0u {
        atomicAdd(&histogram[BINS], atomicLoad(&seen));
    }
}

@compute @workgroup_size(256, 1, 1)
fn gain(@builtin(local_invocation_index) thread: u32) {
    let bins_per_thread = BINS / THREADS;
    var sum = 0u;
    for (var i = 0u; i < bins_per_thread; i++) {
        sum += atomicLoad(&histogram[thread * bins_per_thread + i]);
    }
    sums[thread] = sum;
    workgroupBarrier();
    if thread != 0u {
        return;
    }
    var total_count = 0u;
    for (var i = 0u; i < THREADS; i++) {
        total_count += sums[i];
    }
    var found = 1.0;
    if rules.exposure_gain != 0u && total_count > 0u {
        var below = 0u;
        var part = 0u;
        while 2u * (below + sums[part]) < total_count {
            below += sums[part];
            part += 1u;
        }
        var bin = part * bins_per_thread;
        var members = atomicLoad(&histogram[bin]);
        while 2u * (below + members) < total_count {
            below += members;
            bin += 1u;
            members = atomicLoad(&histogram[bin]);
        }
        found = gain_in_bin(bin, below, members, total_count);
    }
    exposure.gain = found;
    exposure.inverse_gain = 1.0 / found;
    exposure.seen = atomicLoad(&histogram[BINS]);
}
