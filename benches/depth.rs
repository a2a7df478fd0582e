//! The depth stage by itself, answering a driver that lets another method take turns with it:
//! `benches/depth_against_sgbm.py` holds the command and the figures.
//!
//! Each line of standard input, `FOLDER LABELS MOST_DISPARITY CAMERAS THREADS`, estimates the depth of the folder's scene
//! once and prints the milliseconds. The first line of a kind also allocates.

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
        let ms = pool.install(|| {
            let start = Instant::now();
            estimator.estimate(
                &rig,
                &scene.middle_y,
                &scene.left_y,
                &scene.right_y,
                &range,
                None,
            );
            start.elapsed().as_secs_f64() * 1e3
        });
        println!("{ms}");
        std::io::stdout().flush().expect("standard output");
    }
}
