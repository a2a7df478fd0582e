// What the host hands over (src/engine/gpu/layout.rs) and where a pixel's belief is kept between passes.

const CHANNELS: u32 = 3u;
/// As Settings::views allows.
const VIEWS_MAX: u32 = 16u;

/// The image that is recalled or scored, pixels.
struct Frame {
    width: u32,
    height: u32,
    view_count: u32,
    /// Whole blocks of the evidence map.
    blocks_wide: u32,
    blocks_high: u32,
}

/// A viewpoint to recall from. A vertex (column, row) of depth z lands at z * (H * (column, row, 1)) + h, homogeneous
/// target pixels; a row of H and h is (H0, H1, H2, h).
struct View {
    h_x: vec4<f32>,
    h_y: vec4<f32>,
    h_z: vec4<f32>,
    width: u32,
    height: u32,
    /// Its first pixel in the arenas.
    first: u32,
    fresh: u32,
    /// In votes and means.
    weight: f32,
}

/// What the settings say; switches are 0 or 1.
struct Rules {
    forgetting: f32,
    xi: f32,
    sigma_min: f32,
    sigma_max: f32,
    unseen_variance: f32,
    /// Squared pixel error at edges; 0 = edges are not widened.
    edge_variance_px: f32,
    surprise_threshold: f32,
    depth_vote_tolerance: f32,
    gamma_center: f32,
    gamma_scale: f32,
    second_look: u32,
    starts_at_observation: u32,
    depth_vote: u32,
    colour_vote: u32,
    view_variance: u32,
    earlier_appearance: u32,
    exposure_gain: u32,
    /// Lowest power first, padded with zeros.
    gamma_coefficients: array<vec4<f32>, 4>,
}

/// What the exposure pass found out.
struct Exposure {
    gain: f32,
    inverse_gain: f32,
    /// Pixels that some viewpoint saw.
    seen: u32,
}

/// A level of the pyramid that refinement looks at, and what holds for all of them. Level 0 is half the image.
struct Level {
    focal: vec2<f32>,
    center: vec2<f32>,
    /// Inverse variances of translation, rotation, gain and offset, as the noise of the pose says.
    certainty: array<vec4<f32>, 2>,
    width: u32,
    height: u32,
    /// Its first pixel in the pyramid.
    first: u32,
    index: u32,
    /// Of the level before.
    finer_width: u32,
    finer_first: u32,
    image_width: u32,
    /// Correlated pixels count less.
    inverse_discount: f32,
    /// Of the image, pixels.
    image_focal: vec2<f32>,
    image_center: vec2<f32>,
    position_sd_m: f32,
    rotation_sd_rad: f32,
}

/// What refinement has found so far: the real camera is given * given_from_real, and Y = gain * tau + offset.
struct Estimate {
    /// Of given_from_real, a unit quaternion, its real part last.
    rotation: vec4<f32>,
    translation: vec3<f32>,
    gain: f32,
    /// Sum of the capped residuals and their number: at the last look, and at the one before.
    mismatch: vec2<f32>,
    mismatch_before: vec2<f32>,
    offset: f32,
    /// 0 where too little is predicted.
    level_count: u32,
    /// Comparable pixels of the finest level.
    point_count: u32,
    /// Whether it is better than the given pose; 0 or 1.
    accepted: u32,
}
