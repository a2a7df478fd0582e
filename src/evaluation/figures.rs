//! Figures: selectivity over frames as the paper's Figs. 10 and 13, surprise in the region as Fig. 9, and what is seen,
//! expected and surprising in single frames.

use std::path::{Path, PathBuf};

use plotters::{
    chart::{ChartBuilder, SeriesLabelPosition},
    coord::Shift,
    prelude::{
        BLACK, Color, DrawingArea, IntoDrawingArea, LineSeries, PathElement, RGBColor, SVGBackend,
        ShapeStyle, Text, WHITE,
    },
    style::IntoFont,
};

use super::{
    measure::{FrameRow, ObjectScore, Seen},
    method::Method,
};
use crate::{
    dataset::Recording,
    model::{
        belief::rgb_from_ycbcr,
        frame::RgbImage,
        report::{PixelBox, Region},
    },
    stages::interpolate::prior,
};

const SIZE: (u32, u32) = (960, 420);
/// Lines, darkest first: told apart also by those who do not tell red from green, and on grey paper.
const COLOURS: [RGBColor; 4] = [
    RGBColor(0, 61, 124),
    RGBColor(230, 120, 0),
    RGBColor(120, 120, 120),
    RGBColor(150, 60, 160),
];

#[derive(Debug, thiserror::Error)]
pub enum FigureError {
    #[error("cannot draw {path}: {problem}; is the folder writable?")]
    Draw { path: PathBuf, problem: String },
    #[error("cannot write {path}: {source}; is the folder writable?")]
    Write {
        path: PathBuf,
        source: image::ImageError,
    },
}

/// A value of each frame in which the object was scored.
type Curve<'a> = (String, Vec<(f64, f64)>);

/// `as.svg`, `pas.svg` (all methods, dB) and `surprise.svg` (the first method's maximum and mean inside).
///
/// # Errors
/// Files that cannot be written.
pub fn curves(folder: &Path, methods: &[(&str, &[FrameRow])]) -> Result<(), FigureError> {
    let Some((_, frames)) = methods.first() else {
        return Ok(());
    };
    if frames.iter().all(|row| row.object.is_none()) {
        return Ok(());
    }
    let of = |rows: &[FrameRow], value: fn(&ObjectScore) -> f64| -> Vec<(f64, f64)> {
        rows.iter()
            .enumerate()
            .filter_map(|(index, row)| Some((index as f64, value(row.object.as_ref()?))))
            .collect()
    };
    let each = |value: fn(&ObjectScore) -> f64| -> Vec<Curve> {
        methods
            .iter()
            .map(|(name, rows)| ((*name).to_owned(), of(rows, value)))
            .collect()
    };
    draw(
        folder.join("as.svg"),
        "AS in dB",
        frames,
        &each(|o| o.as_db),
    )?;
    draw(
        folder.join("pas.svg"),
        "PAS in dB",
        frames,
        &each(|o| o.pas_db),
    )?;
    let surprise = [
        ("maximum".to_owned(), of(frames, |o| o.max_inside)),
        ("mean".to_owned(), of(frames, |o| o.mean_inside)),
    ];
    draw(
        folder.join("surprise.svg"),
        "surprise inside, nats",
        frames,
        &surprise,
    )
}

fn draw(
    path: PathBuf,
    axis: &str,
    frames: &[FrameRow],
    curves: &[Curve],
) -> Result<(), FigureError> {
    let area = SVGBackend::new(&path, SIZE).into_drawing_area();
    plot(&area, axis, frames, curves).map_err(|error| FigureError::Draw {
        path: path.clone(),
        problem: error.to_string(),
    })
}

fn plot(
    area: &DrawingArea<SVGBackend, Shift>,
    axis: &str,
    frames: &[FrameRow],
    curves: &[Curve],
) -> Result<(), Box<dyn std::error::Error>> {
    area.fill(&WHITE)?;
    let values = || curves.iter().flat_map(|(_, points)| points).map(|p| p.1);
    let low = values().fold(0.0, f64::min).floor();
    let high = values().fold(1.0, f64::max).ceil() * 1.1;
    let mut chart = ChartBuilder::on(area)
        .margin(12)
        .x_label_area_size(40)
        .y_label_area_size(52)
        .build_cartesian_2d(0.0..frames.len() as f64, low..high)?;
    chart
        .configure_mesh()
        .disable_x_mesh()
        .light_line_style(WHITE)
        .x_desc("frame")
        .y_desc(axis)
        .draw()?;
    let thin = ShapeStyle::from(&BLACK.mix(0.35)).stroke_width(1);
    for passage in frames.chunk_by(|a, b| a.group == b.group) {
        let first = &passage[0];
        let at = frames
            .iter()
            .take_while(|row| row.group < first.group)
            .count() as f64;
        let label = format!("{} {}", first.moment.phase, first.moment.pass);
        chart.draw_series([PathElement::new(vec![(at, low), (at, high)], thin)])?;
        chart.draw_series([Text::new(
            label,
            (at + 1.0, high - 0.02 * (high - low)),
            ("sans-serif", 13).into_font(),
        )])?;
    }
    for ((name, points), colour) in curves.iter().zip(COLOURS) {
        let style = ShapeStyle::from(&colour).stroke_width(2);
        // A line would cross the frames in which nothing was scored.
        let mut first = true;
        for run in points.chunk_by(|a, b| b.0 - a.0 < 1.5) {
            let series = chart.draw_series(LineSeries::new(run.iter().copied(), style))?;
            if std::mem::take(&mut first) {
                series
                    .label(name)
                    .legend(move |(x, y)| PathElement::new(vec![(x, y), (x + 18, y)], style));
            }
        }
    }
    chart
        .configure_series_labels()
        .position(SeriesLabelPosition::LowerRight)
        .background_style(WHITE.mix(0.8))
        .draw()?;
    area.present()?;
    Ok(())
}

/// One frame of each phase, or of each pass where there are no phases: the middle one of its first pass.
pub fn sample_frames(recordings: &[Recording]) -> Vec<i64> {
    let mut sampled = Vec::new();
    for recording in recordings {
        let moments = &recording.truth.moments;
        if moments.is_empty() {
            sampled.extend(recording.entries.last().map(|entry| entry.stamp_ns()));
            continue;
        }
        let mut seen = Vec::new();
        let mut start = 0;
        for passage in moments.chunk_by(|a, b| (&a.phase, &a.pass) == (&b.phase, &b.pass)) {
            let phase = if passage[0].phase.is_empty() {
                &passage[0].pass
            } else {
                &passage[0].phase
            };
            if !seen.contains(&phase) {
                seen.push(phase);
                sampled.push(recording.entries[start + passage.len() / 2].stamp_ns());
            }
            start += passage.len();
        }
    }
    sampled
}

/// `<name>.png`: the image with the reported regions, what was expected, and the surprise; side by side.
///
/// # Errors
/// A file that cannot be written.
pub fn triptych(folder: &Path, name: &str, seen: &Seen) -> Result<(), FigureError> {
    let path = folder.join(format!("{name}.png"));
    let (width, height) = (seen.frame.intrinsics.width, seen.frame.intrinsics.height);
    let mut sheet = image::RgbImage::new(3 * width as u32, height as u32);
    let mut place = |panel: usize, pixels: &mut dyn FnMut(usize) -> [u8; 3]| {
        for pixel in 0..width * height {
            let x = (panel * width + pixel % width) as u32;
            sheet.put_pixel(x, (pixel / width) as u32, image::Rgb(pixels(pixel)));
        }
    };
    let boxes: Vec<PixelBox> = seen
        .verdict
        .regions
        .iter()
        .map(|region: &Region| region.pixel_box)
        .collect();
    place(0, &mut |pixel| {
        let (x, y) = ((pixel % width) as u32, (pixel / width) as u32);
        if boxes.iter().any(|outline| on_outline(outline, x, y)) {
            [255, 230, 0]
        } else {
            rgb_at(&seen.frame.image, pixel)
        }
    });
    place(1, &mut |pixel| expected_at(seen.method, pixel, width));
    // White is twice what is reported.
    let scale = 0.5 / seen.method.threshold();
    place(2, &mut |pixel| heat(seen.verdict.map[pixel] * scale));
    sheet
        .save(&path)
        .map_err(|source| FigureError::Write { path, source })
}

fn rgb_at(image: &RgbImage, pixel: usize) -> [u8; 3] {
    [0, 1, 2].map(|channel| image.data[3 * pixel + channel])
}

/// Grey where nothing is expected.
fn expected_at(method: &Method, pixel: usize, width: usize) -> [u8; 3] {
    let row = method.prior().row(pixel / width);
    let x = pixel % width;
    if row.plane(prior::COVERAGE)[x] > 0.0 {
        rgb_from_ycbcr(row.belief(x).tau)
    } else {
        [128; 3]
    }
}

fn on_outline(outline: &PixelBox, x: u32, y: u32) -> bool {
    let within = x >= outline.x_min && x < outline.x_max && y >= outline.y_min && y < outline.y_max;
    let at_edge = x == outline.x_min
        || x + 1 == outline.x_max
        || y == outline.y_min
        || y + 1 == outline.y_max;
    within && at_edge
}

/// Black, red, yellow, white for 0, 1/3, 2/3, 1.
fn heat(value: f32) -> [u8; 3] {
    [0.0, 1.0, 2.0].map(|third| ((3.0 * value - third).clamp(0.0, 1.0) * 255.0) as u8)
}
