//! Draws a contact sheet: `cargo run --release --example contact_sheet -- OUT.png [tabletop|objects|patrol]
//! [FRAME[,FRAME...]] [ROBOT]`. Frames are counted from 1, as in the paper; without any, telling ones are chosen.

use anyhow::Context;
use image::{RgbImage, imageops};
use surprised::simulation::script::{Script, Views};

const COLUMNS: usize = 4;
const GAP: u32 = 4;

fn main() -> anyhow::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let path = arguments.next().context("name the PNG to write")?;
    let name = arguments.next().unwrap_or_else(|| "tabletop".into());
    let (script, telling): (_, &[u64]) = match name.as_str() {
        "tabletop" => (
            Script::tabletop(1),
            // The way from Q1 to Q2, then a row for each of X1, X2 and X3: before, coming, acting, after.
            &[
                1, 85, 170, 465, 324, 332, 339, 345, 656, 666, 674, 680, 961, 971, 979, 983,
            ],
        ),
        "objects" => (
            Script::objects(1),
            // A row for what is brought, another for what is taken.
            &[
                343, 351, 356, 361, 619, 626, 632, 638, 738, 746, 751, 756, 994, 1002, 1007, 1012,
                1113, 1121, 1126, 1131, 1354, 1362, 1367, 1372,
            ],
        ),
        "patrol" => (
            Script::patrol(1),
            &[1, 375, 450, 540, 630, 700, 800, 900, 1000, 1100, 1200, 1300],
        ),
        other => anyhow::bail!("there is no script {other}: tabletop, objects or patrol"),
    };
    let chosen = arguments
        .next()
        .map(|list| {
            list.split(',')
                .map(str::parse)
                .collect::<Result<Vec<u64>, _>>()
        })
        .transpose()
        .context("frames are numbers with commas between")?;
    let robot: usize = arguments
        .next()
        .map_or(Ok(0), |number| number.parse())
        .context("the robot is a number")?;
    let script = script.with_robots(robot + 1);
    let frames = chosen.as_deref().unwrap_or(telling);
    let columns = COLUMNS.min(frames.len());
    let rows = frames.len().div_ceil(columns);
    let camera = &script.stations[robot].rig.intrinsics;
    let (width, height) = (camera.width as u32 + GAP, camera.height as u32 + GAP);
    let mut sheet = RgbImage::new(columns as u32 * width, rows as u32 * height);
    for (index, &frame) in frames.iter().enumerate() {
        let capture = script.capture(robot, frame.saturating_sub(1), Views::Middle);
        let image = &capture.middle.image;
        let image = RgbImage::from_raw(image.width as u32, image.height as u32, image.data.clone())
            .context("three bytes a pixel")?;
        let (x, y) = (
            (index % columns) as u32 * width,
            (index / columns) as u32 * height,
        );
        imageops::replace(&mut sheet, &image, i64::from(x), i64::from(y));
        println!(
            "frame {frame}: phase {} {}, present: {}",
            capture.moment.phase,
            capture.direction(),
            script.present(&capture.moment)
        );
    }
    sheet
        .save(&path)
        .with_context(|| format!("cannot write {path}"))?;
    Ok(())
}
