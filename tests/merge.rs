//! The engine's recall is the plain projection and merge of the reference, and does not hang on threads or processors.

mod reference;

use reference::{
    Random, interpolation, isas, pool,
    recall::{Difference, Views, difference, target, views},
    scene::{camera, pose},
};
use surprised::{
    config::{Preset, Settings},
    engine::cpu::CpuEngine,
    stages::interpolate::prior::Prior,
};

fn assert_agreement(name: &str, settings: &Settings, views: &Views) -> Difference {
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
    let difference = difference(&prior, &expected);
    assert!(difference.covered > 0.9, "{name}: {difference:?}");
    difference.assert_small(name);
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
