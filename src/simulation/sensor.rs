//! From radiance to what a camera delivers: exposure, shot and read noise, response curve, eight bits; and a depth
//! camera's noise.

use std::sync::LazyLock;

use rayon::prelude::*;

use super::{random::Stream, texture::Rgb};
use crate::model::frame::RgbImage;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sensor {
    /// Signal of white paper in full light relative to saturation.
    pub exposure: f64,
    /// Electrons at saturation; shot noise is the square root of the signal in electrons. Infinite: none.
    pub full_well: f64,
    /// Electrons.
    pub read_noise: f64,
    /// Share by which automatic exposure strays to either side; 0 = fixed.
    pub exposure_drift: f64,
    /// How long the shutter is open, seconds; 0 = no motion blur.
    pub shutter_secs: f64,
    /// Standard deviation of measured depth at 1 m, metres; it grows with the square of the depth.
    pub depth_noise_m: f64,
}

impl Default for Sensor {
    fn default() -> Self {
        Self {
            exposure: 0.80,
            full_well: 9_000.0,
            read_noise: 9.0,
            exposure_drift: 0.0,
            shutter_secs: 0.0,
            depth_noise_m: 1.2e-3,
        }
    }
}

impl Sensor {
    pub const NOISELESS: Self = Self {
        exposure: 0.80,
        full_well: f64::INFINITY,
        read_noise: 0.0,
        exposure_drift: 0.0,
        shutter_secs: 0.0,
        depth_noise_m: 0.0,
    };

    /// An image of this radiance; `gain` multiplies the exposure, `key` tells images apart.
    pub fn expose(
        &self,
        radiance: &[Rgb],
        width: usize,
        gain: f64,
        seed: u64,
        key: &[u64],
    ) -> RgbImage {
        let height = radiance.len() / width;
        let exposure = (self.exposure * gain) as f32;
        let shot = (1.0 / self.full_well) as f32;
        let read = if self.full_well.is_finite() {
            (self.read_noise / self.full_well).powi(2) as f32
        } else {
            0.0
        };
        let noisy = shot > 0.0 || read > 0.0;
        let mut data = vec![0; radiance.len() * 3];
        data.par_chunks_mut(width * 3)
            .zip(radiance.par_chunks(width))
            .enumerate()
            .for_each(|(row, (bytes, radiance))| {
                let mut stream = Stream::new(seed, &[key, &[row as u64]].concat());
                for (byte, &value) in bytes.iter_mut().zip(radiance.as_flattened()) {
                    let mut signal = value * exposure;
                    if noisy {
                        signal += (shot * signal + read).sqrt() * stream.nearly_normal();
                    }
                    *byte = level(&RESPONSE, signal);
                }
            });
        RgbImage {
            width,
            height,
            data,
        }
    }

    /// What a depth camera makes of true depth, metres; 0 stays 0.
    pub fn measure_depth(&self, depth_m: &[f32], seed: u64, key: &[u64]) -> Vec<f32> {
        if self.depth_noise_m == 0.0 {
            return depth_m.to_vec();
        }
        let mut stream = Stream::new(seed, key);
        depth_m
            .iter()
            .map(|&z| z + self.depth_noise_m as f32 * z * z * stream.nearly_normal())
            .collect()
    }
}

/// The response curve at `RESPONSE_STEPS` signals per unit, up to where it is white.
static RESPONSE: LazyLock<Vec<f32>> = LazyLock::new(|| {
    (0..=RESPONSE_STEPS * RESPONSE_END)
        .map(|step| response(step as f32 / RESPONSE_STEPS as f32) * 255.0 + 0.5)
        .collect()
});
const RESPONSE_STEPS: usize = 8192;
const RESPONSE_END: usize = 2;

/// Grey level of a signal.
#[inline]
fn level(table: &[f32], signal: f32) -> u8 {
    // The casts saturate. A step is less than a tenth of a level but in the deepest shadow, where noise is greater.
    let step = (signal * RESPONSE_STEPS as f32 + 0.5) as usize;
    table[step.min(table.len() - 1)] as u8
}

/// The sRGB curve with a shoulder, so that highlights fade into white; linear 0.. -> 0..1.
fn response(linear: f32) -> f32 {
    const KNEE: f32 = 0.75;
    let linear = linear.max(0.0);
    let linear = if linear > KNEE {
        KNEE + (1.0 - KNEE) * (1.0 - (-(linear - KNEE) / (1.0 - KNEE)).exp())
    } else {
        linear
    };
    if linear <= 0.003_130_8 {
        linear * 12.92
    } else {
        1.055 * linear.powf(1.0 / 2.4) - 0.055
    }
}
