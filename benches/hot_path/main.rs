//! Time of the hot path, whole and stage by stage.

#[path = "../../tests/reference/mod.rs"]
mod reference;

mod world;

use std::hint::black_box;

use surprised::{
    config::{Preset, Settings},
    engine::cpu::{CpuEngine, Observation, RecallView, Score},
    isa::Isa,
    model::{
        frame::Frame,
        viewpoint::{Coarse, Mesh},
    },
    pipeline::Pipeline,
    stages::{attend::BlockMap, interpolate::prior::Prior},
};

use world::World;

/// Milliseconds of every repetition.
#[derive(Default)]
struct Times(Vec<f64>);

impl Times {
    fn min(&self) -> f64 {
        self.0.iter().copied().fold(f64::INFINITY, f64::min)
    }

    fn median(&self) -> f64 {
        let mut sorted = self.0.clone();
        sorted.sort_unstable_by(f64::total_cmp);
        sorted.get(sorted.len() / 2).copied().unwrap_or(f64::NAN)
    }
}

/// A pipeline in its steady state: it holds `views` viewpoints and overwrites one of them with every frame.
struct Case {
    name: String,
    threads: usize,
    pipeline: Pipeline,
    frames: Vec<Frame>,
    next: usize,
    stages: [Times; STAGES.len()],
}

const STAGES: [&str; 7] = [
    "whole", "observe", "recall", "score", "mesh", "coarse", "evidence",
];

impl Case {
    fn new(world: &World, preset: Preset, views: usize, threads: usize, noisy: bool) -> Self {
        let settings = Settings {
            views,
            viewpoints: views,
            view_distance_max_m: 1e6,
            grow_distance_m: if preset == Preset::Paper { 0.0 } else { 0.01 },
            ..Settings::preset(preset)
        };
        let mut pipeline = Pipeline::with_isa(settings, reference::pool(threads), isa());
        let frames = world.frames(views + 1, noisy);
        for frame in &frames[..views] {
            pipeline.process(frame).expect("a good frame");
        }
        for frame in &frames {
            pipeline.process(frame).expect("a good frame");
        }
        let camera = frames[0].intrinsics;
        Self {
            name: format!(
                "{}x{} {:?} {} views {threads} thr{}",
                camera.width,
                camera.height,
                preset,
                pipeline.memory().viewpoints().len(),
                if noisy { " noisy" } else { "" }
            ),
            threads,
            pipeline,
            frames,
            next: 0,
            stages: Default::default(),
        }
    }

    fn repeat(&mut self) {
        let frame = &self.frames[self.next % self.frames.len()];
        self.next += 1;
        timed(&mut self.stages[0], || {
            self.pipeline.process(frame).expect("a good frame")
        });
    }
}

/// Seconds that this process has computed: what other processes take does not count.
fn cpu_seconds() -> f64 {
    let mut time = libc::timespec {
        tv_sec: 0,
        tv_nsec: 0,
    };
    // SAFETY: `time` is a valid place to write to.
    unsafe { libc::clock_gettime(libc::CLOCK_PROCESS_CPUTIME_ID, &mut time) };
    time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9
}

fn timed<T>(times: &mut Times, work: impl FnOnce() -> T) -> T {
    let start = cpu_seconds();
    let result = black_box(work());
    times.0.push((cpu_seconds() - start) * 1e3);
    result
}

/// The parts of a frame that stand on their own, on the same memory.
struct Stages {
    engine: CpuEngine,
    prior: Prior,
    score: Score,
}

impl Stages {
    fn repeat(&mut self, case: &mut Case) {
        let frame = &case.frames[case.next % case.frames.len()];
        let settings = case.pipeline.settings().clone();
        let views: Vec<RecallView> = case
            .pipeline
            .memory()
            .viewpoints()
            .iter()
            .take(settings.views)
            .map(|viewpoint| RecallView {
                viewpoint,
                weight: 1.0,
                fresh: false,
            })
            .collect();
        let [_, observe, recall, score, mesh, coarse, evidence] = &mut case.stages;
        let observation = timed(observe, || Observation::new(&frame.image));
        timed(recall, || {
            self.engine.recall(
                &views,
                &frame.intrinsics,
                &frame.world_from_camera,
                &mut self.prior,
            );
        });
        timed(score, || {
            self.engine
                .score(&self.prior, &observation, &mut self.score);
        });
        let depth_m = frame.depth_m.clone();
        let made = timed(mesh, || {
            Mesh::new(frame.intrinsics, depth_m, settings.mesh_cut)
        });
        timed(coarse, || {
            Coarse::new(&made, &self.score.posterior, settings.mesh_cut)
        });
        timed(evidence, || {
            BlockMap::evidence(
                &self.score.surprise,
                frame.intrinsics.width,
                settings.evidence,
            )
        });
    }
}

fn isa() -> Isa {
    match std::env::var("ISA").as_deref() {
        Ok("portable") => Isa::Portable,
        Ok("avx2") => Isa::Avx2,
        _ => Isa::detect(),
    }
}

fn main() {
    let reps: usize = std::env::args()
        .filter_map(|argument| argument.parse().ok())
        .next()
        .unwrap_or(50);
    let full = std::env::args().any(|argument| argument == "full");
    let mut cases = Vec::new();
    let sizes: &[(usize, usize)] = if full {
        &[(320, 240), (640, 480)]
    } else {
        &[(320, 240)]
    };
    for &(width, height) in sizes {
        let world = World::new(width, height);
        for preset in [Preset::Paper, Preset::Robust] {
            let views: &[usize] = if full { &[3, 7, 15] } else { &[7] };
            for &views in views {
                let threads: &[usize] = if full { &[1, 2] } else { &[1] };
                for &threads in threads {
                    cases.push(Case::new(&world, preset, views, threads, false));
                }
            }
            cases.push(Case::new(&world, preset, 7, 1, true));
        }
    }
    let mut stages: Vec<Stages> = cases
        .iter()
        .map(|case| Stages {
            engine: CpuEngine::new(
                case.pipeline.settings(),
                reference::pool(case.threads),
                isa(),
            ),
            prior: Prior::default(),
            score: Score::default(),
        })
        .collect();
    for _ in 0..reps {
        for (case, stages) in cases.iter_mut().zip(&mut stages) {
            case.repeat();
            stages.repeat(case);
        }
    }
    println!("min / median ms of {reps} interleaved repetitions");
    for case in &cases {
        print!("{:32}", case.name);
        for (name, times) in STAGES.iter().zip(&case.stages) {
            print!(" {name} {:.2}/{:.2}", times.min(), times.median());
        }
        println!();
    }
}
