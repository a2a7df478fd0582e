//! The engine on a graphics card, or on what stands in for one, against the reference that the processor is held to.

#[path = "../reference/mod.rs"]
mod reference;

mod evaluation;

mod loss;

mod places;

mod refinement;

mod robot;

use std::{io::Write, process::Command};

use reference::{
    Random, interpolation, isas,
    joint::{self, any_belief, assert_stored, assert_surprise, edge},
    pool,
    recall::{Views, difference, target, views},
    scene::{camera, pose, viewpoint},
};
use robot::{PIXELS, Robot, assert_same_report, place};
use surprised::{
    config::{Preset, Settings},
    engine::{
        Answer, Engine, EngineError, EngineKind, Engines, Question,
        cpu::{CpuEngine, Observation, RecallView, Score},
        gpu::{
            Counters,
            card::{Card, CardRules},
        },
    },
    memory::forget::{Forget, Forgetting, Region},
    model::{belief::Record, frame::RgbImage, viewpoint::Viewpoint},
    pipeline::Pipeline,
    stages::{
        attend::BlockMap,
        exposure::exposure_gain,
        interpolate::prior::{self, Prior},
        refine::PoseRefiner,
        update::UpdateRules,
    },
};

/// Counted by `tests/run`, and said where nothing is captured.
fn skipped(why: &str) {
    println!("skipped: {why}");
    // Not by a macro: the harness would swallow it.
    writeln!(std::io::stderr(), "SKIPPED: {why}").expect("stderr is open");
}

/// `None`, and a loud word, where there is no adapter.
fn card_engines(rules: CardRules) -> Option<Engines> {
    match Card::open(rules) {
        Ok(card) => Some(Engines::on(card, pool(1), isas()[0])),
        Err(EngineError::NoAdapter) => {
            skipped("no adapter");
            None
        }
        Err(error) => panic!("{error}"),
    }
}

fn gpu(settings: &Settings) -> Option<Engine> {
    let engine = card_engines(CardRules::any())?.engine(settings);
    writeln!(std::io::stderr(), "on {}", engine.name()).expect("stderr is open");
    Some(engine)
}

fn engines(kind: EngineKind) -> Result<Engines, EngineError> {
    Engines::new(kind, pool(1), isas()[0])
}

fn processor() -> Engines {
    engines(EngineKind::Cpu).expect("there is a processor")
}

fn counters(engine: &Engine) -> &Counters {
    engine.counters().expect("the processor took over")
}

/// Views with different ids, as a memory gives them, from `first` on.
fn numbered(first: u64, mut views: Views) -> Views {
    for (id, viewpoint) in (first..).zip(&mut views.viewpoints) {
        viewpoint.id = id;
    }
    views
}

#[test]
fn the_prior_is_that_of_the_reference_from_none_to_seven_views() {
    let (target, world_from_target) = target();
    for preset in [Preset::Paper, Preset::Robust] {
        let settings = Settings::preset(preset);
        let Some(mut engine) = gpu(&settings) else {
            return;
        };
        for disagreement in [false, true] {
            let mut views = numbered(
                100 * u64::from(disagreement),
                views(&mut Random(2), disagreement),
            );
            // Holes, so that quads lack one triangle or both.
            for view in &mut views.viewpoints {
                let mut depth_m = view.mesh.depth_m.clone();
                let mut random = Random(view.id);
                for _ in 0..40 {
                    let hole = random.below(depth_m.len());
                    depth_m[hole] = 0.0;
                }
                *view = Viewpoint {
                    id: view.id,
                    ..viewpoint(
                        view.mesh.intrinsics,
                        &view.world_from_camera,
                        depth_m,
                        view.records.clone(),
                    )
                };
            }
            let all = views.recall();
            for count in [0, 1, 2, 3, 5, 7] {
                let recalled = &all[..count];
                let name = format!("{preset:?}, {count} views, disagreement {disagreement}");
                let mut prior = Prior::default();
                engine.recall(recalled, &target, &world_from_target, &mut prior);
                assert_eq!((prior.width, prior.height), (target.width, target.height));
                let expected =
                    interpolation::recall(recalled, &target, &world_from_target, &settings);
                let difference = difference(&prior, &expected);
                assert!(difference.coverage >= 0.995, "{name}: {difference:?}");
                if count > 0 {
                    assert!(difference.covered > 0.7, "{name}: {difference:?}");
                    difference.assert_small(&name);
                }
                let mut on_processor = Prior::default();
                CpuEngine::new(&settings, pool(1), isas()[0]).recall(
                    recalled,
                    &target,
                    &world_from_target,
                    &mut on_processor,
                );
                let same = same_pixels(&prior, &on_processor);
                writeln!(std::io::stderr(), "{name}: {same:.5} as on the processor").unwrap();
                assert!(same >= 0.995, "{name}: only {same} as on the processor");
            }
        }
        assert_eq!(counters(&engine).on_processor, 0);
        assert_eq!(counters(&engine).losses, 0);
    }
}

/// Share of the pixels whose every plane is the same but for rounding.
fn same_pixels(a: &Prior, b: &Prior) -> f64 {
    assert_eq!((a.width, a.height), (b.width, b.height));
    let same = (0..a.width * a.height)
        .filter(|pixel| {
            let (x, y) = (pixel % a.width, pixel / a.width);
            // tau2 means nothing where p2 is 0.
            let nothing = b.row(y).plane(prior::P2)[x] == 0.0;
            (0..prior::PLANES).all(|plane| {
                if nothing && (prior::TAU2..prior::P2).contains(&plane) {
                    return true;
                }
                let (a, b) = (a.row(y).plane(plane)[x], b.row(y).plane(plane)[x]);
                // A step of the position, where colours are smooth, is worth less than this.
                (a - b).abs() <= 0.05 + 2e-3 * b.abs()
            })
        })
        .count();
    same as f64 / (a.width * a.height) as f64
}

#[test]
fn the_comparison_fails_for_priors_of_two_different_places() {
    let settings = Settings::robust();
    let (target, world_from_target) = target();
    let recall = |seed: u64, disagreement: bool| {
        let views = views(&mut Random(seed), disagreement);
        let mut prior = Prior::default();
        CpuEngine::new(&settings, pool(1), isas()[0]).recall(
            &views.recall(),
            &target,
            &world_from_target,
            &mut prior,
        );
        let expected =
            interpolation::recall(&views.recall(), &target, &world_from_target, &settings);
        (prior, expected)
    };
    let (one, expected) = recall(2, true);
    let (other, _) = recall(2, false);
    difference(&one, &expected).assert_small("the same place");
    assert!(same_pixels(&one, &one) == 1.0);
    assert!(same_pixels(&one, &other) < 0.9);
    let differs = difference(&other, &expected);
    let outcome = std::panic::catch_unwind(|| differs.assert_small("another place"));
    assert!(outcome.is_err(), "two different priors passed as the same");
}

/// A view whose records are anything, seen from its own pose.
fn anything(
    random: &mut Random,
    settings: &Settings,
    (width, height): (usize, usize),
) -> Viewpoint {
    let rules = UpdateRules::new(settings);
    let mut depth_m = Vec::new();
    let mut records = Vec::new();
    for pixel in 0..width * height {
        let (x, y) = ((pixel % width) as f64, (pixel / width) as f64);
        depth_m.push((1.2 + 0.002 * x + 0.1 * (0.1 * y).sin()) as f32);
        if random.below(30) == 0 {
            depth_m[pixel] = 0.0;
        }
        let mut belief = any_belief(random, &rules);
        // In places smooth: edges are widened by what neighbours differ.
        if y < height as f64 / 2.0 {
            belief.tau = [(90.0 + 0.5 * x) as f32, (0.2 * y) as f32 - 20.0, 12.0];
        }
        if random.below(3) == 0 {
            belief.p2 = random.uniform(0.05, 0.95) as f32;
        }
        records.push(Record::pack(&belief));
    }
    viewpoint(
        camera(width, height),
        &pose([0.0; 3], [0.0; 3]),
        depth_m,
        records,
    )
}

/// Close to what is expected, what was there earlier, or anything.
fn any_image(random: &mut Random, view: &Viewpoint) -> RgbImage {
    let mut data = Vec::new();
    for record in &view.records {
        let belief = record.unpack();
        let rgb = surprised::model::belief::rgb_from_ycbcr(match random.below(3) {
            0 => belief.tau,
            1 => belief.tau2,
            _ => joint::any_colour(random),
        });
        data.extend(rgb);
    }
    RgbImage {
        width: view.mesh.intrinsics.width,
        height: view.mesh.intrinsics.height,
        data,
    }
}

#[test]
fn a_prior_read_in_half_precision_is_the_same_to_the_bit() {
    let settings = Settings::robust();
    let priors: Vec<Prior> = [true, false]
        .into_iter()
        .map_while(|half_precision| {
            let rules = CardRules {
                half_precision,
                ..CardRules::any()
            };
            let engines = card_engines(rules)?;
            if engines.card()?.has_half_precision() != half_precision {
                skipped("no half precision");
                return None;
            }
            let (target, world_from_target) = target();
            let views = numbered(0, views(&mut Random(5), true));
            let mut prior = Prior::default();
            let mut engine = engines.engine(&settings);
            engine.recall(&views.recall(), &target, &world_from_target, &mut prior);
            assert_eq!(counters(&engine).on_processor, 0);
            Some(prior)
        })
        .collect();
    let [native, portable] = &priors[..] else {
        return;
    };
    assert!(native.plane(prior::COVERAGE).filter(|&c| c > 0.0).count() > 1000);
    assert!(native.data == portable.data);
}

#[test]
fn posterior_surprise_gain_and_evidence_are_those_of_the_reference() {
    let mut exchanged = 0;
    for preset in [Preset::Paper, Preset::Robust] {
        let settings = Settings::preset(preset);
        let Some(mut engine) = gpu(&settings) else {
            return;
        };
        for (round, size) in [(211, 67), (64, 48), (33, 121), (17, 5)]
            .into_iter()
            .enumerate()
        {
            let mut random = Random(round as u64 + 11);
            let view = anything(&mut random, &settings, size);
            let image = any_image(&mut random, &view);
            let observation = Observation::new(&image);
            let question = Question {
                views: &[RecallView {
                    viewpoint: &view,
                    weight: 1.0,
                    fresh: false,
                }],
                intrinsics: &view.mesh.intrinsics,
                world_from_camera: &view.world_from_camera,
                noise: None,
                image: &image,
                observation: &observation,
            };
            let (mut prior, mut score) = (Prior::default(), Score::default());
            let mut found = BlockMap::default();
            let answer = Answer {
                prior: &mut prior,
                score: &mut score,
                evidence: &mut found,
                blocks: &mut BlockMap::default(),
                refiner: &mut PoseRefiner::default(),
            };
            let compared = engine
                .compare(&question, settings.evidence, true, answer, &mut || {})
                .expect("the device is there");
            let learnt = score.posterior.clone();
            assert!(!compared.maps_read);
            engine
                .maps(&mut prior, &mut score)
                .expect("the maps are there");
            assert!(learnt == score.posterior);

            let (width, height) = size;
            let rows = |y: usize| {
                let row = prior.row(y);
                (
                    row.plane(prior::TAU),
                    row.plane(prior::COVERAGE),
                    &observation.planes[0][y * width..][..width],
                )
            };
            let gain = exposure_gain((0..height).map(rows));
            if settings.exposure_gain {
                assert!(
                    (score.gain - gain).abs() < 2e-4,
                    "{} not {gain}",
                    score.gain
                );
            } else {
                assert_eq!(score.gain, 1.0);
            }
            let seen = prior.plane(prior::COVERAGE).filter(|&c| c > 0.0).count();
            assert_eq!(compared.seen, seen);
            assert!(seen > width * height / 2 && seen < width * height);
            let evidence = BlockMap::evidence(&score.surprise, width, settings.evidence);
            assert_eq!(
                (evidence.width, evidence.height),
                (found.width, found.height)
            );
            for (got, expected) in found.data.iter().zip(&evidence.data) {
                assert!((got - expected).abs() <= 1e-5 * expected.max(1.0));
            }
            for y in 0..height {
                for x in 0..width {
                    let pixel = y * width + x;
                    let belief = prior.belief(x, y);
                    let observed: [f64; 3] = std::array::from_fn(|c| {
                        f64::from(observation.planes[c][pixel] * (1.0 / score.gain))
                    });
                    let expected = joint::score(
                        &belief,
                        prior.row(y).plane(prior::COVERAGE)[x].into(),
                        std::array::from_fn(|c| edge(&prior, x, y, c)),
                        observed,
                        &settings,
                    );
                    let context = format!("{preset:?} ({x}, {y}) {belief:?} sees {observed:?}");
                    assert_surprise(score.surprise[pixel], expected.surprise, &context);
                    let threshold = f64::from(settings.surprise_threshold);
                    let decided = (expected.surprise - threshold).abs() > 0.01
                        && (expected.rho2 - 0.5).abs() > 1e-3
                        && (expected.p2 - 0.05).abs() > 1e-3;
                    if decided {
                        assert_stored(&score.posterior[pixel].unpack(), &expected, &context);
                    }
                    exchanged += usize::from(expected.rho2 > 0.5);
                }
            }
        }
    }
    assert!(exchanged > 500, "only {exchanged} appearances came back");
}

#[test]
fn a_view_from_its_own_pose_gives_back_its_records() {
    let settings = Settings::paper();
    let Some(mut engine) = gpu(&settings) else {
        return;
    };
    for (round, size) in [(320, 240), (97, 33), (2, 2), (9, 2)]
        .into_iter()
        .enumerate()
    {
        let mut view = anything(&mut Random(5), &settings, size);
        view.id = round as u64;
        let views = [RecallView {
            viewpoint: &view,
            weight: 1.0,
            fresh: false,
        }];
        let mut prior = Prior::default();
        let intrinsics = view.mesh.intrinsics;
        engine.recall(&views, &intrinsics, &view.world_from_camera, &mut prior);
        for (pixel, record) in view.records.iter().enumerate() {
            let (x, y) = (pixel % size.0, pixel / size.0);
            if prior.row(y).plane(prior::COVERAGE)[x] > 0.0 {
                let (got, mut expected) = (prior.belief(x, y), record.unpack());
                (expected.tau2, expected.p2) = (got.tau2, 0.0);
                assert_eq!(got, expected, "({x}, {y}) of {size:?}");
            }
        }
    }
}

#[test]
fn an_image_that_is_too_large_for_a_small_device_is_recalled_all_the_same() {
    let settings = Settings::robust();
    let Some(mut engine) = gpu(&settings) else {
        return;
    };
    // Its posterior exceeds the 128 MiB of a binding that every device grants.
    let large = camera(2100, 2100);
    let mut prior = Prior::default();
    engine.recall(&[], &large, &pose([0.0; 3], [0.0; 3]), &mut prior);
    assert_eq!((prior.width, prior.height), (2100, 2100));
    assert!(prior.plane(prior::COVERAGE).all(|count| count == 0.0));
    let counters = counters(&engine);
    assert_eq!(counters.on_processor + u64::from(counters.passes > 0), 1);
    assert_eq!(counters.losses, 0);
}

#[test]
fn a_pipeline_on_the_card_reports_what_one_on_the_processor_reports() {
    let Some(engines) = card_engines(CardRules::any()) else {
        return;
    };
    let mut card = Robot::new(&engines);
    let mut cpu = Robot::new(&processor());
    let mut found = 0;
    for (scene, steps) in [
        (place(false), 0..6),
        (place(false), 0..6),
        (place(true), 1..4),
    ] {
        for step in steps {
            found += assert_same_report(&card.see(&scene, step), &cpu.see(&scene, step));
            let (got, expected) = (card.pipeline.maps(), cpu.pipeline.maps());
            let near = got
                .score
                .surprise
                .iter()
                .zip(&expected.score.surprise)
                .filter(|(got, expected)| (*got - *expected).abs() <= 0.05 + 0.05 * **expected)
                .count();
            assert!(
                near as f64 > 0.98 * got.score.surprise.len() as f64,
                "{near}"
            );
        }
    }
    assert!(found >= 2, "the box was found {found} times");
    let counters = counters(card.pipeline.engine());
    // What is learnt is there already.
    assert_eq!(counters.views_brought, 0, "{counters:?}");
    // As the head comment of the engine says: fourteen passes, of the first frame eight less, because nothing is known;
    // ten bytes a pixel up; one report down, and now and then a map.
    let frames = 15;
    assert_eq!(counters.passes, 14 * frames - 8, "{counters:?}");
    let coarse = 12 * (165 / 2) * (123 / 2);
    let parameters = counters.uploaded_bytes - (7 * PIXELS + coarse) * frames;
    assert!(parameters < 3 * 1024 * frames, "{counters:?}");
    let stamps = 19 * 16;
    let reported = frames * (16 + 64 + stamps + 4 * 41 * 30 + 32 * PIXELS);
    let maps = counters.read_back_bytes - reported;
    assert_eq!(
        counters.read_backs,
        frames + maps / (4 * PIXELS),
        "{counters:?}"
    );
    assert_eq!(maps % (4 * PIXELS), 0, "{counters:?}");
    assert!(
        maps >= 2 * 4 * PIXELS && maps < frames * 4 * PIXELS,
        "{counters:?}"
    );
    writeln!(std::io::stderr(), "{counters:?}").unwrap();
}

#[test]
fn what_is_forgotten_is_forgotten_on_the_card_too() {
    let Some(engines) = card_engines(CardRules::any()) else {
        return;
    };
    let mut robot = Robot::new(&engines);
    for step in 0..5 {
        robot.see(&place(false), step);
    }
    let (lens, here) = (camera(165, 123), pose([0.05, 0.0, 0.0], [0.0; 3]));
    let seen = |pipeline: &mut Pipeline| {
        let prior = pipeline.prior(&lens, &here).prior;
        prior
            .plane(prior::COVERAGE)
            .filter(|&count| count > 0.0)
            .count()
    };
    let before = seen(&mut robot.pipeline);
    let mut forgetting = Forgetting::new(Forget {
        region: Some(Region::Sphere {
            center: nalgebra::Point3::new(0.05, 0.05, 2.0),
            radius_m: 0.3,
        }),
        span_ns: None,
    });
    assert!(robot.pipeline.forget(&mut forgetting, 100));
    let after = seen(&mut robot.pipeline);
    // The region's outline, 25 pixels in radius, less what the sphere's edge cuts.
    assert!(
        after + 1900 < before,
        "{after} of {before} pixels are still seen"
    );
    let counters = robot.pipeline.engine().counters();
    assert_eq!(counters.map(|counters| counters.on_processor), Some(0));
}

#[test]
fn a_software_adapter_is_taken_only_when_asked_for() {
    let settings = Settings::robust();
    let Some(asked) = gpu(&settings) else { return };
    let auto = engines(EngineKind::Auto).unwrap().engine(&settings);
    if asked.name().contains("Cpu") {
        assert_eq!(auto.name(), "processor");
    } else {
        assert_eq!(auto.name(), asked.name());
    }
}

/// The Vulkan loader finds no driver where these name none.
#[cfg(target_os = "linux")]
#[test]
fn without_an_adapter_the_card_is_refused_in_one_sentence_and_auto_takes_the_processor() {
    const INSIDE: &str = "SURPRISED_TEST_WITHOUT_ADAPTER";
    if std::env::var_os(INSIDE).is_some() {
        let settings = Settings::robust();
        let refused = engines(EngineKind::Gpu);
        let error = refused.err().expect("there is no driver");
        assert_eq!(error, EngineError::NoAdapter);
        assert!(error.to_string().contains("--engine cpu"));
        let auto = engines(EngineKind::Auto).unwrap().engine(&settings);
        assert_eq!(auto.name(), "processor");
        return;
    }
    let name =
        "without_an_adapter_the_card_is_refused_in_one_sentence_and_auto_takes_the_processor";
    let output = Command::new(std::env::current_exe().unwrap())
        .args(["--exact", name])
        .env(INSIDE, "1")
        .env("VK_DRIVER_FILES", "/nonexistent.json")
        .env("VK_ICD_FILENAMES", "/nonexistent.json")
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{text}");
    assert!(text.contains("1 passed"), "{text}");
}
