//! Takes the lens's distortion out of a frame.
//!
//! Image and depth as the lens drew them -> as a pinhole camera with the same focal lengths would have: for each pixel
//! of the result the place where the lens drew it (`plumb_bob`: radial k1 k2 k3, tangential p1 p2). Colours are
//! bilinear, clamped to the image's edge; depth is the nearest pixel's, because depths of two surfaces have no mean,
//! and none outside: what the lens did not see is not remembered.

use crate::model::{
    camera::{Calibration, Intrinsics, PlumbBob},
    frame::{GreyImage, RgbImage},
};

/// Where each pixel of the rectified image lies in the distorted one. Made once for a calibration.
#[derive(Debug, Clone)]
pub struct Rectifier {
    width: usize,
    height: usize,
    /// Pixels, row by row.
    sources: Vec<(f32, f32)>,
}

impl Rectifier {
    /// `None` where there is nothing to rectify.
    pub fn new(calibration: &Calibration) -> Option<Self> {
        let distortion = calibration.distortion?;
        let Intrinsics { width, height, .. } = calibration.intrinsics;
        let sources = (0..height)
            .flat_map(|v| (0..width).map(move |u| (u, v)))
            .map(|(u, v)| distorted(&calibration.intrinsics, &distortion, u as f64, v as f64))
            .collect();
        Some(Self {
            width,
            height,
            sources,
        })
    }

    /// The image must have the calibration's size.
    pub fn image(&self, distorted: &RgbImage) -> RgbImage {
        self.check(distorted.width, distorted.height, distorted.data.len() / 3);
        RgbImage {
            width: self.width,
            height: self.height,
            data: self.bilinear::<3>(&distorted.data),
        }
    }

    /// The image must have the calibration's size.
    pub fn grey(&self, distorted: &GreyImage) -> GreyImage {
        self.check(distorted.width, distorted.height, distorted.data.len());
        GreyImage {
            width: self.width,
            height: self.height,
            data: self.bilinear::<1>(&distorted.data),
        }
    }

    fn bilinear<const CHANNELS: usize>(&self, distorted: &[u8]) -> Vec<u8> {
        let (x_max, y_max) = ((self.width - 1) as f32, (self.height - 1) as f32);
        let mut data = Vec::with_capacity(distorted.len());
        for &(u, v) in &self.sources {
            // NaN, of coefficients beyond reason, clamps to the corner.
            let (u, v) = (u.max(0.0).min(x_max), v.max(0.0).min(y_max));
            let (x, y) = (u as usize, v as usize);
            let (right, below) = ((x + 1).min(self.width - 1), (y + 1).min(self.height - 1));
            let (fx, fy) = (u - x as f32, v - y as f32);
            let at = |x: usize, y: usize, channel: usize| {
                f32::from(distorted[CHANNELS * (y * self.width + x) + channel])
            };
            for channel in 0..CHANNELS {
                let upper = at(x, y, channel) * (1.0 - fx) + at(right, y, channel) * fx;
                let lower = at(x, below, channel) * (1.0 - fx) + at(right, below, channel) * fx;
                data.push((upper * (1.0 - fy) + lower * fy).round() as u8);
            }
        }
        data
    }

    /// Metres, 0 = none; as many as the calibration's size has pixels.
    pub fn depth_m(&self, distorted_m: &[f32]) -> Vec<f32> {
        self.check(self.width, self.height, distorted_m.len());
        self.sources
            .iter()
            .map(|&(u, v)| {
                let (x, y) = (u.round(), v.round());
                let inside =
                    (0.0..self.width as f32).contains(&x) && (0.0..self.height as f32).contains(&y);
                if inside {
                    distorted_m[y as usize * self.width + x as usize]
                } else {
                    0.0
                }
            })
            .collect()
    }

    fn check(&self, width: usize, height: usize, pixels: usize) {
        assert_eq!(
            (width, height, pixels),
            (self.width, self.height, self.sources.len()),
            "pictures have the calibration's size"
        );
    }
}

/// Where the lens draws what a pinhole camera draws at `(u, v)`.
fn distorted(camera: &Intrinsics, lens: &PlumbBob, u: f64, v: f64) -> (f32, f32) {
    let x = (u - camera.cx) / camera.fx;
    let y = (v - camera.cy) / camera.fy;
    let r2 = x * x + y * y;
    let radial = 1.0 + r2 * (lens.k1 + r2 * (lens.k2 + r2 * lens.k3));
    let x_drawn = x * radial + 2.0 * lens.p1 * x * y + lens.p2 * (r2 + 2.0 * x * x);
    let y_drawn = y * radial + lens.p1 * (r2 + 2.0 * y * y) + 2.0 * lens.p2 * x * y;
    (
        (x_drawn * camera.fx + camera.cx) as f32,
        (y_drawn * camera.fy + camera.cy) as f32,
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn calibration(lens: PlumbBob) -> Calibration {
        Calibration {
            intrinsics: Intrinsics {
                width: 64,
                height: 48,
                fx: 60.0,
                fy: 61.0,
                cx: 31.0,
                cy: 24.5,
            },
            distortion: Some(lens),
        }
    }

    /// Takes the distortion off a drawn point by fixed-point iteration, as OpenCV's undistortPoints does.
    fn undistorted(camera: &Intrinsics, lens: &PlumbBob, u: f64, v: f64) -> (f64, f64) {
        let (mut x, mut y) = (u, v);
        for _ in 0..100 {
            let (u_drawn, v_drawn) = distorted(camera, lens, x, y);
            x += u - f64::from(u_drawn);
            y += v - f64::from(v_drawn);
        }
        (x, y)
    }

    #[test]
    fn a_dot_moves_to_where_a_pinhole_camera_draws_it() {
        let lens = PlumbBob {
            k1: -0.45,
            k2: 0.05,
            p1: 0.003,
            p2: -0.002,
            k3: 0.0,
        };
        let calibration = calibration(lens);
        let rectifier = Rectifier::new(&calibration).expect("there is distortion");
        let (dot_x, dot_y) = (12, 9);
        let mut image = RgbImage {
            width: 64,
            height: 48,
            data: vec![0; 64 * 48 * 3],
        };
        let mut depth_m = vec![1.0; 64 * 48];
        for y in dot_y - 1..=dot_y + 1 {
            for x in dot_x - 1..=dot_x + 1 {
                image.data[3 * (y * 64 + x)] = 200;
                depth_m[y * 64 + x] = 2.0;
            }
        }
        let (x, y) = undistorted(&calibration.intrinsics, &lens, dot_x as f64, dot_y as f64);
        let pixel = y.round() as usize * 64 + x.round() as usize;
        assert!((x - dot_x as f64).abs() > 1.0, "the lens moves the dot");
        assert!(rectifier.image(&image).data[3 * pixel] > 150);
        assert_eq!(rectifier.depth_m(&depth_m)[pixel], 2.0);
    }

    #[test]
    fn outside_what_the_lens_drew_there_is_no_depth() {
        let rectifier = Rectifier::new(&calibration(PlumbBob {
            k1: 0.5,
            ..PlumbBob::default()
        }))
        .expect("there is distortion");
        assert_eq!(rectifier.depth_m(&vec![1.0; 64 * 48])[0], 0.0);
    }

    #[test]
    fn coefficients_beyond_reason_do_no_harm() {
        let rectifier = Rectifier::new(&calibration(PlumbBob {
            k1: 1e300,
            k2: -1e300,
            k3: 1e308,
            p1: f64::MAX,
            p2: f64::MIN,
        }))
        .expect("there is distortion");
        let image = RgbImage {
            width: 64,
            height: 48,
            data: vec![7; 64 * 48 * 3],
        };
        assert_eq!(rectifier.image(&image), image);
        assert!(rectifier.depth_m(&vec![1.0; 64 * 48])[0] == 0.0);
    }
}
