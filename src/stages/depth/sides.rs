//! Depth of frames of several rigs, in buffers that are kept.
//! In: the middle image, what its sides saw. Out: as [`DepthEstimator`].

use super::{DepthEstimator, DepthMap, DepthRig, DepthSettings, InverseDepthRange, SideCamera};
use crate::{
    isa::Isa,
    model::{
        camera::Intrinsics,
        frame::{RgbImage, SideView, Sides},
    },
};

/// Rigs whose tables and buffers are kept; robots of one make share theirs. Each takes some bytes a pixel and label.
const RIGS_MAX: usize = 4;

/// Estimators of the rigs that were seen last.
pub struct SidesDepth {
    isa: Isa,
    range: InverseDepthRange,
    /// The latest at the end.
    estimators: Vec<(DepthRig, DepthEstimator)>,
}

impl SidesDepth {
    pub fn new(range: InverseDepthRange, isa: Isa) -> Self {
        Self {
            isa,
            range,
            estimators: Vec::new(),
        }
    }

    /// `middle` is the image's camera; all images have their cameras' sizes. `expected_depth_m` as for
    /// [`DepthEstimator::estimate`].
    pub fn compute(
        &mut self,
        middle: &Intrinsics,
        image: &RgbImage,
        sides: &Sides,
        expected_depth_m: Option<&[f32]>,
    ) -> &DepthMap {
        let camera = |side: &SideView| SideCamera {
            intrinsics: side.intrinsics,
            side_from_middle: side.middle_from_side.inverse(),
        };
        let rig = DepthRig {
            middle: *middle,
            left: Some(camera(&sides.left)),
            right: Some(camera(&sides.right)),
        };
        let known = self.estimators.iter().position(|(known, _)| *known == rig);
        let estimator = match known {
            Some(index) => self.estimators.remove(index).1,
            None => {
                if self.estimators.len() == RIGS_MAX {
                    self.estimators.remove(0);
                }
                DepthEstimator::with_isa(DepthSettings::default(), self.isa)
            }
        };
        self.estimators.push((rig, estimator));
        let (rig, estimator) = self.estimators.last_mut().expect("one was pushed just now");
        estimator.estimate(
            rig,
            image.data.as_chunks().0,
            &sides.left.image.data,
            &sides.right.image.data,
            &self.range,
            expected_depth_m,
        )
    }
}
