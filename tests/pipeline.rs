//! A robot's way through a place: it learns, notices what is new, gets used to it, and what is only asked or refused
//! leaves no trace.

mod reference;

use nalgebra::{Point3, Vector3};
use reference::{
    Random, isas, pool,
    scene::{Panel, Scene, camera, pose},
};
use surprised::{
    config::{Preset, Settings},
    model::{
        frame::{DepthSource, Frame},
        mode::Mode,
        pose::Pose,
        report::{PixelBox, Report},
    },
    pipeline::{Effort, Pipeline, Stage},
    pool::Pool,
};

fn texture(seed: u64) -> reference::scene::Texture {
    let mut random = Random(seed);
    let waves: Vec<[f64; 4]> = (0..4)
        .map(|_| {
            let k = std::f64::consts::TAU / random.log_uniform(0.12, 0.8);
            let direction = random.uniform(0.0, std::f64::consts::TAU);
            let phase = random.uniform(0.0, std::f64::consts::TAU);
            [
                k * direction.cos(),
                k * direction.sin(),
                phase,
                random.uniform(6.0, 14.0),
            ]
        })
        .collect();
    Box::new(move |a, b| {
        let wave = |[ka, kb, phase, size]: &[f64; 4]| size * (ka * a + kb * b + phase).sin();
        [150.0 + waves.iter().map(wave).sum::<f64>(), 4.0, -6.0]
    })
}

/// A textured wall and a table; `with_object` a dark box stands on the table.
fn place(with_object: bool) -> Scene {
    let tilt = pose([0.0; 3], [-1.2, 0.0, 0.0]).rotation;
    let mut panels = vec![
        Panel {
            center: Point3::new(0.0, -0.3, 2.4),
            right: Vector3::x(),
            down: Vector3::y(),
            half_size_m: (9.0, 3.0),
            texture: texture(1),
        },
        Panel {
            center: Point3::new(0.0, 0.4, 1.5),
            right: Vector3::x(),
            down: tilt * Vector3::y(),
            half_size_m: (9.0, 1.2),
            texture: texture(2),
        },
    ];
    if with_object {
        panels.push(Panel {
            center: Point3::new(0.0, 0.1, 1.35),
            right: Vector3::x(),
            down: Vector3::y(),
            half_size_m: (0.12, 0.15),
            texture: Box::new(|_, _| [25.0, 0.0, 0.0]),
        });
    }
    Scene { panels }
}

const SIZE: (usize, usize) = (128, 96);
const STEPS: usize = 16;

/// Along an arc around the table, a step every 4 cm.
fn arc(step: usize, offset_m: f64) -> Pose {
    let angle = 0.03 * (step as f64 - (STEPS as f64 - 1.0) / 2.0);
    pose(
        [
            1.35 * angle.sin() + offset_m,
            offset_m,
            1.35 * (1.0 - angle.cos()),
        ],
        [-0.03, -angle, 0.0],
    )
}

/// A frame with sensor noise; its robot believes in the right pose.
fn frame(scene: &Scene, world_from_camera: &Pose, sequence: u64) -> Frame {
    let mut frame = scene.frame(&camera(SIZE.0, SIZE.1), world_from_camera, sequence);
    let mut random = Random(sequence);
    for pixel in frame.image.data.chunks_exact_mut(3) {
        let noise = 1.5 * random.normal();
        for value in pixel {
            *value = (f64::from(*value) + noise).round().clamp(0.0, 255.0) as u8;
        }
    }
    frame
}

/// Where the object is in the image.
fn object_box(world_from_camera: &Pose) -> PixelBox {
    let picture = place(true).picture(&camera(SIZE.0, SIZE.1), world_from_camera);
    let pixels = (0..picture.panel.len()).filter(|&pixel| picture.panel[pixel] == Some(2));
    let mut found = PixelBox {
        x_min: u32::MAX,
        y_min: u32::MAX,
        x_max: 0,
        y_max: 0,
    };
    for pixel in pixels {
        let (x, y) = ((pixel % SIZE.0) as u32, (pixel / SIZE.0) as u32);
        found.x_min = found.x_min.min(x);
        found.y_min = found.y_min.min(y);
        found.x_max = found.x_max.max(x + 1);
        found.y_max = found.y_max.max(y + 1);
    }
    found
}

fn finds(report: &Report, world_from_camera: &Pose) -> bool {
    let truth = object_box(world_from_camera);
    report
        .regions
        .iter()
        .any(|region| region.pixel_box.iou(&truth) > 0.4)
}

struct Robot {
    pipeline: Pipeline,
    sequence: u64,
}

impl Robot {
    fn new(settings: Settings) -> Self {
        Self {
            pipeline: Pipeline::new(settings, pool(1)),
            sequence: 0,
        }
    }

    fn see(&mut self, scene: &Scene, world_from_camera: &Pose) -> Report {
        self.sequence += 1;
        let frame = frame(scene, world_from_camera, self.sequence);
        self.pipeline.process(&frame).expect("the frame is good")
    }

    /// There and back, then elsewhere: what changes meanwhile was not seen to change.
    fn learn(&mut self, scene: &Scene) {
        for step in (0..STEPS).chain((0..STEPS).rev()) {
            self.see(scene, &arc(step, 0.0));
        }
        for step in 0..8 {
            self.see(
                scene,
                &pose([3.0 + 0.1 * f64::from(step), 0.0, 0.0], [0.0; 3]),
            );
        }
    }
}

#[test]
fn a_learnt_place_is_not_surprising() {
    for preset in [Preset::Paper, Preset::Robust] {
        let mut robot = Robot::new(Settings::preset(preset));
        robot.learn(&place(false));
        for step in 0..STEPS {
            let report = robot.see(&place(false), &arc(step, 0.006));
            assert!(
                report.regions.is_empty(),
                "{preset:?} {step}: {:?}",
                report.regions
            );
            assert!(
                report.coverage > 0.9,
                "{preset:?} {step}: {}",
                report.coverage
            );
        }
    }
}

#[test]
fn a_passing_robot_reports_a_new_object_on_its_whole_way() {
    let mut robot = Robot::new(Settings::robust());
    robot.learn(&place(false));
    let mut ids = Vec::new();
    for step in 0..STEPS {
        let here = arc(step, 0.004);
        let report = robot.see(&place(true), &here);
        assert!(
            finds(&report, &here),
            "step {step}: {:?} is not at {:?}",
            report.regions,
            object_box(&here)
        );
        let center = report.regions[0].center_in_world.expect("it has depth");
        assert!(
            (center - Point3::new(0.0, 0.1, 1.35)).norm() < 0.06,
            "{center}"
        );
        ids.push(report.regions[0].id);
    }
    assert!(ids.windows(2).all(|pair| pair[0] == pair[1]), "{ids:?}");

    // On the way back it is known, and its removal is not surprising either.
    let mut known = 0;
    for step in (0..STEPS).rev() {
        let here = arc(step, 0.0);
        known += usize::from(!finds(&robot.see(&place(true), &here), &here));
    }
    assert!(known + 2 >= STEPS, "known in {known} of {}", STEPS);
    let mut missed = 0;
    for step in 0..STEPS {
        let here = arc(step, 0.002);
        missed += usize::from(finds(&robot.see(&place(false), &here), &here));
    }
    assert!(
        missed <= 2,
        "its removal surprised in {missed} of {}",
        STEPS
    );
}

#[test]
fn a_standing_robot_gets_used_to_a_new_object_within_forty_frames() {
    let mut robot = Robot::new(Settings::robust());
    robot.learn(&place(false));
    let here = arc(STEPS / 2, 0.0);
    let reports: Vec<Report> = (0..50).map(|_| robot.see(&place(true), &here)).collect();
    let found: Vec<bool> = reports.iter().map(|report| finds(report, &here)).collect();
    assert!(found[..5].iter().all(|found| *found), "{found:?}");
    let used_to = found.iter().position(|found| !found).unwrap_or(found.len());
    println!("used to it after {used_to} frames");
    assert!((10..=40).contains(&used_to), "{found:?}");
    assert!(found[40..].iter().all(|found| !found), "{found:?}");
}

fn same_memory(a: &Pipeline, b: &Pipeline) -> bool {
    let (a, b) = (a.memory(), b.memory());
    a.viewpoints() == b.viewpoints() && a.bytes() == b.bytes()
}

#[test]
fn the_number_of_threads_and_the_instruction_set_change_no_bit_of_what_is_learnt() {
    for preset in [Preset::Paper, Preset::Robust] {
        let mut robots: Vec<Robot> = isas()
            .into_iter()
            .flat_map(|isa| [(isa, 1), (isa, 2), (isa, 5)])
            .map(|(isa, threads)| Robot {
                pipeline: Pipeline::with_isa(Settings::preset(preset), pool(threads), isa),
                sequence: 0,
            })
            .collect();
        for step in 0..STEPS {
            let scene = place(step > STEPS / 2);
            let here = arc(step, 0.002);
            let reports: Vec<Report> = robots
                .iter_mut()
                .map(|robot| robot.see(&scene, &here))
                .collect();
            assert!(reports.windows(2).all(|pair| pair[0] == pair[1]));
        }
        let alike = |pair: &[Robot]| same_memory(&pair[0].pipeline, &pair[1].pipeline);
        assert!(robots.windows(2).all(alike));
    }
}

#[test]
fn how_many_others_compute_says_on_which_thread_a_frame_is_but_nothing_of_what_is_learnt() {
    let pool = Pool::from(pool(2));
    let here = std::thread::current().id();
    let mut pipelines = [(); 3].map(|()| Pipeline::new(Settings::robust(), pool.clone()));
    for step in 0..STEPS {
        let frame = frame(&place(step > STEPS / 2), &arc(step, 0.002), step as u64 + 1);
        let mut others = Vec::new();
        let mut reports = Vec::new();
        for (pipeline, on_own_thread) in pipelines.iter_mut().zip([
            false, // It has both threads of the pool.
            true,  // The other thread has enough to do.
            false, // It takes turns with the others at the pool's.
        ]) {
            let mut thread = None;
            let mut ended = |stage| {
                if stage == Stage::Refine {
                    thread = Some(std::thread::current().id());
                }
            };
            let report = pipeline.process_staged(Mode::Learn, Effort::Whole, &frame, &mut ended);
            reports.push(report.expect("a good frame"));
            let is_here = thread.expect("it was refined") == here;
            assert_eq!(is_here, on_own_thread, "beside {} others", others.len());
            others.push(pool.begin());
        }
        assert!(reports.windows(2).all(|pair| pair[0] == pair[1]));
    }
    assert!(
        pipelines
            .windows(2)
            .all(|pair| same_memory(&pair[0], &pair[1]))
    );
}

#[test]
fn a_hurried_frame_is_compared_with_the_nearest_and_learnt_where_it_would_be() {
    let settings = Settings {
        views_busy: 2,
        ..Settings::robust()
    };
    let mut pipelines = [(); 2].map(|()| Pipeline::new(settings.clone(), pool(1)));
    let mut hurried = 0;
    for step in 0..STEPS {
        let frame = frame(&place(false), &arc(step, 0.002), step as u64 + 1);
        let effort = [Effort::Whole, Effort::Hurried];
        let [whole, fewer] = [0, 1].map(|index| {
            let pipeline: &mut Pipeline = &mut pipelines[index];
            pipeline
                .process_staged(Mode::Learn, effort[index], &frame, &mut |_| {})
                .expect("a good frame")
        });
        let known = whole.viewpoints_used.len();
        assert_eq!(
            fewer.viewpoints_used[..],
            whole.viewpoints_used[..known.min(2)]
        );
        assert_eq!(fewer.viewpoint_id, whole.viewpoint_id);
        hurried += usize::from(known > 2);
    }
    assert!(hurried > STEPS / 2, "{hurried} frames had more than two");
    // Asked without hurry, both recall as many again.
    let frame = frame(&place(false), &arc(STEPS / 2, 0.0), STEPS as u64 + 1);
    let [first, second] = pipelines.each_mut().map(|pipeline| {
        let report = pipeline.process(&frame).expect("a good frame");
        report.viewpoints_used
    });
    assert_eq!(first, second);
}

#[test]
fn evaluating_or_asking_changes_nothing_bit_for_bit() {
    for preset in [Preset::Paper, Preset::Robust] {
        let mut plain = Robot::new(Settings::preset(preset));
        let mut asked = Robot::new(Settings::preset(preset));
        for step in 0..STEPS {
            let scene = place(step > STEPS / 2);
            let other = frame(&place(step % 2 == 0), &arc(step, 0.05), 1000 + step as u64);
            let looked = asked.pipeline.evaluate(&other).expect("the frame is good");
            assert!(!looked.learned && looked.viewpoint_id.is_none());
            asked.pipeline.prior(&camera(31, 23), &arc(step, -0.1));
            let here = arc(step, 0.0);
            assert_eq!(plain.see(&scene, &here), asked.see(&scene, &here));
            assert!(same_memory(&plain.pipeline, &asked.pipeline));
        }
    }
}

#[test]
fn what_evaluate_says_is_what_processing_would_have_said() {
    let mut robot = Robot::new(Settings::robust());
    robot.learn(&place(false));
    let here = arc(5, 0.003);
    let frame = frame(&place(true), &here, 500);
    let looked = robot.pipeline.evaluate(&frame).expect("the frame is good");
    let map = robot.pipeline.maps().score.surprise.clone();
    let processed = robot.pipeline.process(&frame).expect("the frame is good");
    assert_eq!(robot.pipeline.maps().score.surprise, map);
    assert!(finds(&processed, &here));
    let mut expected = looked;
    expected.learned = true;
    expected.viewpoint_id = processed.viewpoint_id;
    for (region, other) in expected.regions.iter_mut().zip(&processed.regions) {
        region.id = other.id;
    }
    assert_eq!(expected, processed);
}

type Spoil = Box<dyn Fn(&mut Frame)>;

fn given(frame: &mut Frame) -> &mut Vec<f32> {
    match &mut frame.depth {
        DepthSource::Given(depth_m) => depth_m,
        DepthSource::Sides(_) => panic!("these frames have depth"),
    }
}

#[test]
fn rejected_frames_change_nothing_and_say_why() {
    let mut plain = Robot::new(Settings::robust());
    let mut bothered = Robot::new(Settings::robust());
    for step in 0..STEPS {
        let here = arc(step, 0.0);
        let good = frame(&place(false), &here, 700);
        let bad: [(&str, Spoil); 6] = [
            ("image_size", Box::new(|frame| frame.image.width -= 1)),
            ("depth_size", Box::new(|frame| given(frame).truncate(100))),
            ("no_depth", Box::new(|frame| given(frame).fill(0.0))),
            ("no_depth", Box::new(|frame| given(frame).fill(f32::NAN))),
            ("no_depth", Box::new(|frame| given(frame).fill(-1.0))),
            (
                "depth_unit",
                Box::new(|frame| given(frame).iter_mut().for_each(|z| *z *= 1000.0)),
            ),
        ];
        for (code, spoil) in bad {
            let mut frame = good.clone();
            spoil(&mut frame);
            let refused = bothered.pipeline.process(&frame).expect_err(code);
            assert_eq!(refused.code(), code, "{refused}");
            assert_eq!(bothered.pipeline.evaluate(&frame).expect_err(code), refused);
        }
        assert_eq!(
            plain.see(&place(false), &here),
            bothered.see(&place(false), &here)
        );
        assert!(same_memory(&plain.pipeline, &bothered.pipeline));
    }
}

#[test]
fn frames_of_any_size_are_processed() {
    for (width, height) in [
        (1, 1),
        (1, 40),
        (40, 1),
        (2, 2),
        (3, 5),
        (4, 400),
        (17, 19),
        (61, 7),
    ] {
        for preset in [Preset::Paper, Preset::Robust] {
            let mut robot = Robot::new(Settings::preset(preset));
            for sequence in 0..3 {
                let here = arc(sequence as usize, 0.0);
                let mut frame = place(false).frame(&camera(width, height), &here, sequence);
                frame.pose_noise = Some(surprised::model::pose::PoseNoise {
                    position_m: 0.1,
                    rotation_rad: 0.1,
                });
                let report = robot.pipeline.process(&frame).expect("the frame is good");
                assert_eq!((report.width, report.height), (width, height));
                assert!(report.max_surprise.is_finite());
            }
        }
    }
}
