//! Areas of a frame that no viewpoint knows.

use nalgebra::{Point3, Vector3};

use crate::{
    model::report::PixelBox,
    stages::{
        attend::Scene,
        interpolate::prior::{COVERAGE, Prior},
    },
};

/// Share of a frame from which an unseen area is worth telling: beside a thing that was moved a little is unseen too.
pub const UNSEEN_SHARE: f32 = 0.05;
/// From which it belongs to an area that is followed already.
pub const UNSEEN_KEPT: f32 = 0.01;
/// Side of the cells that are joined, pixels.
const CELL: usize = 8;
/// Points kept of one area.
const POINTS_MAX: usize = 48;

/// Connected cells, most of whose pixels have depth and no coverage.
#[derive(Debug, Clone)]
pub struct UnseenArea {
    pub pixel_box: PixelBox,
    /// Of the frame's pixels.
    pub share: f32,
    /// Centre and half sizes of the axis-parallel box around it in the world, metres.
    pub bounds: (Point3<f64>, Vector3<f64>),
    /// Spread over it, in the world.
    pub points: Vec<Point3<f64>>,
}

/// The areas of at least [`UNSEEN_KEPT`] of the frame, at most 1 / [`UNSEEN_KEPT`].
pub fn areas(prior: &Prior, scene: &Scene) -> Vec<UnseenArea> {
    let (columns, rows) = (prior.width / CELL, prior.height / CELL);
    let mut unseen: Vec<bool> = (0..rows * columns)
        .map(|cell| is_unseen(prior, scene, cell % columns, cell / columns))
        .collect();
    let least = UNSEEN_KEPT * (prior.width * prior.height) as f32 / (CELL * CELL) as f32;
    let mut areas = Vec::new();
    for seed in 0..unseen.len() {
        let cells = connected(&mut unseen, columns, seed);
        if cells.is_empty() || (cells.len() as f32) < least {
            continue;
        }
        areas.extend(area(&cells, columns, scene));
    }
    areas
}

fn is_unseen(prior: &Prior, scene: &Scene, column: usize, row: usize) -> bool {
    let count: usize = (row * CELL..(row + 1) * CELL)
        .map(|y| {
            let coverage = &prior.row(y).plane(COVERAGE)[column * CELL..][..CELL];
            let depth_m = &scene.depth_m[y * prior.width + column * CELL..][..CELL];
            let pixels = coverage.iter().zip(depth_m);
            pixels
                .filter(|&(&views, &z)| views == 0.0 && z > 0.0)
                .count()
        })
        .sum();
    2 * count > CELL * CELL
}

/// The cells that hang together with `seed`; they are taken out of `unseen`.
fn connected(unseen: &mut [bool], columns: usize, seed: usize) -> Vec<usize> {
    if !std::mem::take(&mut unseen[seed]) {
        return Vec::new();
    }
    let mut cells = vec![seed];
    let mut next = 0;
    while let Some(&cell) = cells.get(next) {
        next += 1;
        let column = cell % columns;
        let neighbours = [
            (column > 0).then(|| cell - 1),
            (column + 1 < columns).then(|| cell + 1),
            cell.checked_sub(columns),
            Some(cell + columns).filter(|&below| below < unseen.len()),
        ];
        for neighbour in neighbours.into_iter().flatten() {
            if std::mem::take(&mut unseen[neighbour]) {
                cells.push(neighbour);
            }
        }
    }
    cells
}

/// `None` where no cell's middle has depth.
fn area(cells: &[usize], columns: usize, scene: &Scene) -> Option<UnseenArea> {
    let (mut x_min, mut y_min, mut x_max, mut y_max) = (u32::MAX, u32::MAX, 0, 0);
    let mut points = Vec::new();
    for &cell in cells {
        let (x, y) = (cell % columns * CELL, cell / columns * CELL);
        (x_min, y_min) = (x_min.min(x as u32), y_min.min(y as u32));
        (x_max, y_max) = (x_max.max((x + CELL) as u32), y_max.max((y + CELL) as u32));
        let (x, y) = (x + CELL / 2, y + CELL / 2);
        let z = scene.depth_m[y * scene.intrinsics.width + x];
        if z > 0.0 {
            let in_camera = scene.intrinsics.unproject(x as f64, y as f64, z.into());
            points.push(scene.world_from_camera * in_camera);
        }
    }
    let first = points.first()?.coords;
    let low = points
        .iter()
        .fold(first, |low, point| low.inf(&point.coords));
    let high = points
        .iter()
        .fold(first, |high, point| high.sup(&point.coords));
    // Cells lie in rows: every so many of them are spread over the area.
    let stride = points.len().div_ceil(POINTS_MAX);
    let points: Vec<_> = points.into_iter().step_by(stride).collect();
    Some(UnseenArea {
        pixel_box: PixelBox {
            x_min,
            y_min,
            x_max,
            y_max,
        },
        share: (cells.len() * CELL * CELL) as f32 / scene.intrinsics.pixels() as f32,
        bounds: (Point3::from((low + high) / 2.0), (high - low) / 2.0),
        points,
    })
}
