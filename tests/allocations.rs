//! A pipeline in its steady state, which overwrites a viewpoint with every frame, allocates nothing; with several
//! threads, what the pool's queue takes.

mod reference;

use std::{
    alloc::{GlobalAlloc, Layout, System},
    sync::atomic::{AtomicUsize, Ordering},
};

use nalgebra::{Point3, Vector3};
use reference::scene::{Panel, Scene, camera, pose};
use surprised::{
    config::{Preset, Settings},
    pipeline::Pipeline,
};

struct Counting;

static ALLOCATIONS: AtomicUsize = AtomicUsize::new(0);

// SAFETY: every call goes to the system's allocator as it came.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.fetch_add(1, Ordering::Relaxed);
        // SAFETY: the caller's promise is passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: as above.
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        ALLOCATIONS.fetch_add(1, Ordering::Relaxed);
        // SAFETY: as above.
        unsafe { System.realloc(pointer, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

fn room() -> Scene {
    let panel = |center: [f64; 3], half_size_m| Panel {
        center: Point3::from(center),
        right: Vector3::x(),
        down: Vector3::y(),
        half_size_m,
        texture: Box::new(|a, b| {
            let wave = (a * 21.0).sin() + (b * 17.0).cos() + (a * 63.0 + b * 40.0).sin();
            [120.0 + 25.0 * wave, 10.0 * wave, -8.0 * wave]
        }),
    };
    Scene {
        panels: vec![
            panel([0.0, 0.0, 2.0], (3.0, 3.0)),
            panel([0.2, 0.1, 1.4], (0.2, 0.2)),
        ],
    }
}

/// So often the frames are shown in a round, and so many rounds there are for the threads to begin in.
const ROUND: usize = 3;
const ROUNDS_MAX: usize = 12;

#[test]
fn a_frame_that_overwrites_allocates_nothing() {
    let scene = room();
    let camera = camera(160, 120);
    let frames: Vec<_> = (0..6)
        .map(|index| {
            let x = 0.004 * f64::from(index);
            scene.frame(
                &camera,
                &pose([x, 0.0, 0.0], [0.0, 0.002, 0.0]),
                index as u64,
            )
        })
        .collect();
    for (preset, threads, most) in [
        (Preset::Paper, 1, 0),
        (Preset::Robust, 1, 0),
        (Preset::Paper, 2, 1),
        (Preset::Robust, 2, 1),
    ] {
        let settings = Settings {
            viewpoints: 4,
            surprise_threshold: 1e6,
            ..Settings::preset(preset)
        };
        let mut pipeline = Pipeline::new(settings, reference::pool(threads));
        let mut round = || {
            let before = ALLOCATIONS.load(Ordering::Relaxed);
            for frame in (0..ROUND).flat_map(|_| &frames) {
                pipeline.process(frame).expect("a good frame");
            }
            ALLOCATIONS.load(Ordering::Relaxed) - before
        };
        // On a busy machine a thread may begin late, or get its first strip late, and allocates then.
        let most = most * ROUND * frames.len();
        let counts: Vec<usize> = (0..ROUNDS_MAX).map(|_| round()).collect();
        assert!(
            counts[1..].iter().any(|&count| count <= most),
            "{counts:?} allocations in rounds of {} frames, {preset:?} on {threads} threads",
            ROUND * frames.len()
        );
    }
}
