//! Frames that others wait for are compared with fewer viewpoints, so that none is left out; a frozen camera's never are.

use surprised::wire::{
    encode,
    keys::{self, CameraPath},
};

use crate::rig::{PATIENCE, ROOT, Rig, Samples, camera, next_report, wall};

/// Viewpoints side by side, farther apart than one grows over another.
const VIEWPOINTS: u64 = 4;
const CAMERAS: usize = 8;
/// In each of them several frames wait at once, unless this machine serves each before the next has come.
const ROUNDS_MAX: u64 = 1000;

struct Crowd {
    rig: Rig,
    cameras: Vec<(CameraPath, Samples)>,
    sequence: u64,
    frames: u64,
}

impl Crowd {
    async fn start() -> Self {
        let rig = Rig::start(&["views_busy=1"]).await;
        let mut cameras = Vec::new();
        for number in 0..CAMERAS {
            let path = camera("lab", &format!("robot{number}"));
            rig.put_calibration(&path).await;
            let reports = rig.subscribe(&path, keys::REPORT).await;
            cameras.push((path, reports));
        }
        let (first, reports) = &cameras[0];
        for sequence in 1..=VIEWPOINTS {
            let frame = wall(first, sequence, 0.04 * sequence as f64);
            rig.put(first, keys::FRAME, &encode::frame(&frame)).await;
            next_report(reports).await;
        }
        Self {
            rig,
            cameras,
            sequence: VIEWPOINTS,
            frames: VIEWPOINTS,
        }
    }

    /// All cameras put a frame at once; of how many reports one viewpoint was enough.
    async fn round(&mut self) -> u64 {
        self.sequence += 1;
        for (path, _) in &self.cameras {
            let frame = encode::frame(&wall(path, self.sequence, 0.1));
            self.rig.put(path, keys::FRAME, &frame).await;
        }
        let mut hurried = 0;
        for (_, reports) in &self.cameras {
            let report = next_report(reports).await;
            assert_eq!(report.sequence, self.sequence, "none is left out");
            hurried += u64::from(report.viewpoints_used.len() == 1);
        }
        self.frames += CAMERAS as u64;
        hurried
    }

    async fn counted(&self) -> u64 {
        let is_told = |status: &serde_json::Value| status["frames"] == self.frames;
        let status = self.rig.status_when("lab", is_told).await;
        status["frames_hurried"].as_u64().expect("a count")
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn frames_that_others_wait_for_are_hurried_and_counted_but_not_a_frozen_cameras() {
    let mut crowd = Crowd::start().await;
    assert_eq!(crowd.counted().await, 0, "one camera alone has time");
    let mut hurried = 0;
    for _ in 0..ROUNDS_MAX {
        hurried += crowd.round().await;
        if hurried > 0 {
            break;
        }
    }
    assert!(hurried > 0, "frames wait");
    assert_eq!(crowd.counted().await, hurried);

    let mode = format!("{}?set=freeze", keys::memory(ROOT, "lab", "mode"));
    tokio::time::timeout(PATIENCE, crowd.rig.ask(&mode))
        .await
        .expect("it is set");
    for _ in 0..20 {
        assert_eq!(crowd.round().await, 0);
    }
    assert_eq!(crowd.counted().await, hurried);
    crowd.rig.stop().await.expect("a clean stop");
}
