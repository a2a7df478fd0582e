//! One exposure gain a frame.
//!
//! Expected and observed luminance -> the factor by which the observation is brighter: the median of Y / tau_Y where
//! both can be trusted. The paper has none; auto exposure makes everything surprising without it.

/// Pixels darker than this in expectation carry too little for a ratio, grey levels.
const EXPECTED_MIN: f32 = 20.0;
/// Observed luminance that is neither noise nor saturated, grey levels.
const OBSERVED_MIN: f32 = 10.0;
const OBSERVED_MAX: f32 = 245.0;
/// Beyond this it is another light, not another exposure.
const GAIN_MIN: f32 = 0.7;
const GAIN_MAX: f32 = 1.4;
/// Histogram bins between the bounds: a step of 0.03 %.
const BINS: usize = 2048;

/// `rows` yields (expected luminance, coverage, observed luminance), a row each. 1 where nothing can be compared.
pub fn exposure_gain<'a>(rows: impl Iterator<Item = (&'a [f32], &'a [f32], &'a [f32])>) -> f32 {
    // A histogram in place of sorting: clipping the ratios first does not move a median inside the bounds.
    let mut histogram = [0u32; BINS];
    let mut count = 0u32;
    let scale = BINS as f32 / (GAIN_MAX - GAIN_MIN);
    for (expected, coverage, observed) in rows {
        for ((&expected, &coverage), &observed) in expected.iter().zip(coverage).zip(observed) {
            let comparable = coverage > 0.0
                && expected > EXPECTED_MIN
                && observed > OBSERVED_MIN
                && observed < OBSERVED_MAX;
            if comparable {
                let bin = (observed / expected - GAIN_MIN) * scale;
                // The cast saturates below at 0.
                histogram[(bin as usize).min(BINS - 1)] += 1;
                count += 1;
            }
        }
    }
    if count == 0 {
        return 1.0;
    }
    let mut below = 0;
    for (bin, &members) in histogram.iter().enumerate() {
        if 2 * (below + members) >= count {
            // Where in the bin the median lies, as if its members were spread evenly.
            let inside = (count as f32 / 2.0 - below as f32) / members as f32;
            return GAIN_MIN + (bin as f32 + inside) / scale;
        }
        below += members;
    }
    GAIN_MAX
}
