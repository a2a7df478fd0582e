//! Time of the hot path, whole and stage by stage, beside the plain scalar `f64` reference and a read of the same memory.
//!
//! `taskset -c 1 cargo bench --bench hot_path -- [REPETITIONS] [full]`; `full` adds 640x480, 3 and 15 views, two threads (not
//! pinned to one core then) and selection among very many viewpoints. `ISA=portable|avx2` chooses instructions. On a Xeon
//! with AVX-512 (2.6 GHz) and two cores, with real-time priority (`chrt -f 10`), because other work would take the second
//! core, least of 60 repetitions, milliseconds:
//!
//! ```text
//!                        320x240   noisy  3 views  15 views  2 threads | 640x480   noisy  3 views  15 views  2 threads
//! paper, 7 views             6.6     9.1      3.9      12.7       3.9  |    24.7    36.8     14.1      50.7      14.0
//! robust, one view more     10.6    12.8      7.1      17.8       6.3  |    38.8    50.9     25.9      67.6      20.9
//! reference (of paper)       187     188        -         -         -  |     780     785        -         -         -
//! reading (of paper)         2.5     2.5      0.9       4.5         -  |     9.0     9.2      3.6      18.1         -
//! ```
//!
//! Of the 6.6: recall 5.2, score 0.8, prepare 0.2, observe 0.1; of the 10.6: refine 1.4, recall 7.1, score 2.0, prepare
//! 0.4. From 3 to 15 views recall takes 0.93 times as much a pixel and view, the whole frame 0.66 (`robust` 0.62), because
//! score and refinement do not grow. Two threads are 1.69 times as fast as one at 320x240, both presets, and 1.77 and 1.85
//! at 640x480 (by the median 1.57, 1.64, 1.79, 1.93). Without priority, beside other work, nothing is gained by the
//! median. A pool's thread that sleeps takes 0.04 to 0.08 ms to take over and hand back. Seven of 1,000,000 viewpoints are
//! selected in 0.006 ms, looking at all of them takes 57.
//!
//! `peers.py`, likewise, least of 60 (640x480: 16): at 320x240 `paper` 6.2, `robust` 10.2, remap of 70 planes 13.0,
//! interleaved 5.7, MOG2 1.9, KNN 4.9, NumPy + SciPy 13.4; at 640x480 23.7, 37.1, 50.2, 18.5, 9.2, 19.1, 65.4. Recall
//! takes 9 ns a pixel and view and is bound by arithmetic: what lies in the second-level cache costs as much.
//!
//! How exact it is, as `tests/merge.rs`, `belief.rs` and `storage.rs` print it: from seven views of a smooth scene tau is
//! 0.0007 grey levels (`robust` 0.001) off the plain mesh's, and 99.98 % of the pixels are seen by as many views; where views
//! disagree, at most 0.019 and 99.96 %. Surprise is within 1.1e-5 of itself, its mean changes by 0.12 % where beliefs are
//! stored, that of a pixel by 0.55 %.

#[path = "../../tests/reference/mod.rs"]
mod reference;

mod world;

use std::{hint::black_box, time::Instant};

use surprised::{
    config::{Preset, Settings},
    engine::cpu::{CpuEngine, Observation, RecallView, Score},
    isa::Isa,
    model::{
        belief::Belief,
        frame::Frame,
        viewpoint::{Coarse, Mesh},
    },
    pipeline::Pipeline,
    stages::{
        attend::BlockMap,
        interpolate::prior::Prior,
        refine::{PoseRefiner, REFINE_VIEWS},
        select::{Nearest, select_nearest},
        view_tree::ViewTree,
    },
};

use world::World;

/// Milliseconds of every repetition.
#[derive(Default)]
struct Times(Vec<f64>);

impl std::fmt::Display for Times {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        if self.0.is_empty() {
            return write!(f, "-");
        }
        write!(f, "{:.2}/{:.2}", self.min(), self.median())
    }
}

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
    pipeline: Pipeline,
    frames: Vec<Frame>,
    next: usize,
    is_plain: bool,
    wall: Times,
    stages: [Times; STAGES.len()],
    work: Stages,
    refiner: PoseRefiner,
}

/// The parts of a frame that stand on their own, on the same memory.
struct Stages {
    engine: CpuEngine,
    observation: Observation,
    prior: Prior,
    score: Score,
    mesh: Mesh,
    coarse: Coarse,
}

const STAGES: [&str; 9] = [
    "cpu", "observe", "refine", "recall", "score", "prepare", "evidence", "plain", "read",
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
        let noise = if noisy { " noisy" } else { "" };
        let views = pipeline.memory().viewpoints().len();
        let (width, height) = (camera.width, camera.height);
        Self {
            name: format!("{width}x{height} {preset:?} {views} views {threads} thr{noise}"),
            refiner: PoseRefiner::new(reference::pool(threads), isa()),
            work: Stages {
                engine: CpuEngine::new(pipeline.settings(), reference::pool(threads), isa()),
                observation: Observation::default(),
                prior: Prior::default(),
                score: Score::default(),
                mesh: Mesh::default(),
                coarse: Coarse::default(),
            },
            pipeline,
            frames,
            next: 0,
            is_plain: preset == Preset::Paper && threads == 1 && views == 7,
            wall: Times::default(),
            stages: Default::default(),
        }
    }

    /// A whole frame; milliseconds of the processor.
    fn repeat(&mut self) -> f64 {
        let frame = &self.frames[self.next % self.frames.len()];
        self.next += 1;
        let start = Instant::now();
        timed(&mut self.stages[0], || {
            self.pipeline.process(frame).expect("a good frame")
        });
        self.wall.0.push(start.elapsed().as_secs_f64() * 1e3);
        self.stages[0].0[self.stages[0].0.len() - 1]
    }

    fn repeat_stages(&mut self) {
        let mut stages = std::mem::take(&mut self.stages);
        let [
            _,
            observe,
            refine,
            recall,
            score,
            prepare,
            evidence,
            plain_times,
            read_times,
        ] = &mut stages;
        if self.is_plain {
            timed(plain_times, || plain(self));
        }
        timed(read_times, || read(self));
        let frame = &self.frames[self.next % self.frames.len()];
        let settings = self.pipeline.settings();
        let views = recall_views(&self.pipeline);
        let work = &mut self.work;
        timed(observe, || {
            work.engine.observe(&frame.image, &mut work.observation)
        });
        if settings.refine_pose {
            let coarse: Vec<_> = views
                .iter()
                .take(REFINE_VIEWS)
                .map(|view| {
                    let viewpoint = view.viewpoint;
                    (&viewpoint.coarse, &viewpoint.world_from_camera, 1.0)
                })
                .collect();
            timed(refine, || {
                self.refiner.refine(
                    &coarse,
                    &work.observation.planes[0],
                    &frame.intrinsics,
                    &frame.world_from_camera,
                    frame.pose_noise.expect("the world says it"),
                )
            });
        }
        timed(recall, || {
            let (camera, pose) = (&frame.intrinsics, &frame.world_from_camera);
            work.engine.recall(&views, camera, pose, &mut work.prior);
        });
        timed(score, || {
            work.engine
                .score(&work.prior, &work.observation, &mut work.score);
        });
        work.mesh.intrinsics = frame.intrinsics;
        let depth_m = frame.depth.given_m().expect("the world measures depth");
        work.mesh.depth_m.clear();
        work.mesh.depth_m.extend_from_slice(depth_m);
        timed(prepare, || {
            work.engine.prepare(
                &mut work.mesh,
                &work.score.posterior,
                settings.refine_pose.then_some(&mut work.coarse),
                settings.mesh_cut.into(),
            );
        });
        timed(evidence, || {
            let width = frame.intrinsics.width;
            BlockMap::evidence(&work.score.surprise, width, settings.evidence)
        });
        self.stages = stages;
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

fn isa() -> Isa {
    match std::env::var("ISA").as_deref() {
        Ok("portable") => Isa::Portable,
        Ok("avx2") => Isa::Avx2,
        _ => Isa::detect(),
    }
}

/// A frame by the plain scalar `f64` reference: recall, update, surprise, block means; nothing is stored.
fn plain(case: &Case) -> f64 {
    let frame = &case.frames[case.next % case.frames.len()];
    let settings = case.pipeline.settings();
    let camera = &frame.intrinsics;
    let views = recall_views(&case.pipeline);
    let beliefs =
        reference::interpolation::recall(&views, camera, &frame.world_from_camera, settings);
    let observation = Observation::new(&frame.image);
    let mut surprise = Vec::with_capacity(beliefs.len());
    for (pixel, seen) in beliefs.iter().enumerate() {
        let narrow = |values: [f64; 3]| values.map(|value| value as f32);
        let Some((belief, coverage)) = seen else {
            surprise.push(0.0);
            continue;
        };
        let prior = Belief {
            alpha: belief.alpha as f32,
            beta: narrow(belief.beta),
            tau: narrow(belief.tau),
            sigma: narrow(belief.sigma),
            tau2: narrow(belief.tau2),
            p2: belief.p2 as f32,
        };
        let observed = [0, 1, 2].map(|c| f64::from(observation.planes[c][pixel]));
        let scored =
            reference::joint::score(&prior, *coverage as f64, [0.0; 3], observed, settings);
        surprise.push(scored.surprise as f32);
    }
    let blocks = BlockMap::evidence(&surprise, camera.width, settings.evidence);
    f64::from(blocks.data.iter().sum::<f32>())
}

/// Reads the records and depths that a frame is recalled from, and does next to nothing with them.
fn read(case: &Case) -> u32 {
    let (mut spread, mut level, mut depth) = ([0u16; 8], [0i16; 8], [0u32; 16]);
    for viewpoint in case.pipeline.memory().viewpoints() {
        for record in &viewpoint.records {
            for k in 0..8 {
                spread[k] ^= record.spread[k];
                level[k] ^= record.level[k];
            }
        }
        for depths in viewpoint.mesh.depth_m.chunks_exact(16) {
            for (sum, z) in depth.iter_mut().zip(depths) {
                *sum ^= z.to_bits();
            }
        }
    }
    let words = spread.map(u32::from).into_iter();
    words
        .chain(level.map(|level| level as u32))
        .chain(depth)
        .fold(0, |sum, word| sum ^ word)
}

fn recall_views(pipeline: &Pipeline) -> Vec<RecallView<'_>> {
    pipeline
        .memory()
        .viewpoints()
        .iter()
        .map(|viewpoint| RecallView {
            viewpoint,
            weight: 1.0,
            fresh: false,
        })
        .collect()
}

/// For `peers.py`: one repetition of the whole for each line on stdin, the processor's milliseconds on stdout; frames to a file first.
fn serve(path: &str, width: usize, height: usize) {
    let world = World::new(width, height);
    let mut cases =
        [Preset::Paper, Preset::Robust].map(|preset| Case::new(&world, preset, 7, 1, false));
    let mut bytes = Vec::new();
    for frame in &cases[0].frames {
        bytes.extend_from_slice(&frame.image.data);
    }
    std::fs::write(path, bytes).expect("the frames can be written");
    for line in std::io::stdin().lines() {
        let case = &mut cases[usize::from(line.expect("text") == "robust")];
        println!("{}", case.repeat());
    }
}

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    if let Some(at) = arguments.iter().position(|argument| argument == "serve") {
        let side = |offset: usize| arguments[at + offset].parse().expect("a size");
        serve(&arguments[at + 1], side(2), side(3));
        return;
    }
    let reps = arguments
        .iter()
        .find_map(|argument| argument.parse().ok())
        .unwrap_or(50);
    let full = arguments.iter().any(|argument| argument == "full");
    let sizes: &[(usize, usize)] = if full {
        &[(320, 240), (640, 480)]
    } else {
        &[(320, 240)]
    };
    let mut cases = Vec::new();
    for &(width, height) in sizes {
        let world = World::new(width, height);
        for preset in [Preset::Paper, Preset::Robust] {
            let kinds: &[(usize, usize, bool)] = if full {
                &[
                    (7, 1, false),
                    (7, 1, true),
                    (3, 1, false),
                    (15, 1, false),
                    (7, 2, false),
                ]
            } else {
                &[(7, 1, false), (7, 1, true)]
            };
            for &(views, threads, noisy) in kinds {
                cases.push(Case::new(&world, preset, views, threads, noisy));
            }
        }
    }
    for _ in 0..reps {
        for case in &mut cases {
            case.repeat();
            case.repeat_stages();
        }
    }
    println!(
        "least / median ms of {reps} interleaved repetitions; stages and `cpu` in time of the processor"
    );
    for case in &cases {
        print!("{:36} wall {}", case.name, case.wall);
        for (name, times) in STAGES.iter().zip(&case.stages) {
            print!(" {name} {times}");
        }
        println!();
    }
    if full {
        selection();
    }
}

/// Seven of very many viewpoints: by looking at all of them, and by the tree.
fn selection() {
    let mut random = reference::Random(1);
    let mut any = || {
        let position = std::array::from_fn(|_| random.uniform(-20.0, 20.0));
        reference::scene::pose(position, std::array::from_fn(|_| random.uniform(-3.0, 3.0)))
    };
    for count in [200, 10_000, 1_000_000] {
        let views: Vec<_> = (0..count).map(|_| any()).collect();
        let mut tree = ViewTree::default();
        let mut build = Times::default();
        timed(&mut build, || tree.build(views.iter()));
        let (mut linear, mut by_tree) = (Times::default(), Times::default());
        for _ in 0..30 {
            let here = any();
            timed(&mut linear, || {
                select_nearest(views.iter(), &here, 1.0, 7, f64::INFINITY)
            });
            // Once is too short to be timed.
            timed(&mut by_tree, || {
                for _ in 0..100 {
                    let mut nearest = Nearest::new(7);
                    tree.offer(|index| &views[index], black_box(&here), 1.0, &mut nearest);
                    black_box(nearest.farthest_m());
                }
            });
        }
        println!(
            "select 7 of {count}: linear {:.4}, tree {:.4}, made once in {:.1} ms",
            linear.median(),
            by_tree.median() / 100.0,
            build.median()
        );
    }
}
