//! AS and PAS of maps whose values are known by hand.

use surprised::{
    evaluation::selectivity::{Sides, mask_box, score_ratio_db},
    model::report::PixelBox,
    stages::attend::BlockMap,
};

/// 8x6 blocks of 1 nat: an image of 32x24 pixels.
const WIDTH: usize = 32;
const HEIGHT: usize = 24;

fn map_with(values: &[(usize, usize, f32)]) -> BlockMap {
    let mut map = BlockMap {
        width: 8,
        height: 6,
        data: vec![1.0; 48],
    };
    for &(x, y, value) in values {
        map.data[y * 8 + x] = value;
    }
    map
}

/// Inside where `x` and `y` are in the ranges, pixels.
fn mask(x: std::ops::Range<usize>, y: std::ops::Range<usize>) -> Vec<bool> {
    (0..WIDTH * HEIGHT)
        .map(|pixel| x.contains(&(pixel % WIDTH)) && y.contains(&(pixel / WIDTH)))
        .collect()
}

#[test]
fn as_is_mean_inside_and_pas_maximum_inside_over_maximum_outside() {
    // Two blocks inside with 20 and 40; the largest outside has 3.
    let blocks = map_with(&[(2, 2, 20.0), (3, 2, 40.0), (6, 4, 3.0)]);
    let sides = Sides::new(&blocks, &mask(8..16, 8..12), &mask(0..0, 0..0), WIDTH, 0);
    assert_eq!(sides.inside, [20.0, 40.0]);
    assert!((sides.selectivity_db() - 10.0).abs() < 1e-9);
    assert!((sides.peak_selectivity_db() - 10.0 * (40.0f64 / 3.0).log10()).abs() < 1e-9);
}

#[test]
fn a_block_is_inside_from_half_covered_on_and_its_neighbours_count_nowhere() {
    // Columns 8..10 of block 2: half of it. Block 1 beside it would be the largest outside.
    let blocks = map_with(&[(1, 2, 50.0), (2, 2, 8.0)]);
    let half = Sides::new(&blocks, &mask(8..10, 8..12), &mask(0..0, 0..0), WIDTH, 0);
    assert_eq!(half.inside, [8.0]);
    assert_eq!(half.max_outside(), 1.0);
    assert_eq!(half.outside.len(), 48 - 9, "a ring of one block around it");
    // One column: less than half, so nothing is inside, but it still is no outside.
    let less = Sides::new(&blocks, &mask(8..9, 8..12), &mask(0..0, 0..0), WIDTH, 0);
    assert!(less.inside.is_empty());
    assert_eq!(less.max_outside(), 1.0);
}

#[test]
fn the_border_strip_is_left_out() {
    let blocks = map_with(&[(0, 3, 70.0), (7, 3, 70.0), (3, 0, 70.0), (3, 5, 70.0)]);
    let sides = Sides::new(&blocks, &mask(0..0, 0..0), &mask(0..0, 0..0), WIDTH, 4);
    assert_eq!(sides.outside, vec![1.0; 6 * 4]);
}

#[test]
fn what_is_ignored_is_not_outside_but_may_be_inside() {
    let blocks = map_with(&[(2, 2, 20.0), (5, 2, 90.0), (6, 3, 80.0), (7, 5, 3.0)]);
    let (object, shade) = (mask(8..12, 8..12), mask(8..24, 8..12));
    let sides = Sides::new(&blocks, &object, &shade, WIDTH, 0);
    assert_eq!(sides.inside, [20.0]);
    assert_eq!(sides.max_outside(), 3.0);
    assert_eq!(sides.outside.len(), 48 - 6 * 3, "a ring around both");
}

#[test]
fn a_region_that_nobody_saw_has_a_finite_selectivity() {
    assert!(score_ratio_db(0.0, 5.0) < -60.0);
    assert!(score_ratio_db(0.0, 5.0).is_finite());
    assert!(score_ratio_db(5.0, 0.0).is_finite());
}

#[test]
fn the_box_of_a_mask_is_half_open() {
    let found = mask_box(&mask(5..9, 7..8), WIDTH);
    let expected = PixelBox {
        x_min: 5,
        y_min: 7,
        x_max: 9,
        y_max: 8,
    };
    assert_eq!(found, Some(expected));
    assert_eq!(mask_box(&mask(0..0, 0..0), WIDTH), None);
}
