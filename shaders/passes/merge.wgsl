// One thread a pixel of the target: the views that see it, merged into the prior.

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> rules: Rules;
@group(0) @binding(2) var<uniform> views: array<View, VIEWS_MAX>;
@group(0) @binding(3) var<storage, read> depth_arena: array<u32>;
@group(0) @binding(5) var<storage, read> nearest: array<u32>;
@group(0) @binding(6) var<storage, read> triangles: array<u32>;
/// alpha, beta.
@group(0) @binding(7) var<storage, read_write> prior_spread: array<vec4<f32>>;
/// tau, p2.
@group(0) @binding(8) var<storage, read_write> prior_level: array<vec4<f32>>;
/// sigma; depth in metres, of the kept views.
@group(0) @binding(9) var<storage, read_write> prior_sigma: array<vec4<f32>>;
/// tau2; how many views saw the pixel, outvoted ones included.
@group(0) @binding(10) var<storage, read_write> prior_earlier: array<vec4<f32>>;

@compute @workgroup_size(8, 8, 1)
fn merge(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= frame.width || id.y >= frame.height {
        return;
    }
    let pixel = id.y * frame.width + id.x;
    let pixels = frame.width * frame.height;
    count = 0u;
    fresh = 0u;
    for (var i = 0u; i < frame.view_count; i++) {
        let number = triangles[i * pixels + pixel];
        if number != 0u {
            let view = views[i];
            let quad_number = (number - 1u) / 2u;
            let quad = load_quad(view, quad_number % view.width, quad_number / view.width);
            let surface = sample_quad(quad, ((number - 1u) & 1u) != 0u, f32(id.x), f32(id.y));
            push(sample_depth_m(nearest[i * pixels + pixel]), gather(view, surface.u, surface.v), view);
        }
    }
    if count == 0u {
        // As the paper starts (section V).
        prior_spread[pixel] = vec4<f32>(1.0, 1.0, 1.0, 1.0);
        prior_level[pixel] = vec4<f32>(0.0);
        prior_sigma[pixel] = vec4<f32>(5.0, 5.0, 5.0, 0.0);
        prior_earlier[pixel] = vec4<f32>(0.0);
        return;
    }
    var kept = all_views();
    if rules.depth_vote != 0u {
        kept = vote_on_depth(rules.depth_vote_tolerance);
    }
    if rules.colour_vote != 0u {
        kept = vote_on_colour(kept);
    }
    let belief = mean(kept);
    var earlier = vec4<f32>(0.0);
    if rules.earlier_appearance != 0u {
        earlier = earlier_appearance(kept);
    }
    prior_spread[pixel] = vec4<f32>(belief.alpha, belief.beta);
    prior_level[pixel] = vec4<f32>(belief.tau, earlier.w);
    prior_sigma[pixel] = vec4<f32>(belief.sigma, mean_depth_m(kept));
    prior_earlier[pixel] = vec4<f32>(earlier.xyz, f32(count));
}
