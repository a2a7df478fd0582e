// One thread a pixel: what the nearest views expect at half resolution and what was observed there, then means over 2x2
// for the coarser levels.

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> views: array<View, VIEWS_MAX>;
@group(0) @binding(2) var<uniform> level: Level;
@group(0) @binding(3) var<storage, read> depth_arena: array<u32>;
/// Luminance, and its variance.
@group(0) @binding(4) var<storage, read> level_arena: array<vec2<f32>>;
@group(0) @binding(5) var<storage, read> nearest: array<u32>;
@group(0) @binding(6) var<storage, read> triangles: array<u32>;
@group(0) @binding(7) var<storage, read> image: array<u32>;
/// Luminance and its variance, depth in metres or 0, observed luminance: level after level.
@group(0) @binding(8) var<storage, read_write> pyramid: array<vec4<f32>>;

/// Luminance and variance inside the triangle around a source position.
fn interpolate(view: View, u: f32, v: f32) -> vec2<f32> {
    let at_u = sample_position(u);
    let at_v = sample_position(v);
    let last_column = view.width - 2u;
    let last_row = view.height - 2u;
    let right = f32(at_u.y) * (1.0 / STEPS) + select(0.0, 1.0, at_u.x > last_column);
    let down = f32(at_v.y) * (1.0 / STEPS) + select(0.0, 1.0, at_v.x > last_row);
    let upper_left = view.first + min(at_v.x, last_row) * view.width + min(at_u.x, last_column);
    let lower_left = upper_left + view.width;
    let upper_right = level_arena[upper_left + 1u];
    let lower = level_arena[lower_left];
    if right + down <= 1.0 {
        return (1.0 - right - down) * level_arena[upper_left] + right * upper_right + down * lower;
    }
    return (right + down - 1.0) * level_arena[lower_left + 1u] + (1.0 - down) * upper_right + (1.0 - right) * lower;
}

@compute @workgroup_size(8, 8, 1)
fn expect(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= level.width || id.y >= level.height {
        return;
    }
    let pixel = id.y * level.width + id.x;
    let pixels = level.width * level.height;
    var said: array<Said, REFINE_VIEWS>;
    var count = 0u;
    for (var i = 0u; i < frame.view_count; i++) {
        let number = triangles[i * pixels + pixel];
        if number != 0u {
            let view = views[i];
            let quad_number = (number - 1u) / 2u;
            let quad = load_quad(view, quad_number % view.width, quad_number / view.width);
            let surface = sample_quad(quad, ((number - 1u) & 1u) != 0u, f32(id.x), f32(id.y));
            let here = interpolate(view, surface.u, surface.v);
            said[count] = Said(sample_depth_m(nearest[i * pixels + pixel]), here.x, here.y, view.weight);
            count += 1u;
        }
    }
    let upper_left = 2u * id.y * level.image_width + 2u * id.x;
    let lower_left = upper_left + level.image_width;
    let observed = (observe(upper_left).x + observe(upper_left + 1u).x + observe(lower_left).x + observe(lower_left + 1u).x) / 4.0;
    var expected = vec3<f32>(0.0);
    if count > 0u {
        expected = merge_said(&said, count);
    }
    pyramid[pixel] = vec4<f32>(expected, observed);
}

@compute @workgroup_size(8, 8, 1)
fn halve(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= level.width || id.y >= level.height {
        return;
    }
    let first = level.finer_first + 2u * id.y * level.finer_width + 2u * id.x;
    var sum = vec3<f32>(0.0);
    var count = 0.0;
    var observed = 0.0;
    for (var i = 0u; i < 4u; i++) {
        let fine = pyramid[first + i % 2u + (i / 2u) * level.finer_width];
        observed += fine.w;
        if fine.z > 0.0 {
            count += 1.0;
            sum += fine.xyz;
        }
    }
    // Predicted where at least three of the four are.
    let scale = select(0.0, 1.0 / max(count, 1.0), count >= 3.0);
    pyramid[level.first + id.y * level.width + id.x] = vec4<f32>(sum * scale, observed / 4.0);
}
