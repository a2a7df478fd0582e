//! Pose refinement on the device: the expected image from the nearest views' coarse meshes, its pyramid, and all steps of
//! all levels, solved there; the estimate is read when they are done.
//!
//! How many levels there are is decided on the device, too: steps of the others are recorded and do nothing.

use super::{
    Counters,
    buffers::{Bound, ESTIMATE_BYTES, STAMPS_BYTES},
    frame::{Failure, State},
    layout::{Estimate, Frame, Level},
    passes::{
        ACCUMULATE, BEGIN, DEPTHS, EXPECT, HALVE, JUDGE, MAGNITUDES, PROJECT_COARSE_DEPTH,
        PROJECT_COARSE_TRIANGLE, REFINE_PIXELS, REFINE_THREADS, STEP,
    },
    recording::{Dispatch, Passes, pass_seconds},
    residency::COARSE_PIXELS,
};
use crate::{
    engine::cpu::RecallView,
    model::{
        camera::Intrinsics,
        frame::RgbImage,
        pose::{Pose, PoseNoise},
    },
    stages::refine::{ITERATIONS, PIXELS_MIN, REFINE_VIEWS, Refined, accepted, believed},
};

use nalgebra::{Quaternion, Translation3, UnitQuaternion};

impl State {
    /// As [`crate::stages::refine::PoseRefiner::refine`]. The image stays for the comparison that follows.
    pub fn refine(
        &mut self,
        views: &[RecallView],
        intrinsics: &Intrinsics,
        world_from_camera: &Pose,
        image: &RgbImage,
        noise: PoseNoise,
        counters: &mut Counters,
    ) -> Result<Refined, Failure> {
        if views.is_empty() {
            return Ok(Refined::unchanged(*world_from_camera));
        }
        let views = &views[..views.len().min(REFINE_VIEWS)];
        let noise = believed(noise);
        let whole = Frame::new(intrinsics.width, intrinsics.height, views.len());
        self.bring(views, counters)?;
        self.has_image = false;
        self.take_image(&whole, image, counters)?;
        let camera = intrinsics.half();
        let half = Frame::new(camera.width, camera.height, views.len());
        let mut placed = self.placed(
            views,
            |viewpoint| &viewpoint.coarse.mesh,
            &camera,
            world_from_camera,
        );
        for view in &mut placed {
            view.first /= COARSE_PIXELS as u32;
        }
        let levels = Level::pyramid(intrinsics, noise);
        counters.uploaded_bytes += self
            .shared
            .upload_coarse(&self.device, &half, &placed, &levels);

        let (recall, score) = self.sizes.last().expect("the image was just taken");
        let at = |level: usize| Bound {
            shared: &self.shared,
            arenas: &self.arenas,
            recall,
            score: Some(score),
            level,
        };
        let mut passes = Passes::new(&self.device, self.queries.as_ref(), "refine");
        passes.clear(&self.shared.histogram);
        let meshes = views.iter().map(|view| &view.viewpoint.coarse.mesh);
        passes.project(
            [PROJECT_COARSE_DEPTH, PROJECT_COARSE_TRIANGLE],
            at(0),
            &half,
            meshes.map(|mesh| &mesh.intrinsics),
        );
        let pixels = |level: usize| [levels[level].width.into(), levels[level].height.into(), 1];
        passes.run(EXPECT, at(0), pixels(0));
        let on = |pass: usize, level: usize, invocations: [u64; 3]| Dispatch {
            pass,
            bound: at(level),
            invocations,
        };
        let halved: Vec<Dispatch> = (1..levels.len())
            .map(|level| on(HALVE, level, pixels(level)))
            .collect();
        passes.run_all("halve", &halved);

        let strided = |level: usize| {
            let pixels = levels[level].pixels();
            [pixels.div_ceil(REFINE_PIXELS.into()), 1, 1]
        };
        let alone = [u64::from(REFINE_THREADS), 1, 1];
        let judge = [on(ACCUMULATE, 0, strided(0)), on(JUDGE, 0, alone)];
        let mut steps = vec![on(DEPTHS, 0, strided(0)), on(BEGIN, 0, alone)];
        steps.extend(judge);
        for level in (0..levels.len()).rev() {
            for _ in 0..ITERATIONS {
                steps.push(on(MAGNITUDES, level, strided(level)));
                steps.push(on(ACCUMULATE, level, strided(level)));
                steps.push(on(STEP, level, alone));
            }
        }
        steps.extend(judge);
        passes.run_all("refine", &steps);

        let refined = &self.shared.refined;
        passes.copy(&self.shared.estimate, refined, 0, ESTIMATE_BYTES);
        passes.resolve(&self.shared.stamps, refined, ESTIMATE_BYTES);
        let run = passes.submit();
        counters.passes += run.labels.len() as u64;
        let bytes = ESTIMATE_BYTES + STAMPS_BYTES;
        let read = self.device.read(refined, bytes, run.index)?;
        counters.read_back_bytes += bytes;
        let (estimate, stamps) = read.split_at(ESTIMATE_BYTES as usize);
        if self.queries.is_some() {
            counters.pass_seconds = pass_seconds(&self.device, &run.labels, stamps);
        }
        let estimate: Estimate = bytemuck::pod_read_unaligned(estimate);
        Ok(judged(&estimate, world_from_camera, noise)
            .unwrap_or_else(|| Refined::unchanged(*world_from_camera)))
    }
}

/// The refined pose, where refinement helps.
fn judged(estimate: &Estimate, world_from_camera: &Pose, noise: PoseNoise) -> Option<Refined> {
    if (estimate.point_count as usize) < PIXELS_MIN {
        return None;
    }
    let mean = |[sum, count]: [f32; 2]| match count {
        0.0 => f64::INFINITY,
        count => f64::from(sum / count),
    };
    let [x, y, z, w] = estimate.rotation.map(f64::from);
    let given_from_real = Pose::from_parts(
        Translation3::from(estimate.translation.map(f64::from)),
        UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z)),
    );
    accepted(
        world_from_camera,
        &given_from_real,
        noise,
        mean(estimate.mismatch_before),
        mean(estimate.mismatch),
    )
}
