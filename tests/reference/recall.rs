//! Views that agree and disagree, and how far a prior recalled from them is from the reference.

use surprised::{
    engine::cpu::RecallView,
    model::{belief::Record, camera::Intrinsics, pose::Pose, viewpoint::Viewpoint},
    stages::interpolate::prior::{self, Prior},
};

use super::{
    Random,
    interpolation::Interpolated,
    scene::{camera, pose, settled, viewpoint},
};

pub struct Views {
    pub viewpoints: Vec<Viewpoint>,
    pub weights: Vec<(f32, bool)>,
}

/// Smooth surfaces with a step, seen with smooth colours; with `disagreement` some views see another thing in a part.
pub fn views(random: &mut Random, disagreement: bool) -> Views {
    let sizes = [
        (160, 120),
        (97, 75),
        (160, 120),
        (131, 101),
        (160, 120),
        (80, 64),
        (113, 87),
    ];
    let mut weights = Vec::new();
    let viewpoints = sizes
        .into_iter()
        .enumerate()
        .map(|(index, (width, height))| {
            let camera = camera(width, height);
            let world_from_camera = pose(
                std::array::from_fn(|_| random.uniform(-0.06, 0.06)),
                std::array::from_fn(|_| random.uniform(-0.04, 0.04)),
            );
            let (mut depth_m, mut records) = (Vec::new(), Vec::new());
            let odd_one = disagreement && index % 3 == 0;
            for pixel in 0..width * height {
                let a = (pixel % width) as f64 / width as f64;
                let b = (pixel / width) as f64 / height as f64;
                let near = a > 0.3 && a < 0.6 && b > 0.35 && b < 0.7;
                let wave = 0.05 * (5.0 * a + 3.0 * b).sin();
                let other = odd_one && (0.45..0.9).contains(&a) && b < 0.6;
                depth_m.push(match (near, other) {
                    (true, false) => 1.0 + wave,
                    (false, _) => 1.6 + wave,
                    (true, true) => 1.2 + wave,
                } as f32);
                let mut belief = settled([
                    (110.0 + 60.0 * (4.0 * a).sin() * (3.0 * b).cos()) as f32,
                    (20.0 * a - 5.0) as f32,
                    (-30.0 * b) as f32,
                ]);
                belief.alpha = (1.8 + 0.5 * (3.0 * a).cos()) as f32;
                belief.beta[0] = (30.0 + 20.0 * (6.0 * b).sin()) as f32;
                belief.sigma[1] = (0.3 + 0.2 * a) as f32;
                if other {
                    belief.tau = [20.0, 40.0 + 3.0 * a as f32, 40.0];
                }
                // The third was written over everywhere, so that no rounding decides what it speaks for.
                if disagreement && (b > 0.5 || index == 2) && index % 2 == 0 {
                    belief.tau2 = [200.0 - 10.0 * a as f32, -40.0, 10.0];
                    belief.p2 = match index {
                        2 | 6 => 0.5,
                        _ => (0.3 + 0.2 * a) as f32,
                    };
                }
                records.push(Record::pack(&belief));
            }
            weights.push(match (disagreement, index) {
                (true, 2) => (0.2, true),
                (true, 3) => (0.6, true),
                (true, 6) => (0.8, true),
                _ => (1.0, false),
            });
            viewpoint(camera, &world_from_camera, depth_m, records)
        })
        .collect();
    Views {
        viewpoints,
        weights,
    }
}

impl Views {
    pub fn recall(&self) -> Vec<RecallView<'_>> {
        self.viewpoints
            .iter()
            .zip(&self.weights)
            .map(|(viewpoint, &(weight, fresh))| RecallView {
                viewpoint,
                weight,
                fresh,
            })
            .collect()
    }
}

pub fn target() -> (Intrinsics, Pose) {
    (
        camera(151, 113),
        pose([0.01, -0.02, 0.01], [0.01, 0.0, 0.03]),
    )
}

#[derive(Debug)]
pub struct Difference {
    /// Mean |difference| of tau over pixels and channels, grey levels.
    pub tau: f64,
    /// Share of the pixels that as many views see.
    pub coverage: f64,
    /// Share of the pixels that can be compared.
    pub covered: f64,
    /// Shares of those that agree.
    pub spread: f64,
    pub earlier: f64,
    pub with_earlier: usize,
}

/// `expected` is what [`interpolation::recall`] says.
pub fn difference(prior: &Prior, expected: &[Option<(Interpolated, usize)>]) -> Difference {
    let (mut tau, mut covered, mut same_coverage, mut same_spread) = (0.0, 0.0, 0.0, 0.0);
    let (mut same_earlier, mut with_earlier) = (0.0, 0);
    for (pixel, expected) in expected.iter().enumerate() {
        let (x, y) = (pixel % prior.width, pixel / prior.width);
        let got = prior.belief(x, y);
        let coverage = prior.row(y).plane(prior::COVERAGE)[x];
        let count = expected.map_or(0, |(_, count)| count);
        same_coverage += f64::from(u8::from(coverage == count as f32));
        let Some((expected, _)) = expected else {
            continue;
        };
        if coverage == 0.0 {
            continue;
        }
        covered += 1.0;
        let near = |got: f32, expected: f64, relative: f64| {
            (f64::from(got) - expected).abs() <= relative * expected.abs().max(1.0)
        };
        let mut spread = near(got.alpha, expected.alpha, 1e-3);
        for c in 0..3 {
            tau += (f64::from(got.tau[c]) - expected.tau[c]).abs() / 3.0;
            spread &= near(got.beta[c], expected.beta[c], 0.02);
            spread &= near(got.sigma[c], expected.sigma[c], 1e-3);
        }
        let depth_m = prior.row(y).plane(prior::DEPTH)[x];
        spread &= near(depth_m, expected.depth_m, 1e-3);
        same_spread += f64::from(u8::from(spread));
        let mut earlier = near(got.p2, expected.p2, 2e-3);
        for c in 0..3 {
            earlier &= expected.p2 == 0.0 || near(got.tau2[c], expected.tau2[c], 0.01);
        }
        same_earlier += f64::from(u8::from(earlier));
        with_earlier += usize::from(expected.p2 > 0.0);
    }
    let pixels = expected.len() as f64;
    Difference {
        tau: tau / covered,
        coverage: same_coverage / pixels,
        covered: covered / pixels,
        spread: same_spread / covered,
        earlier: same_earlier / covered,
        with_earlier,
    }
}

impl Difference {
    pub fn assert_small(&self, name: &str) {
        println!("{name}: {self:?}");
        let Self {
            tau,
            coverage,
            spread,
            earlier,
            ..
        } = self;
        assert!(*tau <= 0.02, "{name}: mean |tau| error {tau}");
        assert!(*coverage >= 0.995, "{name}: coverage {coverage}");
        assert!(*spread >= 0.98, "{name}: other parameters {spread}");
        assert!(*earlier >= 0.98, "{name}: earlier appearance {earlier}");
    }
}
