//! One exposure gain a frame.
//!
//! Expected and observed luminance -> the factor by which the observation is brighter: the median of Y / tau_Y where
//! both can be trusted. The paper has none; auto exposure makes everything surprising without it.

use crate::{
    isa::{Isa, for_each_isa},
    lanes::{LANES, greatest, least, load_or},
};

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
/// So many histograms take turns: most ratios are alike, and counting into the bin that was just counted into waits for it.
const TURNS: usize = 4;
const _: () = assert!(LANES.is_multiple_of(TURNS));

/// `rows` yields (expected luminance, coverage, observed luminance), a row each. 1 where nothing can be compared.
pub fn exposure_gain<'a>(rows: impl Iterator<Item = (&'a [f32], &'a [f32], &'a [f32])>) -> f32 {
    let mut ratios = ExposureRatios::default();
    for (expected, coverage, observed) in rows {
        ratios.count(Isa::Portable, expected, coverage, observed);
    }
    ratios.gain()
}

/// The ratios of some rows, in a histogram in place of sorting: clipping them first does not move a median inside the
/// bounds.
#[derive(Clone)]
pub struct ExposureRatios {
    /// The last bin is for what cannot be compared, and for nothing at all.
    histograms: [[u32; BINS + 1]; TURNS],
}

impl Default for ExposureRatios {
    fn default() -> Self {
        Self {
            histograms: [[0; BINS + 1]; TURNS],
        }
    }
}

impl ExposureRatios {
    pub fn clear(&mut self) {
        self.histograms.as_flattened_mut().fill(0);
    }

    /// Of a row: expected luminance, coverage, observed luminance.
    pub fn count(&mut self, isa: Isa, expected: &[f32], coverage: &[f32], observed: &[f32]) {
        count_row(isa, expected, coverage, observed, &mut self.histograms);
    }

    pub fn add(&mut self, other: &Self) {
        let sums = self.histograms.as_flattened_mut().iter_mut();
        for (sum, members) in sums.zip(other.histograms.as_flattened()) {
            *sum += members;
        }
    }

    /// The median; 1 of none.
    pub fn gain(&self) -> f32 {
        let bins: [u32; BINS] =
            std::array::from_fn(|bin| self.histograms.iter().map(|turn| turn[bin]).sum());
        let count: u32 = bins.iter().sum();
        let scale = BINS as f32 / (GAIN_MAX - GAIN_MIN);
        if count == 0 {
            return 1.0;
        }
        let mut below = 0;
        for (bin, &members) in bins.iter().enumerate() {
            if 2 * (below + members) >= count {
                // Where in the bin the median lies, as if its members were spread evenly.
                let inside = (count as f32 / 2.0 - below as f32) / members as f32;
                return GAIN_MIN + (bin as f32 + inside) / scale;
            }
            below += members;
        }
        GAIN_MAX
    }
}

for_each_isa! {
    fn count_row(
        expected: &[f32],
        coverage: &[f32],
        observed: &[f32],
        histograms: &mut [[u32; BINS + 1]; TURNS],
    ) = count_kernel;
}

#[inline(always)]
fn count_kernel(
    expected: &[f32],
    coverage: &[f32],
    observed: &[f32],
    histograms: &mut [[u32; BINS + 1]; TURNS],
) {
    let scale = BINS as f32 / (GAIN_MAX - GAIN_MIN);
    for start in (0..expected.len()).step_by(LANES) {
        // Nobody saw what is beyond the last pixel.
        let [tau, coverage, y] =
            [expected, coverage, observed].map(|row| load_or(0.0, &row[start..]));
        let mut bins = [0u32; LANES];
        for lane in 0..LANES {
            let (tau, y) = (tau[lane], y[lane]);
            let comparable = (coverage[lane] > 0.0)
                & (tau > EXPECTED_MIN)
                & (y > OBSERVED_MIN)
                & (y < OBSERVED_MAX);
            let bin = (y / tau - GAIN_MIN) * scale;
            let bin = least(greatest(bin, 0.0), (BINS - 1) as f32);
            // SAFETY: between 0 and `BINS - 1`; what is no number became 0.
            let bin: u32 = unsafe { bin.to_int_unchecked() };
            bins[lane] = if comparable { bin } else { BINS as u32 };
        }
        for bins in bins.as_chunks::<TURNS>().0 {
            for (histogram, &bin) in histograms.iter_mut().zip(bins) {
                histogram[bin as usize] += 1;
            }
        }
    }
}
