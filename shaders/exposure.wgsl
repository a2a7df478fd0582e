// Twin of src/stages/exposure.rs: a histogram of Y / tau_Y, and its median.

const EXPECTED_MIN: f32 = 20.0;
const OBSERVED_MIN: f32 = 10.0;
const OBSERVED_MAX: f32 = 245.0;
const GAIN_MIN: f32 = 0.7;
const GAIN_MAX: f32 = 1.4;
const BINS: u32 = 2048u;

fn comparable(expected: f32, coverage: f32, observed: f32) -> bool {
    return coverage > 0.0 && expected > EXPECTED_MIN && observed > OBSERVED_MIN && observed < OBSERVED_MAX;
}

fn bins_per_gain() -> f32 {
    return f32(BINS) / (GAIN_MAX - GAIN_MIN);
}

fn bin_of(expected: f32, observed: f32) -> u32 {
    return u32(clamp((observed / expected - GAIN_MIN) * bins_per_gain(), 0.0, f32(BINS - 1u)));
}

/// Where in the bin the median lies, as if its members were spread evenly.
fn gain_in_bin(bin: u32, below: u32, members: u32, total_count: u32) -> f32 {
    let inside = (f32(total_count) / 2.0 - f32(below)) / f32(members);
    return GAIN_MIN + (f32(bin) + inside) / bins_per_gain();
}
