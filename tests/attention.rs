//! What surprises becomes evidence and regions with the right boxes, places and ids, and noise does not.

mod reference;

use reference::{
    Random,
    scene::{camera, pose},
};
use surprised::{
    config::{Evidence, Settings},
    model::{
        camera::Intrinsics,
        pose::Pose,
        report::{PixelBox, Region},
    },
    stages::attend::{BlockMap, Follower, Scene, regions},
};

const SIZE: (usize, usize) = (120, 88);

fn rectangle(map: &mut [f32], x: std::ops::Range<usize>, y: std::ops::Range<usize>, value: f32) {
    for y in y {
        map[y * SIZE.0..][x.clone()].fill(value);
    }
}

struct Frame {
    depth_m: Vec<f32>,
    intrinsics: Intrinsics,
    world_from_camera: Pose,
}

fn frame() -> Frame {
    Frame {
        depth_m: vec![1.5; SIZE.0 * SIZE.1],
        intrinsics: camera(SIZE.0, SIZE.1),
        world_from_camera: pose([0.3, -1.0, 0.2], [0.4, -0.7, 0.1]),
    }
}

fn found(map: &[f32], frame: &Frame, settings: &Settings) -> Vec<Region> {
    let evidence = BlockMap::evidence(map, SIZE.0, settings.evidence);
    let scene = Scene {
        depth_m: &frame.depth_m,
        intrinsics: &frame.intrinsics,
        world_from_camera: &frame.world_from_camera,
    };
    regions(map, &evidence, &scene, settings)
}

#[test]
fn evidence_is_the_median_over_three_by_three_of_the_means_of_blocks() {
    let mut random = Random(1);
    for (width, height) in [(120, 88), (17, 19), (4, 4), (12, 5), (3, 9)] {
        let map: Vec<f32> = (0..width * height)
            .map(|_| random.uniform(0.0, 30.0) as f32)
            .collect();
        let (columns, rows) = (width / 4, height / 4);
        let mean = |column: usize, row: usize| -> f64 {
            (0..16)
                .map(|i| f64::from(map[(4 * row + i / 4) * width + 4 * column + i % 4]))
                .sum::<f64>()
                / 16.0
        };
        let blocks = BlockMap::evidence(&map, width, Evidence::Blocks);
        let medians = BlockMap::evidence(&map, width, Evidence::BlockMedian);
        assert_eq!((blocks.width, blocks.height), (columns, rows));
        assert_eq!((medians.width, medians.height), (columns, rows));
        for row in 0..rows {
            for column in 0..columns {
                let mut around = Vec::new();
                for y in -1..=1 {
                    for x in -1..=1 {
                        let column = (column as i64 + x).clamp(0, columns as i64 - 1);
                        let row = (row as i64 + y).clamp(0, rows as i64 - 1);
                        around.push(mean(column as usize, row as usize));
                    }
                }
                around.sort_by(f64::total_cmp);
                let at = row * columns + column;
                assert!((f64::from(blocks.data[at]) - mean(column, row)).abs() < 1e-4);
                assert!((f64::from(medians.data[at]) - around[4]).abs() < 1e-4);
            }
        }
    }
}

#[test]
fn a_single_block_is_noise_for_the_median_but_not_for_the_plain_blocks() {
    let mut map = vec![0.0; SIZE.0 * SIZE.1];
    rectangle(&mut map, 40..44, 40..44, 100.0);
    let plain = BlockMap::evidence(&map, SIZE.0, Evidence::Blocks);
    let median = BlockMap::evidence(&map, SIZE.0, Evidence::BlockMedian);
    assert_eq!(plain.data.iter().copied().fold(0.0, f32::max), 100.0);
    assert_eq!(median.data.iter().copied().fold(0.0, f32::max), 0.0);
}

#[test]
fn two_blobs_give_two_regions_with_their_boxes() {
    let mut map = vec![0.5; SIZE.0 * SIZE.1];
    rectangle(&mut map, 24..48, 20..40, 20.0);
    rectangle(&mut map, 64..92, 36..68, 12.0);
    map[30 * SIZE.0 + 33] = 25.0;
    for evidence in [Evidence::Blocks, Evidence::BlockMedian] {
        let settings = Settings {
            evidence,
            ..Settings::robust()
        };
        let regions = found(&map, &frame(), &settings);
        assert_eq!(regions.len(), 2, "{regions:?}");
        // The filter's four taps reach two pixels back and one ahead, and two of them suffice.
        let expected = [(24, 20, 49, 41), (64, 36, 93, 69)];
        for (region, (x_min, y_min, x_max, y_max)) in regions.iter().zip(expected) {
            let pixel_box = PixelBox {
                x_min,
                y_min,
                x_max,
                y_max,
            };
            assert_eq!(region.pixel_box, pixel_box);
            assert!(!region.touches_border);
            let area = f64::from(region.area) / pixel_box.area() as f64;
            assert!((0.98..=1.0).contains(&area), "{area}");
        }
        assert_eq!((regions[0].peak_x, regions[0].peak_y), (33, 30));
        assert!((regions[0].peak_surprise - 20.0).abs() < 0.5);
        assert_eq!(regions[1].peak_surprise, 12.0);
        assert!(regions[0].mean_surprise > 18.0 && regions[0].mean_surprise < 20.0);
    }
}

#[test]
fn nothing_above_the_threshold_and_nothing_along_the_border_is_a_region() {
    let settings = Settings::robust();
    let mut map = vec![0.5; SIZE.0 * SIZE.1];
    assert!(found(&map, &frame(), &settings).is_empty());
    rectangle(&mut map, 30..60, 30..60, 5.9);
    assert!(found(&map, &frame(), &settings).is_empty());
    for (x, y) in [
        (0..16, 0..88),
        (104..120, 0..88),
        (0..120, 0..16),
        (0..120, 72..88),
    ] {
        let mut map = map.clone();
        rectangle(&mut map, x, y, 50.0);
        assert!(found(&map, &frame(), &settings).is_empty());
    }
    rectangle(&mut map, 0..40, 30..60, 50.0);
    let regions = found(&map, &frame(), &settings);
    assert_eq!(regions.len(), 1);
    assert!(regions[0].touches_border);
}

#[test]
fn no_more_regions_are_reported_than_asked_for() {
    let mut map = vec![0.0; SIZE.0 * SIZE.1];
    for x in 0..4 {
        rectangle(&mut map, 20 + 20 * x..32 + 20 * x, 30..44, 10.0 + x as f32);
    }
    let settings = Settings {
        regions_max: 3,
        ..Settings::robust()
    };
    let regions = found(&map, &frame(), &settings);
    let peaks: Vec<f32> = regions.iter().map(|region| region.peak_surprise).collect();
    assert_eq!(peaks, [13.0, 12.0, 11.0], "the most surprising first");
}

#[test]
fn a_region_lies_in_the_world_where_its_pixels_are_seen() {
    let mut frame = frame();
    let mut map = vec![0.0; SIZE.0 * SIZE.1];
    rectangle(&mut map, 60..80, 24..44, 30.0);
    // Another depth in a part, and a hole: the median stands.
    rectangle(&mut frame.depth_m, 60..67, 24..44, 0.9);
    rectangle(&mut frame.depth_m, 70..74, 24..44, 0.0);
    let regions = found(&map, &frame, &Settings::robust());
    let got = regions[0].center_in_world.expect("it has depth");
    let in_camera = frame.intrinsics.unproject(70.0, 34.0, 1.5);
    let expected = frame.world_from_camera * in_camera;
    assert!((got - expected).norm() < 0.01, "{got} is not {expected}");

    frame.depth_m.fill(0.0);
    let regions = found(&map, &frame, &Settings::robust());
    assert_eq!(regions[0].center_in_world, None);
}

fn region_at(x_m: f64) -> Region {
    Region {
        id: 0,
        pixel_box: PixelBox {
            x_min: 10,
            y_min: 10,
            x_max: 30,
            y_max: 30,
        },
        peak_x: 20,
        peak_y: 20,
        peak_surprise: 20.0,
        mean_surprise: 10.0,
        area: 400,
        center_in_world: Some(nalgebra::Point3::new(x_m, 0.0, 1.0)),
        touches_border: false,
        event_id: 0,
    }
}

fn follow(follower: &mut Follower, next_id: &mut u64, places_m: &[f64]) -> Vec<u64> {
    let mut regions: Vec<Region> = places_m.iter().map(|x| region_at(*x)).collect();
    follower.follow(&mut regions, next_id);
    regions.iter().map(|region| region.id).collect()
}

#[test]
fn an_id_stays_while_its_region_is_followed_and_is_new_after_a_long_absence() {
    let mut follower = Follower::default();
    let mut next_id = 0;
    assert_eq!(follow(&mut follower, &mut next_id, &[0.0, 1.0]), [1, 2]);
    // They move, and their order changes.
    for step in 1..20 {
        let moved = 0.04 * f64::from(step);
        let ids = follow(&mut follower, &mut next_id, &[1.0 + moved, moved]);
        assert_eq!(ids, [2, 1]);
    }
    // A third between them is another.
    assert_eq!(
        follow(&mut follower, &mut next_id, &[1.3, 0.76, 1.76]),
        [3, 1, 2]
    );
    // A short absence is bridged.
    for _ in 0..7 {
        assert_eq!(follow(&mut follower, &mut next_id, &[1.3]), [3]);
    }
    assert_eq!(follow(&mut follower, &mut next_id, &[0.76, 1.3]), [1, 3]);
    // A long one is not.
    for _ in 0..8 {
        follow(&mut follower, &mut next_id, &[]);
    }
    assert_eq!(follow(&mut follower, &mut next_id, &[0.76]), [4]);
}

#[test]
fn without_depth_a_region_is_followed_by_its_box() {
    let mut follower = Follower::default();
    let mut next_id = 0;
    let flat = |x_min: u32| Region {
        center_in_world: None,
        pixel_box: PixelBox {
            x_min,
            y_min: 10,
            x_max: x_min + 20,
            y_max: 30,
        },
        ..region_at(0.0)
    };
    let mut regions = vec![flat(10)];
    follower.follow(&mut regions, &mut next_id);
    let mut regions = vec![flat(60), flat(14)];
    follower.follow(&mut regions, &mut next_id);
    assert_eq!([regions[0].id, regions[1].id], [2, 1]);
}
