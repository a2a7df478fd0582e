// One thread a pixel: the prior after the observation, and the surprise.

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> rules: Rules;
@group(0) @binding(2) var<uniform> exposure: Exposure;
@group(0) @binding(3) var<storage, read> prior_spread: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> prior_level: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read> prior_sigma: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read> prior_earlier: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read> image: array<u32>;
/// Nats; 0 where unseen.
@group(0) @binding(8) var<storage, read_write> surprise_map: array<f32>;
@group(0) @binding(9) var<storage, read_write> posterior_records: array<vec4<u32>>;

/// tau and coverage.
fn place(pixel: u32) -> vec4<f32> {
    return vec4<f32>(prior_level[pixel].xyz, prior_earlier[pixel].w);
}

@compute @workgroup_size(8, 8, 1)
fn score(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= frame.width || id.y >= frame.height {
        return;
    }
    let pixel = id.y * frame.width + id.x;
    let spread = prior_spread[pixel];
    let level = prior_level[pixel];
    let earlier = prior_earlier[pixel];
    let stored = Belief(spread.x, spread.yzw, level.xyz, prior_sigma[pixel].xyz, earlier.xyz, level.w);
    var edge = vec3<f32>(0.0);
    if rules.edge_variance_px > 0.0 {
        var left = vec4<f32>(0.0);
        var right = vec4<f32>(0.0);
        var up = vec4<f32>(0.0);
        var down = vec4<f32>(0.0);
        if id.x > 0u {
            left = place(pixel - 1u);
        }
        if id.x + 1u < frame.width {
            right = place(pixel + 1u);
        }
        if id.y > 0u {
            up = place(pixel - frame.width);
        }
        if id.y + 1u < frame.height {
            down = place(pixel + frame.width);
        }
        edge = edge_gradient(vec4<f32>(level.xyz, earlier.w), left, right, up, down);
    }
    let settled = settle(stored, earlier.w, edge, observe(pixel) * exposure.inverse_gain);
    surprise_map[pixel] = settled.surprise;
    let record = pack(settled.posterior);
    posterior_records[2u * pixel] = record.spread;
    posterior_records[2u * pixel + 1u] = record.level;
}
