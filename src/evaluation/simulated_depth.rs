//! How good computed depth is in the simulated room, against exact truth: the share of pixels within one label of it.

use serde::Serialize;

use crate::{
    model::frame::{SideView, Sides},
    simulation::{
        room::is_on_cloth,
        scene::ObjectId,
        script::{Capture, Script, Shot, Views},
    },
    stages::depth::{InverseDepthRange, SidesDepth},
};

/// Shares of pixels whose computed depth is within one label of the truth, percent; `None` where there are no such
/// pixels. A pixel that is given no depth is not within it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct WithinLabel {
    pub frames: usize,
    pub labels: usize,
    /// Of inverse depth, 1/m.
    pub label_step: f64,
    /// Everything nearer than the farthest label but glass and cloth.
    pub within_one_label: Option<f64>,
    /// Of the tablecloth, whose pattern repeats.
    pub cloth: Option<f64>,
    /// Of the glass's own front.
    pub glass: Option<f64>,
    /// Of what is behind the glass, where it is seen through it.
    pub behind_glass: Option<f64>,
    /// Of all, given no depth.
    pub invalid: Option<f64>,
    /// Median of |computed - true| / true over pixels with depth, percent.
    pub median_error: Option<f64>,
}

#[derive(Default)]
struct Share {
    good: usize,
    all: usize,
}

impl Share {
    fn add(&mut self, good: bool) {
        self.good += usize::from(good);
        self.all += 1;
    }

    fn percent(&self) -> Option<f64> {
        (self.all > 0).then(|| 100.0 * self.good as f64 / self.all as f64)
    }
}

/// The rig's side images of a capture with [`Views::Triple`], as the service gets them; `None` with another.
pub fn sides(script: &Script, station: usize, capture: &Capture) -> Option<Sides> {
    let rig = &script.stations[station].rig;
    let (left, right) = capture.sides.as_ref()?;
    let view = |shot: &Shot, middle_from_side| SideView {
        image: shot.image.grey(),
        intrinsics: rig.intrinsics,
        middle_from_side,
    };
    Some(Sides {
        left: view(left, rig.middle_from_left),
        right: view(right, rig.middle_from_right),
    })
}

/// Computes the depth of these frames of the script's first station, without a memory's expectation.
pub fn evaluate(script: &Script, frames: &[u64], range: InverseDepthRange) -> WithinLabel {
    let glass_id = script
        .names()
        .find(|(name, _)| *name == "glass")
        .map(|(_, id)| id);
    let mut depth = SidesDepth::new(range);
    let [mut others, mut cloth, mut glass, mut behind, mut invalid]: [Share; 5] =
        std::array::from_fn(|_| Share::default());
    let mut errors: Vec<f32> = Vec::new();
    for &frame in frames {
        let capture = script.capture(0, frame, Views::Triple);
        let sides = sides(script, 0, &capture).expect("all cameras were rendered");
        let middle = &capture.middle;
        let intrinsics = script.stations[0].rig.intrinsics;
        let computed = depth.compute(&intrinsics, &middle.image.grey(), &sides, None);
        for (pixel, &computed_m) in computed.depth_m.iter().enumerate() {
            let near = |true_m: f32| {
                computed_m > 0.0 && (1.0 / computed_m - 1.0 / true_m).abs() <= computed.label_step
            };
            let (true_m, seen) = (middle.depth_m[pixel], middle.object[pixel]);
            invalid.add(computed_m == 0.0);
            if true_m == 0.0 || f64::from(true_m) > 1.0 / range.far {
                continue;
            }
            if Some(seen) == glass_id {
                glass.add(near(true_m));
                behind.add(near(middle.depth_through_glass_m[pixel]));
                continue;
            }
            if computed_m > 0.0 {
                errors.push((computed_m - true_m).abs() / true_m);
            }
            let (u, v) = (pixel % intrinsics.width, pixel / intrinsics.width);
            let point = intrinsics.unproject(u as f64, v as f64, f64::from(true_m));
            let on_cloth =
                seen == ObjectId::ROOM && is_on_cloth(&(capture.world_from_camera * point));
            let share = if on_cloth { &mut cloth } else { &mut others };
            share.add(near(true_m));
        }
    }
    let median = errors.len() / 2;
    let median_error = (!errors.is_empty()).then(|| {
        let (_, error, _) = errors.select_nth_unstable_by(median, f32::total_cmp);
        100.0 * f64::from(*error)
    });
    WithinLabel {
        frames: frames.len(),
        labels: range.labels,
        label_step: range.step(),
        within_one_label: others.percent(),
        cloth: cloth.percent(),
        glass: glass.percent(),
        behind_glass: behind.percent(),
        invalid: invalid.percent(),
        median_error,
    }
}
