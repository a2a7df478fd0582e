//! The depth stage by itself, answering a driver that lets another method take turns with it:
//! `benches/depth_against_sgbm.py` holds the command and the figures.
//!
//! Each line of standard input, `FOLDER LABELS MOST_DISPARITY CAMERAS THREADS`, estimates the depth of the folder's scene
//! once and prints the milliseconds, of the clock and of the processor. The first line of a kind also allocates.

use std::{
    collections::HashMap,
    io::{BufRead, Write},
    path::Path,
    time::Instant,
};
use surprised::{
    evaluation::stereo::{Cameras, StereoScene},
    stages::depth::{DepthEstimator, DepthSettings, InverseDepthRange},
};

/// Of all threads of this process, which a busy machine does not stretch as it does the clock's time.
fn processor_ms() -> f64 {
    let mut time = libc::timespec {
        tv_sec: 0,
        tv_nsec: 0,
    };
    // SAFETY: the kernel writes one timespec, and it is ours.
    let failed = unsafe { libc::clock_gettime(libc::CLOCK_PROCESS_CPUTIME_ID, &mut time) };
    assert_eq!(failed, 0, "a process has a clock");
    time.tv_sec as f64 * 1e3 + time.tv_nsec as f64 / 1e6
}

fn main() {
    let mut scenes = HashMap::new();
    let mut estimators = HashMap::new();
    for line in std::io::stdin().lock().lines() {
        let line = line.expect("standard input is text");
        let [folder, labels, most_disparity, cameras, threads] = line
            .split_whitespace()
            .collect::<Vec<_>>()
            .try_into()
            .expect("five words a line");
        let scene = scenes
            .entry(folder.to_owned())
            .or_insert_with(|| StereoScene::open(Path::new(folder)).expect("a scene"));
        let range = InverseDepthRange::new(
            0.0,
            most_disparity.parse().expect("pixels"),
            labels.parse().expect("a number of labels"),
        )
        .expect("a range");
        let cameras = if cameras == "2" {
            Cameras::Two
        } else {
            Cameras::Three
        };
        let (pool, estimator) = estimators.entry(line.clone()).or_insert_with(|| {
            let threads = threads.parse().expect("a number of threads");
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .expect("threads");
            (pool, DepthEstimator::new(DepthSettings::default()))
        });
        let rig = scene.rig(cameras);
        let (ms, processor) = pool.install(|| {
            let (start, used) = (Instant::now(), processor_ms());
            estimator.estimate(
                &rig,
                &scene.middle_rgb,
                &scene.left_y,
                &scene.right_y,
                &range,
                None,
            );
            (start.elapsed().as_secs_f64() * 1e3, processor_ms() - used)
        });
        println!("{ms} {processor}");
        std::io::stdout().flush().expect("standard output");
    }
}
