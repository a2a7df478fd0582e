//! The engine's recall is the plain projection and merge of the reference, and does not hang on threads or processors.

mod reference;

use reference::{
    Random, interpolation, isas, pool,
    scene::{camera, pose, settled, viewpoint},
};
use surprised::{
    config::{Preset, Settings},
    engine::cpu::{CpuEngine, RecallView},
    model::{belief::Record, camera::Intrinsics, pose::Pose, viewpoint::Viewpoint},
    stages::interpolate::prior::{self, Prior},
};

struct Views {
    viewpoints: Vec<Viewpoint>,
    weights: Vec<(f32, bool)>,
}

/// Smooth surfaces with a step, seen with smooth colours; with `disagreement` some views see another thing in a part.
fn views(random: &mut Random, disagreement: bool) -> Views {
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
                if disagreement && b > 0.5 && index % 2 == 0 {
                    belief.tau2 = [200.0 - 10.0 * a as f32, -40.0, 10.0];
                    belief.p2 = (0.3 + 0.2 * a) as f32;
                }
                records.push(Record::pack(&belief));
            }
            weights.push(match (disagreement, index) {
                (true, 1) => (0.2, true),
                (true, 3) => (0.6, true),
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
    fn recall(&self) -> Vec<RecallView<'_>> {
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

fn target() -> (Intrinsics, Pose) {
    (
        camera(151, 113),
        pose([0.01, -0.02, 0.01], [0.01, 0.0, 0.03]),
    )
}

struct Difference {
    /// Mean |difference| of tau over pixels and channels, grey levels.
    tau: f64,
    /// Shares of the covered pixels that agree.
    coverage: f64,
    spread: f64,
    earlier: f64,
    with_earlier: usize,
}

fn difference(settings: &Settings, views: &Views) -> Difference {
    let (target, world_from_target) = target();
    let recalled = views.recall();
    let mut prior = Prior::default();
    CpuEngine::new(settings, pool(2), isas()[0]).recall(
        &recalled,
        &target,
        &world_from_target,
        &mut prior,
    );
    let expected = interpolation::recall(&recalled, &target, &world_from_target, settings);
    let (mut tau, mut covered, mut same_coverage, mut same_spread) = (0.0, 0.0, 0.0, 0.0);
    let (mut same_earlier, mut with_earlier) = (0.0, 0);
    for (pixel, expected) in expected.iter().enumerate() {
        let (x, y) = (pixel % target.width, pixel / target.width);
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
    let pixels = target.pixels() as f64;
    assert!(covered > 0.9 * pixels);
    Difference {
        tau: tau / covered,
        coverage: same_coverage / pixels,
        spread: same_spread / covered,
        earlier: same_earlier / covered,
        with_earlier,
    }
}

fn assert_agreement(name: &str, settings: &Settings, views: &Views) -> Difference {
    let difference = difference(settings, views);
    let Difference {
        tau,
        coverage,
        spread,
        earlier,
        with_earlier,
    } = &difference;
    println!(
        "{name}: tau {tau:.4}, coverage {coverage:.4}, spread {spread:.4}, earlier {earlier:.4} ({with_earlier} px)"
    );
    assert!(*tau <= 0.02, "{name}: mean |tau| error {tau}");
    assert!(*coverage >= 0.995, "{name}: coverage {coverage}");
    assert!(*spread >= 0.98, "{name}: other parameters {spread}");
    assert!(*earlier >= 0.98, "{name}: earlier appearance {earlier}");
    difference
}

#[test]
fn a_smooth_scene_is_recalled_from_seven_views_as_by_the_reference() {
    for preset in [Preset::Paper, Preset::Robust] {
        let views = views(&mut Random(1), false);
        assert_agreement(&format!("{preset:?}"), &Settings::preset(preset), &views);
    }
}

#[test]
fn every_step_of_the_merge_is_that_of_the_reference_where_views_disagree() {
    let views = views(&mut Random(2), true);
    let paper = Settings::paper();
    let steps: [(&str, Settings); 6] = [
        ("mean", paper.clone()),
        (
            "depth vote",
            Settings {
                depth_vote: true,
                ..paper.clone()
            },
        ),
        (
            "colour vote",
            Settings {
                colour_vote: true,
                ..paper.clone()
            },
        ),
        (
            "view variance",
            Settings {
                view_variance: true,
                ..paper.clone()
            },
        ),
        (
            "earlier appearance",
            Settings {
                earlier_appearance: true,
                depth_vote: true,
                ..paper
            },
        ),
        ("robust", Settings::robust()),
    ];
    for (name, settings) in steps {
        let difference = assert_agreement(name, &settings, &views);
        assert_eq!(settings.earlier_appearance, difference.with_earlier > 500);
    }
}

#[test]
fn the_number_of_threads_and_the_instruction_set_change_no_bit() {
    let views = views(&mut Random(3), true);
    let recalled = views.recall();
    let poses = [target().1, pose([0.3, 0.0, 0.4], [0.2, 0.4, 0.3])];
    for (width, height) in [(151, 113), (17, 19), (16, 16), (33, 1), (1, 33)] {
        for world_from_target in poses {
            for preset in [Preset::Paper, Preset::Robust] {
                let settings = Settings::preset(preset);
                let mut results: Vec<Vec<u32>> = Vec::new();
                for isa in isas() {
                    for threads in [1, 2, 5] {
                        let mut prior = Prior::default();
                        CpuEngine::new(&settings, pool(threads), isa).recall(
                            &recalled,
                            &camera(width, height),
                            &world_from_target,
                            &mut prior,
                        );
                        results.push(prior.data.iter().map(|value| value.to_bits()).collect());
                    }
                }
                assert!(results.windows(2).all(|pair| pair[0] == pair[1]));
            }
        }
    }
}
