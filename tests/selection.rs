//! The nearest viewpoints and the exposure gain are what sorting everything would give.

mod reference;

use nalgebra::Vector3;
use reference::{Random, scene::pose};
use surprised::{
    model::pose::Pose,
    stages::{
        exposure::exposure_gain,
        select::{Nearest, select_nearest},
        view_tree::ViewTree,
    },
};

#[test]
fn the_nearest_viewpoints_are_those_of_sorting_them_all() {
    let mut random = Random(1);
    for count in [0, 1, 6, 7, 8, 200] {
        for metres_per_radian in [0.0, 1.0, 3.0] {
            let any = |random: &mut Random| {
                pose(
                    std::array::from_fn(|_| random.uniform(-1.0, 1.0)),
                    std::array::from_fn(|_| random.uniform(-1.0, 1.0)),
                )
            };
            let mut views: Vec<Pose> = (0..count).map(|_| any(&mut random)).collect();
            if count > 10 {
                // Ties go to the earlier.
                views[150] = views[20];
            }
            let here = any(&mut random);
            let axis = |pose: &Pose| pose.rotation * Vector3::z();
            let distance = |view: &Pose| {
                let angle = axis(view).dot(&axis(&here)).clamp(-1.0, 1.0).acos();
                (view.translation.vector - here.translation.vector).norm()
                    + metres_per_radian * angle
            };
            let mut expected: Vec<usize> = (0..count).collect();
            expected.sort_by(|&a, &b| distance(&views[a]).total_cmp(&distance(&views[b])));
            expected.truncate(7);
            let got = select_nearest(views.iter(), &here, metres_per_radian, 7, f64::INFINITY);
            assert_eq!(got, expected, "{count} views, {metres_per_radian} m/rad");
        }
    }
}

#[test]
fn the_tree_selects_what_looking_at_every_viewpoint_selects() {
    let mut random = Random(7);
    let any = |random: &mut Random| {
        // Several at the same place, as from a robot that turns.
        let place = random.below(12) as f64;
        pose(
            [place, 0.2 * random.uniform(-1.0, 1.0), place * place / 10.0],
            std::array::from_fn(|_| random.uniform(-1.5, 1.5)),
        )
    };
    for count in [0usize, 1, 15, 40, 3000] {
        let mut views: Vec<Pose> = (0..count).map(|_| any(&mut random)).collect();
        let mut tree = ViewTree::default();
        tree.build(views.iter());
        for round in 0..60 {
            // Some move, some come, some stand where another stands.
            if count > 0 {
                let index = random.below(views.len());
                views[index] = views[random.below(views.len())];
                tree.changed(index);
                views.push(any(&mut random));
                tree.changed(views.len() - 1);
            }
            let here = any(&mut random);
            for (metres_per_radian, distance_max_m) in
                [(0.0, f64::INFINITY), (1.0, 0.7), (3.0, 2.0)]
            {
                let expected =
                    select_nearest(views.iter(), &here, metres_per_radian, 7, distance_max_m);
                let mut nearest = Nearest::new(7);
                tree.offer(
                    |index| &views[index],
                    &here,
                    metres_per_radian,
                    &mut nearest,
                );
                let mut got = Vec::new();
                nearest.within(distance_max_m, &mut got);
                assert_eq!(
                    got, expected,
                    "{count} views, round {round}, {metres_per_radian} m/rad"
                );
            }
        }
    }
}

#[test]
fn equally_near_viewpoints_are_taken_in_their_order() {
    let views = vec![pose([0.1, 0.0, 0.0], [0.0; 3]); 20];
    let got = select_nearest(
        views.iter(),
        &pose([0.0; 3], [0.0; 3]),
        1.0,
        7,
        f64::INFINITY,
    );
    assert_eq!(got, [0, 1, 2, 3, 4, 5, 6]);
}

struct Rows {
    expected: Vec<f32>,
    coverage: Vec<f32>,
    observed: Vec<f32>,
}

const WIDTH: usize = 100;

impl Rows {
    fn gain(&self) -> f32 {
        let rows = self.expected.chunks(WIDTH).zip(self.coverage.chunks(WIDTH));
        exposure_gain(
            rows.zip(self.observed.chunks(WIDTH))
                .map(|((expected, coverage), observed)| (expected, coverage, observed)),
        )
    }

    /// The median of the comparable ratios, clipped; 1 without any.
    fn sorted(&self) -> f64 {
        let mut ratios: Vec<f64> = (0..self.expected.len())
            .filter(|&i| self.coverage[i] > 0.0 && self.expected[i] > 20.0)
            .filter(|&i| self.observed[i] > 10.0 && self.observed[i] < 245.0)
            .map(|i| f64::from(self.observed[i]) / f64::from(self.expected[i]))
            .collect();
        if ratios.is_empty() {
            return 1.0;
        }
        ratios.sort_by(f64::total_cmp);
        ratios[ratios.len() / 2].clamp(0.7, 1.4)
    }
}

#[test]
fn the_exposure_gain_is_the_median_ratio_of_what_can_be_compared() {
    let mut random = Random(2);
    for gain in [0.3, 0.7, 0.85, 1.0, 1.02, 1.3, 1.4, 2.5] {
        let mut rows = Rows {
            expected: Vec::new(),
            coverage: Vec::new(),
            observed: Vec::new(),
        };
        for _ in 0..80 * WIDTH {
            let expected = random.uniform(0.0, 250.0);
            let mut observed = (gain * expected + 3.0 * random.normal()).clamp(0.0, 255.0);
            // Something new in a fifth of the image.
            if random.below(5) == 0 {
                observed = random.uniform(0.0, 255.0);
            }
            rows.expected.push(expected as f32);
            rows.coverage.push(random.below(4) as f32);
            rows.observed.push(observed.round() as f32);
        }
        let (got, expected) = (f64::from(rows.gain()), rows.sorted());
        // A bin is 0.00034 wide.
        assert!(
            (got - expected).abs() < 4e-4,
            "gain {gain}: {got} is not {expected}"
        );
        assert!((0.7..=1.4).contains(&got));
    }
}

#[test]
fn where_nothing_can_be_compared_the_gain_is_one() {
    for (expected, coverage, observed) in [
        (100.0, 0.0, 130.0),
        (15.0, 7.0, 130.0),
        (100.0, 7.0, 5.0),
        (240.0, 7.0, 250.0),
    ] {
        let rows = Rows {
            expected: vec![expected; WIDTH],
            coverage: vec![coverage; WIDTH],
            observed: vec![observed; WIDTH],
        };
        assert_eq!(rows.gain(), 1.0);
    }
}

#[test]
fn views_beyond_the_limit_are_left_out_but_for_the_nearest_three() {
    let at = |x: f64| pose([x, 0.0, 0.0], [0.0; 3]);
    let near: Vec<Pose> = [0.0, 0.05, 0.1, 0.15, 0.2, 0.3].map(at).into();
    assert_eq!(
        select_nearest(near.iter(), &at(0.0), 1.0, 7, 0.16),
        [0, 1, 2, 3]
    );
    let far: Vec<Pose> = [1.3, 1.0, 1.1, 1.2].map(at).into();
    assert_eq!(
        select_nearest(far.iter(), &at(0.0), 1.0, 7, 0.16),
        [1, 2, 3]
    );
}

#[test]
fn far_views_are_left_out_where_there_is_one_much_nearer() {
    let at = |x: f64| pose([x, 0.0, 0.0], [0.0; 3]);
    for (x, kept) in [(0.03, vec![0]), (0.04, vec![0, 1, 2])] {
        let views: Vec<Pose> = [x, 1.0, 1.1].map(at).into();
        assert_eq!(
            select_nearest(views.iter(), &at(0.0), 1.0, 7, 0.16),
            kept,
            "the nearest at {x} m"
        );
    }
}
