//! Section III-D: the meshes of the views, projected one triangle after the other, and the merge of what they say.

use nalgebra::{Point3, Vector2};
use surprised::{
    config::Settings,
    engine::cpu::RecallView,
    model::{belief::CHANNELS, camera::Intrinsics, pose::Pose, viewpoint::Viewpoint},
};

/// A belief as interpolated: the stored parameters with an earlier appearance.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Interpolated {
    pub alpha: f64,
    pub beta: [f64; CHANNELS],
    pub tau: [f64; CHANNELS],
    pub sigma: [f64; CHANNELS],
    pub tau2: [f64; CHANNELS],
    pub p2: f64,
    /// Of the target camera, metres.
    pub depth_m: f64,
}

/// What one view says about every pixel of the target; `None` where it sees nothing.
pub fn project(
    view: &Viewpoint,
    target: &Intrinsics,
    world_from_target: &Pose,
    cut: f64,
) -> Vec<Option<Interpolated>> {
    let source = view.mesh.intrinsics;
    let (width, height) = (source.width, source.height);
    let target_from_view = world_from_target.inverse() * view.world_from_camera;
    let z_of = |x: usize, y: usize| f64::from(view.mesh.depth_m[y * width + x]);
    let mut image = vec![None; target.pixels()];
    for y in 0..height.saturating_sub(1) {
        for x in 0..width.saturating_sub(1) {
            let quad = [
                [(x, y), (x + 1, y), (x, y + 1)],
                [(x + 1, y + 1), (x, y + 1), (x + 1, y)],
            ];
            for corners in quad {
                let z = corners.map(|(x, y)| z_of(x, y));
                let nearest = z[0].min(z[1]).min(z[2]);
                let farthest = z[0].max(z[1]).max(z[2]);
                if nearest <= 0.0 || farthest - nearest > cut * nearest {
                    continue;
                }
                let points: [Point3<f64>; 3] = std::array::from_fn(|i| {
                    let (x, y) = corners[i];
                    target_from_view * source.unproject(x as f64, y as f64, z[i])
                });
                if points.iter().any(|point| point.z < 0.02) {
                    continue;
                }
                let beliefs = corners.map(|(x, y)| view.records[y * width + x].unpack());
                draw(&points, &beliefs, target, &mut image);
            }
        }
    }
    image
}

fn draw(
    points: &[Point3<f64>; 3],
    beliefs: &[surprised::model::belief::Belief; 3],
    target: &Intrinsics,
    image: &mut [Option<Interpolated>],
) {
    let corner = points.map(|point| {
        let (u, v) = target.project(&point).expect("it lies before the camera");
        Vector2::new(u, v)
    });
    // Clockwise as seen, y down: the front.
    let twice_area = (corner[1] - corner[0]).perp(&(corner[2] - corner[0]));
    if twice_area <= 0.0 {
        return;
    }
    let low = corner[0].inf(&corner[1]).inf(&corner[2]);
    let high = corner[0].sup(&corner[1]).sup(&corner[2]);
    let first = |low: f64| (low - 1e-6).ceil().max(0.0) as usize;
    let end =
        |high: f64, size: usize| ((high + 1e-6).floor() + 1.0).clamp(0.0, size as f64) as usize;
    for v in first(low.y)..end(high.y, target.height) {
        for u in first(low.x)..end(high.x, target.width) {
            let pixel = Vector2::new(u as f64, v as f64);
            let screen: [f64; 3] = std::array::from_fn(|i| {
                let (a, b) = (corner[(i + 1) % 3], corner[(i + 2) % 3]);
                (b - a).perp(&(pixel - a)) / twice_area
            });
            if screen.iter().any(|weight| *weight < -1e-6) {
                continue;
            }
            let inverse: [f64; 3] = std::array::from_fn(|i| screen[i] / points[i].z);
            let depth_m = 1.0 / (inverse[0] + inverse[1] + inverse[2]);
            let slot = &mut image[v * target.width + u];
            if slot.is_none_or(|held: Interpolated| depth_m < held.depth_m) {
                let weights = inverse.map(|inverse| inverse * depth_m);
                *slot = Some(interpolate(beliefs, weights, depth_m));
            }
        }
    }
}

fn interpolate(
    beliefs: &[surprised::model::belief::Belief; 3],
    weights: [f64; 3],
    depth_m: f64,
) -> Interpolated {
    let mut sum = Interpolated {
        depth_m,
        ..Interpolated::default()
    };
    for (belief, weight) in beliefs.iter().zip(weights) {
        sum.alpha += weight * f64::from(belief.alpha);
        sum.p2 += weight * f64::from(belief.p2);
        for c in 0..CHANNELS {
            sum.beta[c] += weight * f64::from(belief.beta[c]);
            sum.tau[c] += weight * f64::from(belief.tau[c]);
            sum.sigma[c] += weight * f64::from(belief.sigma[c]);
            // It counts as much as is believed of it.
            sum.tau2[c] += weight * f64::from(belief.p2) * f64::from(belief.tau2[c]);
        }
    }
    if sum.p2 > 0.0 {
        sum.tau2 = sum.tau2.map(|tau2| tau2 / sum.p2);
    }
    sum
}

/// One pixel of the prior; `None` where no view covers it. `(belief, coverage)`.
pub fn merge(
    seen: &[(Interpolated, f64, bool)],
    settings: &Settings,
) -> Option<(Interpolated, usize)> {
    if seen.is_empty() {
        return None;
    }
    // What this visit wrote over, and did not confirm since, speaks for what was there before.
    let seen: Vec<_> = seen
        .iter()
        .map(|&(mut said, weight, fresh)| {
            if settings.earlier_appearance && fresh && weight < 0.5 && said.p2 >= 0.49 {
                (said.tau, said.p2) = (said.tau2, 0.0);
            }
            (said, weight, fresh)
        })
        .collect();
    let weight = |i: usize| seen[i].1;
    let mut kept: Vec<usize> = (0..seen.len()).collect();
    // Step 2a.
    if settings.depth_vote {
        let mut order = kept.clone();
        order.sort_by(|&a, &b| seen[a].0.depth_m.total_cmp(&seen[b].0.depth_m));
        let half = order.iter().map(|&i| weight(i)).sum::<f64>() / 2.0;
        let mut below = 0.0;
        let median = order.iter().find(|&&i| {
            below += weight(i);
            below >= half - 1e-9
        });
        let median = seen[*median.expect("all weigh more than half")].0.depth_m;
        let tolerance = f64::from(settings.depth_vote_tolerance);
        kept.retain(|&i| (seen[i].0.depth_m - median).abs() <= tolerance * median);
    }
    // Step 2b.
    if settings.colour_vote {
        let range: f64 = (0..CHANNELS)
            .map(|c| {
                let tau = |i: &usize| seen[*i].0.tau[c];
                let high = kept.iter().map(tau).fold(f64::NEG_INFINITY, f64::max);
                high - kept.iter().map(tau).fold(f64::INFINITY, f64::min)
            })
            .sum();
        if range > 40.0 {
            let cost = |a: usize| -> f64 {
                kept.iter()
                    .map(|&b| weight(b) * distance(&seen[a].0.tau, &seen[b].0.tau).min(80.0))
                    .sum()
            };
            let medoid = kept
                .iter()
                .copied()
                .min_by(|&a, &b| cost(a).total_cmp(&cost(b)));
            let medoid = seen[medoid.expect("some view is kept")].0.tau;
            kept.retain(|&i| distance(&seen[i].0.tau, &medoid) <= 40.0);
        }
    }
    // Step 2c.
    let total: f64 = kept.iter().map(|&i| weight(i)).sum();
    let mean = |value: &dyn Fn(&Interpolated) -> f64| -> f64 {
        kept.iter()
            .map(|&i| weight(i) * value(&seen[i].0))
            .sum::<f64>()
            / total
    };
    let mut belief = Interpolated {
        alpha: mean(&|b| b.alpha),
        depth_m: mean(&|b| b.depth_m),
        ..Interpolated::default()
    };
    for c in 0..CHANNELS {
        belief.tau[c] = mean(&|b| b.tau[c]);
        belief.sigma[c] = mean(&|b| b.sigma[c]);
        belief.beta[c] = mean(&|b| b.beta[c]);
        if settings.view_variance {
            belief.beta[c] += belief.alpha * mean(&|b| (b.tau[c] - belief.tau[c]).powi(2));
        }
    }
    // Step 2d.
    if settings.earlier_appearance {
        let mut candidates = Vec::new();
        let mut all = 0.0;
        for (i, (interpolated, w, fresh)) in seen.iter().enumerate() {
            if kept.contains(&i) {
                candidates.push((interpolated.tau2, w * interpolated.p2));
                all += w;
            } else if !fresh {
                candidates.push((interpolated.tau, w * (1.0 - interpolated.p2)));
                all += w;
            }
        }
        let heaviest = candidates
            .iter()
            .copied()
            .max_by(|a, b| a.1.total_cmp(&b.1));
        let heaviest = heaviest.expect("the kept are candidates");
        if heaviest.1 > 0.0 {
            candidates.retain(|(tau, _)| distance(tau, &heaviest.0) <= 40.0);
            let weight: f64 = candidates.iter().map(|(_, w)| w).sum();
            for c in 0..CHANNELS {
                belief.tau2[c] = candidates.iter().map(|(tau, w)| w * tau[c]).sum::<f64>() / weight;
            }
            belief.p2 = (weight / all).min(0.95);
        }
    }
    Some((belief, seen.len()))
}

fn distance(a: &[f64; CHANNELS], b: &[f64; CHANNELS]) -> f64 {
    (0..CHANNELS).map(|c| (a[c] - b[c]).abs()).sum()
}

/// The whole prior.
pub fn recall(
    views: &[RecallView],
    target: &Intrinsics,
    world_from_target: &Pose,
    settings: &Settings,
) -> Vec<Option<(Interpolated, usize)>> {
    let cut = f64::from(settings.mesh_cut);
    let images: Vec<_> = views
        .iter()
        .map(|view| project(view.viewpoint, target, world_from_target, cut))
        .collect();
    (0..target.pixels())
        .map(|pixel| {
            let seen: Vec<_> = images
                .iter()
                .zip(views)
                .filter_map(|(image, view)| {
                    image[pixel].map(|seen| (seen, f64::from(view.weight), view.fresh))
                })
                .collect();
            merge(&seen, settings)
        })
        .collect()
}
