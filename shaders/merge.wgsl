// Twin of src/stages/interpolate/merge.rs: gathers the records that a pixel comes from and merges the covering views.

const COLOUR_CONFLICT: f32 = 40.0;
const COLOUR_TOLERANCE: f32 = 40.0;
const COLOUR_CAP: f32 = 80.0;
const P2_MAX: f32 = 0.95;
const SETTLED_WEIGHT: f32 = 0.5;
const P2_REPLACED: f32 = 0.49;

/// A record interpolated inside its triangle.
struct Gathered {
    /// alpha, then beta.
    spread: vec4<f32>,
    tau: vec3<f32>,
    p2: f32,
    sigma: vec3<f32>,
    tau2: vec3<f32>,
}

// What the covering views say about this thread's pixel; sets of views are bit masks.
var<private> count: u32;
var<private> fresh: u32;
var<private> depth_m: array<f32, VIEWS_MAX>;
var<private> weight: array<f32, VIEWS_MAX>;
var<private> gathered: array<Gathered, VIEWS_MAX>;

/// Notes what a view says of this thread's pixel.
fn push(pixel_depth_m: f32, said: Gathered, view: View) {
    depth_m[count] = pixel_depth_m;
    weight[count] = view.weight;
    fresh |= view.fresh << count;
    gathered[count] = said;
    let unsettled = rules.earlier_appearance != 0u && view.fresh != 0u && view.weight < SETTLED_WEIGHT;
    if unsettled && said.p2 >= P2_REPLACED {
        gathered[count].tau = said.tau2;
        gathered[count].p2 = 0.0;
    }
    count += 1u;
}

fn is_member(views_set: u32, index: u32) -> bool {
    return ((views_set >> index) & 1u) != 0u;
}

fn all_views() -> u32 {
    return (1u << count) - 1u;
}

fn distance_of(a: vec3<f32>, b: vec3<f32>) -> f32 {
    let d = abs(a - b);
    return d.x + d.y + d.z;
}

/// Interpolates the three records of the triangle around a source position.
fn gather(view: View, u: f32, v: f32) -> Gathered {
    let at_u = sample_position(u);
    let at_v = sample_position(v);
    // A sample on the last column or row belongs to the quad before it.
    let last_column = view.width - 2u;
    let last_row = view.height - 2u;
    let right = f32(at_u.y) * (1.0 / STEPS) + select(0.0, 1.0, at_u.x > last_column);
    let down = f32(at_v.y) * (1.0 / STEPS) + select(0.0, 1.0, at_v.x > last_row);
    let upper_left = view.first + min(at_v.x, last_row) * view.width + min(at_u.x, last_column);
    let upper_right = upper_left + 1u;
    let lower_left = upper_left + view.width;
    var corners = vec3<u32>(upper_left, upper_right, lower_left);
    var w = vec3<f32>(1.0 - right - down, right, down);
    if right + down > 1.0 {
        corners.x = lower_left + 1u;
        w = vec3<f32>(right + down - 1.0, 1.0 - down, 1.0 - right);
    }
    var sum = Gathered(vec4<f32>(0.0), vec3<f32>(LEVEL_OFFSET_Y, 0.0, 0.0), 0.0, vec3<f32>(0.0), vec3<f32>(0.0));
    // tau2 means nothing where p2 is 0, so p2 weighs it.
    for (var i = 0u; i < 3u; i++) {
        let sigma = stored_sigma(corners[i]);
        let level = stored_level(corners[i]);
        let level_0 = unpack_level(level.x);
        let level_1 = unpack_level(level.y);
        let level_2 = unpack_level(level.z);
        sum.spread += w[i] * stored_spread(corners[i]);
        sum.sigma += w[i] * sigma.xyz;
        sum.p2 += w[i] * sigma.w;
        sum.tau += w[i] * vec3<f32>(level_0, level_1.x);
        sum.tau2 += w[i] * sigma.w * vec3<f32>(level_1.y, level_2);
    }
    if sum.p2 > 0.0 {
        sum.tau2 = vec3<f32>(LEVEL_OFFSET_Y, 0.0, 0.0) + sum.tau2 / sum.p2;
    }
    return sum;
}

/// Views within the tolerance of the weighted lower median depth.
fn vote_on_depth(tolerance: f32) -> u32 {
    var low = depth_m[0];
    var high = depth_m[0];
    for (var i = 1u; i < count; i++) {
        low = min(low, depth_m[i]);
        high = max(high, depth_m[i]);
    }
    if high - low <= tolerance * low {
        return all_views();
    }
    let median = weighted_lower_median_depth_m();
    var kept = 0u;
    for (var i = 0u; i < count; i++) {
        if abs(depth_m[i] - median) <= tolerance * median {
            kept |= 1u << i;
        }
    }
    return kept;
}

fn weighted_lower_median_depth_m() -> f32 {
    var half = 0.0;
    for (var i = 0u; i < count; i++) {
        half += weight[i];
    }
    half *= 0.5;
    // The nearest view that half the weight is not beyond.
    var left = all_views();
    var below = 0.0;
    var median = 0.0;
    while left != 0u {
        var first = countTrailingZeros(left);
        for (var i = first + 1u; i < count; i++) {
            if is_member(left, i) && depth_m[i] < depth_m[first] {
                first = i;
            }
        }
        left &= ~(1u << first);
        below += weight[first];
        median = depth_m[first];
        if below >= half {
            break;
        }
    }
    return median;
}

/// Of the kept views, those near the weighted medoid of tau; all of them where they hardly differ.
fn vote_on_colour(kept: u32) -> u32 {
    let first = countTrailingZeros(kept);
    var low = gathered[first].tau;
    var high = low;
    for (var i = first + 1u; i < count; i++) {
        if is_member(kept, i) {
            low = min(low, gathered[i].tau);
            high = max(high, gathered[i].tau);
        }
    }
    if distance_of(high, low) > COLOUR_CONFLICT {
        return near_medoid(kept);
    }
    return kept;
}

fn near_medoid(kept: u32) -> u32 {
    var medoid = 0u;
    var least = -1.0;
    for (var i = 0u; i < count; i++) {
        if is_member(kept, i) {
            var cost = 0.0;
            for (var other = 0u; other < count; other++) {
                if is_member(kept, other) {
                    cost += weight[other] * min(distance_of(gathered[i].tau, gathered[other].tau), COLOUR_CAP);
                }
            }
            if least < 0.0 || cost < least {
                medoid = i;
                least = cost;
            }
        }
    }
    var near = 0u;
    for (var i = 0u; i < count; i++) {
        if is_member(kept, i) && distance_of(gathered[i].tau, gathered[medoid].tau) <= COLOUR_TOLERANCE {
            near |= 1u << i;
        }
    }
    return near;
}

/// Weighted means over the kept views; with view_variance beta grows by alpha times their variance in tau.
fn mean(kept: u32) -> Belief {
    var spread = vec4<f32>(0.0);
    var sigma = vec3<f32>(0.0);
    var tau = vec3<f32>(0.0);
    var total = 0.0;
    for (var i = 0u; i < count; i++) {
        if is_member(kept, i) {
            total += weight[i];
            spread += weight[i] * gathered[i].spread;
            sigma += weight[i] * gathered[i].sigma;
            tau += weight[i] * gathered[i].tau;
        }
    }
    let scale = 1.0 / total;
    spread *= scale;
    sigma *= scale;
    tau *= scale;
    var variance = vec3<f32>(0.0);
    if rules.view_variance != 0u {
        for (var i = 0u; i < count; i++) {
            if is_member(kept, i) {
                let difference = gathered[i].tau - tau;
                variance += weight[i] * scale * difference * difference;
            }
        }
    }
    return Belief(spread.x, spread.yzw + spread.x * variance, tau, sigma, vec3<f32>(0.0), 0.0);
}

fn mean_depth_m(kept: u32) -> f32 {
    var sum = 0.0;
    var total = 0.0;
    for (var i = 0u; i < count; i++) {
        if is_member(kept, i) {
            sum += weight[i] * depth_m[i];
            total += weight[i];
        }
    }
    return sum / total;
}

/// A kept view's own earlier appearance, or the main appearance of an outvoted one; and its weight.
fn candidate(index: u32, kept: u32) -> vec4<f32> {
    let p2 = gathered[index].p2;
    if is_member(kept, index) {
        return vec4<f32>(gathered[index].tau2, weight[index] * p2);
    }
    return vec4<f32>(gathered[index].tau, weight[index] * (1.0 - p2));
}

/// What was there before, and its weight in w: the kept views' own earlier appearance, and the main appearance of the
/// outvoted that were not written during this visit.
fn earlier_appearance(kept: u32) -> vec4<f32> {
    let witnesses = kept | (all_views() & ~fresh);
    var heaviest = vec4<f32>(0.0, 0.0, 0.0, -1.0);
    for (var i = 0u; i < count; i++) {
        if is_member(witnesses, i) {
            let here = candidate(i, kept);
            if here.w >= heaviest.w {
                heaviest = here;
            }
        }
    }
    if heaviest.w <= 0.0 {
        return vec4<f32>(0.0);
    }
    var sum = vec4<f32>(0.0);
    var all = 0.0;
    for (var i = 0u; i < count; i++) {
        if is_member(witnesses, i) {
            let here = candidate(i, kept);
            all += weight[i];
            if distance_of(here.xyz, heaviest.xyz) <= COLOUR_TOLERANCE {
                sum += vec4<f32>(here.w * here.xyz, here.w);
            }
        }
    }
    return vec4<f32>(sum.xyz / sum.w, min(sum.w / all, P2_MAX));
}
