// One thread a block: its mean, and the median over 3x3 of them.

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> surprise_map: array<f32>;
@group(0) @binding(2) var<storage, read_write> block_means: array<f32>;
@group(0) @binding(3) var<storage, read_write> block_medians: array<f32>;

@compute @workgroup_size(8, 8, 1)
fn means(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= frame.blocks_wide || id.y >= frame.blocks_high {
        return;
    }
    var sum = 0.0;
    for (var y = 0u; y < BLOCK; y++) {
        for (var x = 0u; x < BLOCK; x++) {
            sum += surprise_map[(id.y * BLOCK + y) * frame.width + id.x * BLOCK + x];
        }
    }
    block_means[id.y * frame.blocks_wide + id.x] = sum / f32(BLOCK * BLOCK);
}

@compute @workgroup_size(8, 8, 1)
fn median(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= frame.blocks_wide || id.y >= frame.blocks_high {
        return;
    }
    var around: array<f32, 9>;
    for (var i = 0u; i < 9u; i++) {
        // Beyond the border the nearest block stands in.
        let y = clamp(i32(id.y + i / 3u) - 1, 0, i32(frame.blocks_high) - 1);
        let x = clamp(i32(id.x + i % 3u) - 1, 0, i32(frame.blocks_wide) - 1);
        around[i] = block_means[u32(y) * frame.blocks_wide + u32(x)];
    }
    block_medians[id.y * frame.blocks_wide + id.x] = median_of_nine(around);
}
