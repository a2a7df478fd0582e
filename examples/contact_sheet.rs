//! Draws a contact sheet: `cargo run --release --example contact_sheet -- OUT.png [tabletop|objects|patrol]
//! [FRAME[,FRAME...]] [ROBOT]`. Frames are counted from 1, as in the paper; without any, telling ones are chosen.
//!
//! A row says what comes or goes between its first frame and its last, and shows both places close up. What comes or goes
//! is outlined from the truth: green where it stands, red where it is yet to come, or was.

use anyhow::Context;
use image::{Rgb, RgbImage, imageops};
use surprised::simulation::script::{Capture, Script, Views};

const COLUMNS: usize = 4;
const GAP: u32 = 4;
/// Height of a line of text, pixels; and of its letters, in dots and in pixels a dot.
const LINE: u32 = 18;
const TITLE_DOT: u32 = 2;
const CAPTION_DOT: u32 = 1;
/// Close up: half the side of the cut, pixels, and how many times as large it is shown.
const CUT: [u32; 2] = [40, 29];
const ZOOM: u32 = 2;
const INK: Rgb<u8> = Rgb([240, 236, 224]);
const STANDS: Rgb<u8> = Rgb([40, 255, 60]);
const ABSENT: Rgb<u8> = Rgb([255, 40, 40]);

fn main() -> anyhow::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let path = arguments.next().context("name the PNG to write")?;
    let name = arguments.next().unwrap_or_else(|| "tabletop".into());
    let (script, telling): (_, &[u64]) = match name.as_str() {
        "tabletop" => (
            Script::tabletop(1),
            // The way from Q1 to Q2, then a row for each of X1, X2 and X3: before, coming, acting, after.
            &[
                1, 57, 113, 170, 324, 332, 339, 356, 656, 666, 674, 684, 961, 971, 979, 983,
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
    let camera = &script.stations[robot].rig.intrinsics;
    let (width, height) = (camera.width as u32, camera.height as u32);
    let row_height = LINE + height + LINE;
    let close_up = columns as u32 * (width + GAP);
    let mut sheet = RgbImage::new(
        close_up + 2 * CUT[0] * ZOOM,
        frames.len().div_ceil(columns) as u32 * row_height,
    );
    let mut events = 0;
    for (row, frames) in (0..).zip(frames.chunks(columns)) {
        let captures: Vec<Capture> = frames
            .iter()
            .map(|&frame| script.capture(robot, frame.saturating_sub(1), Views::Middle))
            .collect();
        let changed = changed(&script, &captures);
        let top = row * row_height;
        let title = if changed.is_empty() {
            "NOTHING COMES OR GOES: THE ROBOT DRIVES".into()
        } else {
            events += 1;
            let changes: Vec<_> = changed
                .iter()
                .map(|&(item, comes)| {
                    let change = if comes { "BROUGHT" } else { "TAKEN AWAY" };
                    format!("THE {} IS {change}", script.story.items[item].name)
                })
                .collect();
            format!("X{events}  {}", changes.join(", "))
        };
        write(&mut sheet, (0, top), TITLE_DOT, &title);
        for (column, (capture, &frame)) in (0..).zip(captures.iter().zip(frames)) {
            let image = &capture.middle.image;
            let mut image = RgbImage::from_raw(width, height, image.data.clone())
                .context("three bytes a pixel")?;
            let mut place = changed
                .iter()
                .filter_map(|&(item, _)| extent(&capture.middle.masks[item], width));
            // The first and the last, without outlines.
            let half = match column as usize {
                0 => Some((0, "BEFORE")),
                last if last + 1 == columns => Some((1, "AFTER")),
                _ => None,
            };
            let close = close_up + 2 * GAP;
            if let Some(((half, name), middle)) = half.zip(place.next_back()) {
                let cut = cut(&image, middle);
                let down = top + LINE + half * (height / 2 + GAP);
                imageops::replace(&mut sheet, &cut, i64::from(close), i64::from(down));
                let under = RgbImage::new(name.len() as u32 * 6 * TITLE_DOT + GAP, LINE);
                imageops::replace(&mut sheet, &under, i64::from(close), i64::from(down));
                write(&mut sheet, (close + GAP, down), TITLE_DOT, name);
            }
            for &(item, _) in &changed {
                let ink = if capture.moment.standing.contains(&item) {
                    STANDS
                } else {
                    ABSENT
                };
                outline(&mut image, &capture.middle.masks[item], ink);
            }
            let left = column * (width + GAP);
            imageops::replace(&mut sheet, &image, i64::from(left), i64::from(top + LINE));
            let present = script.present(&capture.moment);
            let caption = format!("FRAME {frame}  PHASE {}  {present}", capture.moment.phase);
            let below = (left, top + LINE + height);
            write(&mut sheet, below, CAPTION_DOT, &caption);
            println!(
                "frame {frame}: phase {} {}, present: {present}",
                capture.moment.phase,
                capture.direction(),
            );
        }
    }
    sheet
        .save(&path)
        .with_context(|| format!("cannot write {path}"))?;
    Ok(())
}

/// Items that stand at the last of these but not at the first (`true`), or the other way round.
fn changed(script: &Script, captures: &[Capture]) -> Vec<(usize, bool)> {
    let (Some(first), Some(last)) = (captures.first(), captures.last()) else {
        return Vec::new();
    };
    (0..script.story.items.len())
        .filter_map(|item| {
            let stands = |capture: &Capture| capture.moment.standing.contains(&item);
            (stands(first) != stands(last)).then(|| (item, stands(last)))
        })
        .collect()
}

/// The middle of what a mask covers, column and row.
fn extent(mask: &[u8], width: u32) -> Option<[u32; 2]> {
    let covered = || (0..).zip(mask).filter(|(_, value)| **value != 0);
    let middle = |place: fn(u32, u32) -> u32| {
        let least = covered().map(|(at, _)| place(at, width)).min()?;
        let greatest = covered().map(|(at, _)| place(at, width)).max()?;
        Some((least + greatest) / 2)
    };
    Some([
        middle(|at, width| at % width)?,
        middle(|at, width| at / width)?,
    ])
}

/// Around a place, larger.
fn cut(image: &RgbImage, middle: [u32; 2]) -> RgbImage {
    let from = |axis: usize, size: u32| {
        middle[axis]
            .saturating_sub(CUT[axis])
            .min(size - 2 * CUT[axis])
    };
    let (left, top) = (from(0, image.width()), from(1, image.height()));
    let part = imageops::crop_imm(image, left, top, 2 * CUT[0], 2 * CUT[1]).to_image();
    imageops::resize(
        &part,
        2 * CUT[0] * ZOOM,
        2 * CUT[1] * ZOOM,
        imageops::FilterType::CatmullRom,
    )
}

/// Draws the pixels just outside of a mask.
fn outline(image: &mut RgbImage, mask: &[u8], ink: Rgb<u8>) {
    let (width, height) = image.dimensions();
    let covered = |x: u32, y: u32| x < width && y < height && mask[(y * width + x) as usize] != 0;
    for y in 0..height {
        for x in 0..width {
            let beside = [
                (x.wrapping_sub(1), y),
                (x + 1, y),
                (x, y.wrapping_sub(1)),
                (x, y + 1),
            ];
            if !covered(x, y) && beside.into_iter().any(|(x, y)| covered(x, y)) {
                image.put_pixel(x, y, ink);
            }
        }
    }
}

/// Writes one line, `dot` pixels to a dot of its letters, below and right of a place.
fn write(sheet: &mut RgbImage, (left, top): (u32, u32), dot: u32, text: &str) {
    let top = top + (LINE - 7 * dot) / 2;
    for (index, character) in (0..).zip(text.to_ascii_uppercase().bytes()) {
        for (row, bits) in (0..).zip(glyph(character)) {
            for column in (0..5).filter(|column| bits >> (4 - column) & 1 == 1) {
                let (x, y) = (left + (index * 6 + column) * dot, top + row * dot);
                for (x, y) in (x..x + dot).flat_map(|x| (y..y + dot).map(move |y| (x, y))) {
                    if x < sheet.width() && y < sheet.height() {
                        sheet.put_pixel(x, y, INK);
                    }
                }
            }
        }
    }
}

/// Five by seven dots, most significant of five bits on the left.
fn glyph(character: u8) -> [u8; 7] {
    match character {
        b'A' => [0x0e, 0x11, 0x11, 0x1f, 0x11, 0x11, 0x11],
        b'B' => [0x1e, 0x11, 0x11, 0x1e, 0x11, 0x11, 0x1e],
        b'C' => [0x0e, 0x11, 0x10, 0x10, 0x10, 0x11, 0x0e],
        b'D' => [0x1e, 0x11, 0x11, 0x11, 0x11, 0x11, 0x1e],
        b'E' => [0x1f, 0x10, 0x10, 0x1e, 0x10, 0x10, 0x1f],
        b'F' => [0x1f, 0x10, 0x10, 0x1e, 0x10, 0x10, 0x10],
        b'G' => [0x0e, 0x11, 0x10, 0x17, 0x11, 0x11, 0x0f],
        b'H' => [0x11, 0x11, 0x11, 0x1f, 0x11, 0x11, 0x11],
        b'I' => [0x0e, 0x04, 0x04, 0x04, 0x04, 0x04, 0x0e],
        b'J' => [0x01, 0x01, 0x01, 0x01, 0x11, 0x11, 0x0e],
        b'K' => [0x11, 0x12, 0x14, 0x18, 0x14, 0x12, 0x11],
        b'L' => [0x10, 0x10, 0x10, 0x10, 0x10, 0x10, 0x1f],
        b'M' => [0x11, 0x1b, 0x15, 0x15, 0x11, 0x11, 0x11],
        b'N' => [0x11, 0x19, 0x15, 0x13, 0x11, 0x11, 0x11],
        b'O' => [0x0e, 0x11, 0x11, 0x11, 0x11, 0x11, 0x0e],
        b'P' => [0x1e, 0x11, 0x11, 0x1e, 0x10, 0x10, 0x10],
        b'Q' => [0x0e, 0x11, 0x11, 0x11, 0x15, 0x12, 0x0d],
        b'R' => [0x1e, 0x11, 0x11, 0x1e, 0x14, 0x12, 0x11],
        b'S' => [0x0f, 0x10, 0x10, 0x0e, 0x01, 0x01, 0x1e],
        b'T' => [0x1f, 0x04, 0x04, 0x04, 0x04, 0x04, 0x04],
        b'U' => [0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x0e],
        b'V' => [0x11, 0x11, 0x11, 0x11, 0x11, 0x0a, 0x04],
        b'W' => [0x11, 0x11, 0x11, 0x15, 0x15, 0x1b, 0x11],
        b'X' => [0x11, 0x11, 0x0a, 0x04, 0x0a, 0x11, 0x11],
        b'Y' => [0x11, 0x11, 0x0a, 0x04, 0x04, 0x04, 0x04],
        b'Z' => [0x1f, 0x01, 0x02, 0x04, 0x08, 0x10, 0x1f],
        b'0' => [0x0e, 0x11, 0x13, 0x15, 0x19, 0x11, 0x0e],
        b'1' => [0x04, 0x0c, 0x04, 0x04, 0x04, 0x04, 0x0e],
        b'2' => [0x0e, 0x11, 0x01, 0x02, 0x04, 0x08, 0x1f],
        b'3' => [0x1f, 0x02, 0x04, 0x02, 0x01, 0x11, 0x0e],
        b'4' => [0x02, 0x06, 0x0a, 0x12, 0x1f, 0x02, 0x02],
        b'5' => [0x1f, 0x10, 0x1e, 0x01, 0x01, 0x11, 0x0e],
        b'6' => [0x06, 0x08, 0x10, 0x1e, 0x11, 0x11, 0x0e],
        b'7' => [0x1f, 0x01, 0x02, 0x04, 0x08, 0x08, 0x08],
        b'8' => [0x0e, 0x11, 0x11, 0x0e, 0x11, 0x11, 0x0e],
        b'9' => [0x0e, 0x11, 0x11, 0x0f, 0x01, 0x02, 0x0c],
        b':' => [0x00, 0x04, 0x04, 0x00, 0x04, 0x04, 0x00],
        b'+' => [0x00, 0x04, 0x04, 0x1f, 0x04, 0x04, 0x00],
        b',' => [0x00, 0x00, 0x00, 0x00, 0x04, 0x04, 0x08],
        _ => [0; 7],
    }
}
