// Twin of src/stages/interpolate/project.rs: the meshes of the viewpoints, drawn into the target camera.
//
// Vertices are pulled from the stored depth, no vertex is kept. The map's sample is 24 bits of inverse depth and,
// because there are no 64-bit atomics, the number of the triangle instead of its position: one pass takes the maximum
// of the inverse depths, a second the greatest number among the triangles at that depth; whoever reads the map computes
// the position again. A number holds 2^31 pixels a viewpoint.

/// Steps of u and v per source pixel.
const STEPS: f32 = 128.0;
const INVERSE_DEPTH_SHIFT: u32 = 7u;
const NEAR_M: f32 = 0.02;
const FAR_PX: f32 = 1e6;
const EDGE_SLACK: f32 = 1e-3;
const UPPER_LEFT: u32 = 1u;
const LOWER_RIGHT: u32 = 2u;

struct Vertex {
    x: f32,
    y: f32,
    /// 1/depth in the target camera; 0 where the vertex cannot be drawn.
    inverse_depth: f32,
    column: f32,
    row: f32,
}

/// Upper left, upper right, lower left and lower right corner, and which of the two triangles exist.
struct Quad {
    corners: array<Vertex, 4>,
    triangles: u32,
}

/// A point of a viewpoint's surface.
struct Surface {
    inside: bool,
    inverse_depth: f32,
    u: f32,
    v: f32,
}

fn source(view: View, column: u32, row: u32) -> u32 {
    return depth_arena[view.first + row * view.width + column];
}

/// The two lowest bits say which triangles exist, as Mesh::cut; the others are the depth, metres.
fn source_depth_m(bits: u32) -> f32 {
    return bitcast<f32>(bits & ~(UPPER_LEFT | LOWER_RIGHT));
}

fn transform(view: View, column: u32, row: u32, z: f32) -> Vertex {
    let ray = vec3<f32>(f32(column), f32(row), 1.0);
    let q_x = z * dot(view.h_x.xyz, ray) + view.h_x.w;
    let q_y = z * dot(view.h_y.xyz, ray) + view.h_y.w;
    let q_z = z * dot(view.h_z.xyz, ray) + view.h_z.w;
    if z <= 0.0 || q_z < NEAR_M {
        return Vertex(0.0, 0.0, 0.0, ray.x, ray.y);
    }
    let inverse_depth = 1.0 / q_z;
    return Vertex(
        clamp(q_x * inverse_depth, -FAR_PX, FAR_PX),
        clamp(q_y * inverse_depth, -FAR_PX, FAR_PX),
        inverse_depth,
        ray.x,
        ray.y,
    );
}

fn load_quad(view: View, column: u32, row: u32) -> Quad {
    let upper_left = source(view, column, row);
    var quad: Quad;
    quad.triangles = upper_left & (UPPER_LEFT | LOWER_RIGHT);
    if quad.triangles != 0u {
        quad.corners[0] = transform(view, column, row, source_depth_m(upper_left));
        quad.corners[1] = transform(view, column + 1u, row, source_depth_m(source(view, column + 1u, row)));
        quad.corners[2] = transform(view, column, row + 1u, source_depth_m(source(view, column, row + 1u)));
        quad.corners[3] = transform(view, column + 1u, row + 1u, source_depth_m(source(view, column + 1u, row + 1u)));
        // A triangle with a vertex that cannot be drawn is none: its box would reach to wherever that vertex lies.
        let inner = min(quad.corners[1].inverse_depth, quad.corners[2].inverse_depth);
        quad.triangles &= select(0u, UPPER_LEFT, min(quad.corners[0].inverse_depth, inner) > 0.0)
            | select(0u, LOWER_RIGHT, min(quad.corners[3].inverse_depth, inner) > 0.0);
    }
    return quad;
}

/// What a triangle shows at a pixel. Vertices clockwise as seen (y down); the other way round is a back face and covers
/// nothing.
fn sample_triangle(a: Vertex, b: Vertex, c: Vertex, x: f32, y: f32) -> Surface {
    let area = (b.x - a.x) * (c.y - a.y) - (b.y - a.y) * (c.x - a.x);
    let nearest_behind = min(min(a.inverse_depth, b.inverse_depth), c.inverse_depth);
    if area <= 0.0 || nearest_behind <= 0.0 {
        return Surface(false, 0.0, 0.0, 0.0);
    }
    let inverse_area = 1.0 / area;
    // Barycentric weights on the target image. An edge belongs to both its triangles: no cracks.
    let weight_b = ((x - a.x) * (c.y - a.y) - (y - a.y) * (c.x - a.x)) * inverse_area;
    let weight_c = ((b.x - a.x) * (y - a.y) - (b.y - a.y) * (x - a.x)) * inverse_area;
    let weight_a = 1.0 - weight_b - weight_c;
    let inside = min(min(weight_a, weight_b), weight_c) >= -EDGE_SLACK;
    // On the surface: weights divided by depth.
    let on_a = weight_a * a.inverse_depth;
    let on_b = weight_b * b.inverse_depth;
    let on_c = weight_c * c.inverse_depth;
    let inverse_depth = on_a + on_b + on_c;
    let depth = 1.0 / inverse_depth;
    let u = (on_a * a.column + on_b * b.column + on_c * c.column) * depth;
    let v = (on_a * a.row + on_b * b.row + on_c * c.row) * depth;
    return Surface(inside && inverse_depth > 0.0, inverse_depth, u, v);
}

fn sample_quad(quad: Quad, lower_right: bool, x: f32, y: f32) -> Surface {
    if lower_right {
        return sample_triangle(quad.corners[3], quad.corners[2], quad.corners[1], x, y);
    }
    return sample_triangle(quad.corners[0], quad.corners[1], quad.corners[2], x, y);
}

/// Each triangle lies on its side of the diagonal, if it shows its front.
fn is_lower_right(quad: Quad, x: f32, y: f32) -> bool {
    let upper_right = quad.corners[1];
    let lower_left = quad.corners[2];
    let side = (lower_left.x - upper_right.x) * (y - upper_right.y) - (lower_left.y - upper_right.y) * (x - upper_right.x);
    let has_upper_left = (quad.triangles & UPPER_LEFT) != 0u;
    let has_lower_right = (quad.triangles & LOWER_RIGHT) != 0u;
    return !(has_upper_left && (side >= 0.0 || !has_lower_right));
}

/// Nearest step of a source position: column or row, and steps beyond it.
fn sample_position(position: f32) -> vec2<u32> {
    let steps = u32(round(max(position, 0.0) * STEPS));
    let per_pixel = u32(STEPS);
    return vec2<u32>(steps / per_pixel, steps % per_pixel);
}

fn sample_depth_m(nearest: u32) -> f32 {
    return 1.0 / bitcast<f32>(nearest << INVERSE_DEPTH_SHIFT);
}
