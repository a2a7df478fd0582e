// One thread a quad of a viewpoint: its candidate pixels are tested against the triangle on their side of the diagonal.

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(2) var<uniform> views: array<View, VIEWS_MAX>;
@group(0) @binding(3) var<storage, read> depth_arena: array<u32>;
/// Inverse depth of the nearest surface, a map a view; 0 = the viewpoint does not see the pixel.
@group(0) @binding(4) var<storage, read_write> nearest: array<atomic<u32>>;
/// The triangle there, counted from 1.
@group(0) @binding(5) var<storage, read_write> triangles: array<atomic<u32>>;

fn draw(id: vec3<u32>, number_pass: bool) {
    let view = views[id.z];
    if id.x + 1u >= view.width || id.y + 1u >= view.height {
        return;
    }
    let quad = load_quad(view, id.x, id.y);
    if quad.triangles == 0u {
        return;
    }
    var corners = quad.corners;
    // The box of the triangles that exist.
    if (quad.triangles & UPPER_LEFT) == 0u {
        corners[0] = corners[3];
    } else if (quad.triangles & LOWER_RIGHT) == 0u {
        corners[3] = corners[0];
    }
    let xs = vec4<f32>(corners[0].x, corners[1].x, corners[2].x, corners[3].x);
    let ys = vec4<f32>(corners[0].y, corners[1].y, corners[2].y, corners[3].y);
    let x_first = i32(max(ceil(min(min(xs.x, xs.y), min(xs.z, xs.w)) - EDGE_SLACK), 0.0));
    let y_first = i32(max(ceil(min(min(ys.x, ys.y), min(ys.z, ys.w)) - EDGE_SLACK), 0.0));
    let x_last = i32(min(floor(max(max(xs.x, xs.y), max(xs.z, xs.w)) + EDGE_SLACK), f32(frame.width) - 1.0));
    let y_last = i32(min(floor(max(max(ys.x, ys.y), max(ys.z, ys.w)) + EDGE_SLACK), f32(frame.height) - 1.0));
    let map = id.z * frame.width * frame.height;
    for (var y = y_first; y <= y_last; y++) {
        for (var x = x_first; x <= x_last; x++) {
            let lower_right = is_lower_right(quad, f32(x), f32(y));
            let surface = sample_quad(quad, lower_right, f32(x), f32(y));
            if surface.inside {
                let pixel = map + u32(y) * frame.width + u32(x);
                let inverse_depth = bitcast<u32>(surface.inverse_depth) >> INVERSE_DEPTH_SHIFT;
                if !number_pass {
                    atomicMax(&nearest[pixel], inverse_depth);
                } else if inverse_depth + 1u >= atomicLoad(&nearest[pixel]) {
                    // One step of slack: the two passes may be compiled to round differently.
                    let quad_number = id.y * view.width + id.x;
                    atomicMax(&triangles[pixel], 2u * quad_number + select(0u, 1u, lower_right) + 1u);
                }
            }
        }
    }
}

@compute @workgroup_size(8, 8, 1)
fn project_depth(@builtin(global_invocation_id) id: vec3<u32>) {
    draw(id, false);
}

@compute @workgroup_size(8, 8, 1)
fn project_triangle(@builtin(global_invocation_id) id: vec3<u32>) {
    draw(id, true);
}
