//! Pose refinement on the device: the expected image from the nearest views' coarse meshes, its pyramid, and all steps of
//! all levels, solved and judged there; the views of the comparison that follows are placed by the estimate, which is read
//! with the report.
//!
//! How many levels there are is decided on the device, too: steps of the others are recorded and do nothing.

use super::{
    buffers::Bound,
    frame::State,
    layout::{Estimate, Frame, Level},
    passes::{
        ACCUMULATE, BEGIN, DEPTHS, EXPECT, HALVE, JUDGE, MAGNITUDES, PLACE, PROJECT_COARSE_DEPTH,
        PROJECT_COARSE_TRIANGLE, REFINE_PIXELS, REFINE_THREADS, STEP,
    },
    recording::{Dispatch, Passes},
    residency::COARSE_PIXELS,
};
use crate::{
    engine::cpu::RecallView,
    model::{
        camera::Intrinsics,
        pose::{Pose, PoseNoise},
    },
    stages::refine::{ITERATIONS, REFINE_VIEWS, Refined},
};

use nalgebra::{Quaternion, Translation3, UnitQuaternion};

impl State {
    /// Records what [`crate::stages::refine::PoseRefiner::refine`] does, for a frame with these views, and places them.
    /// Returns how many bytes went up.
    pub(super) fn refine<'a>(
        &'a self,
        passes: &mut Passes<'a>,
        bound: Bound<'a>,
        views: &[RecallView],
        intrinsics: &Intrinsics,
        world_from_camera: &Pose,
        noise: PoseNoise,
    ) -> u64 {
        let view_count = views.len() as u64;
        let views = &views[..views.len().min(REFINE_VIEWS)];
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
        let uploaded_bytes = self
            .shared
            .upload_coarse(&self.device, &half, &placed, &levels);
        let at = |level: usize| Bound { level, ..bound };
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
        passes.run(PLACE, at(0), [view_count, 1, 1]);
        uploaded_bytes
    }
}

/// The refined pose, where refinement helps.
pub(super) fn refined(estimate: &Estimate, world_from_camera: &Pose) -> Refined {
    if estimate.accepted == 0 {
        return Refined::unchanged(*world_from_camera);
    }
    let [x, y, z, w] = estimate.rotation.map(f64::from);
    let given_from_real = Pose::from_parts(
        Translation3::from(estimate.translation.map(f64::from)),
        UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z)),
    );
    Refined::moved(world_from_camera, &given_from_real)
}
