//! Every fifth frame is left out of what is learnt, and compared with what is expected there.

use std::{fmt::Write as _, fs, path::Path, sync::Arc};

use surprised::{
    config::Settings,
    dataset::{self, Recording},
    engine::{EngineKind, Engines},
    evaluation::held_out::{self, HeldOut},
    isa::Isa,
};
use tempfile::TempDir;

const SIZE: (u32, u32) = (96, 72);
const FOCAL: f64 = 90.0;

/// A fronto-parallel picture a metre ahead of a camera that moves right by `step_m` a frame.
fn recording(
    folder: &Path,
    frames: u32,
    step_m: f64,
    grey: impl Fn(u32, f64, f64) -> u8,
) -> Recording {
    for name in ["rgb", "depth"] {
        fs::create_dir_all(folder.join(name)).expect("a folder");
    }
    let (mut rgb, mut depth) = (String::new(), String::new());
    let (mut poses, mut passes) = (String::new(), String::new());
    for frame in 0..frames {
        let x_m = step_m * f64::from(frame);
        let image = image::RgbImage::from_fn(SIZE.0, SIZE.1, |u, v| {
            let (x, y) = (f64::from(u) / FOCAL + x_m, f64::from(v) / FOCAL);
            image::Rgb([grey(frame, x, y); 3])
        });
        image
            .save(folder.join(format!("rgb/{frame}.png")))
            .expect("written");
        let plane = image::ImageBuffer::<image::Luma<u16>, Vec<u16>>::from_pixel(
            SIZE.0,
            SIZE.1,
            image::Luma([5000]),
        );
        plane
            .save(folder.join(format!("depth/{frame}.png")))
            .expect("written");
        let stamp = format!("{}.0", 100 + frame);
        let _ = writeln!(rgb, "{stamp} rgb/{frame}.png");
        let _ = writeln!(depth, "{stamp} depth/{frame}.png");
        let _ = writeln!(poses, "{stamp} {x_m} 0 0 0 0 0 1");
        let pass = if frame < frames - 5 { "learn" } else { "back" };
        let _ = writeln!(passes, "{stamp},{pass}");
    }
    let calibration = format!("{FOCAL} {FOCAL} 0 0\n");
    for (name, text) in [
        ("rgb.txt", rgb),
        ("depth.txt", depth),
        ("groundtruth.txt", poses),
        ("passes.csv", passes),
        ("calibration.txt", calibration),
    ] {
        fs::write(folder.join(name), text).expect("written");
    }
    dataset::open(folder)
        .expect("the recording can be read")
        .remove(0)
}

fn evaluated(step_m: f64, grey: impl Fn(u32, f64, f64) -> u8) -> HeldOut {
    let folder = TempDir::new().expect("a folder");
    let recording = recording(folder.path(), 25, step_m, grey);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build();
    let pool = Arc::new(pool.expect("threads start"));
    let engines = Engines::new(EngineKind::Cpu, pool, Isa::detect()).expect("there is a processor");
    let found = held_out::evaluate(&recording, &Settings::robust(), &engines);
    let found = found.expect("every frame can be used");
    assert_eq!(
        (found.learnt, found.left_out),
        (16, 4),
        "only the first pass is played"
    );
    found
}

#[test]
fn likeness_is_that_of_the_frames_that_were_left_out() {
    // The left out are brighter by ten: whoever learnt one of them would know.
    let found = evaluated(0.0, |frame, _, _| if frame % 5 == 4 { 110 } else { 100 });
    for of in &found.predictions {
        for likeness in [of.own, of.common] {
            assert!((likeness.error_grey - 10.0).abs() < 0.1, "{of:?}");
            let psnr_db = 20.0 * (255.0f64 / 10.0).log10();
            assert!((likeness.psnr_db - psnr_db).abs() < 0.1, "{of:?}");
        }
        assert!(of.coverage > 0.95, "{of:?}");
        assert!(
            (of.gain - 1.1).abs() < 0.005 && of.with_gain.error_grey < 0.5,
            "{of:?}"
        );
    }
}

#[test]
fn what_is_expected_beside_a_surface_is_warped_into_place() {
    let wave = |_, x: f64, y: f64| (128.0 + 50.0 * (25.0 * x).sin() * (20.0 * y).cos()) as u8;
    let found = evaluated(0.03, wave);
    let [prior, refined, warped, copied] = found.predictions;
    assert_eq!(copied.coverage, 1.0);
    assert!(
        prior.coverage >= warped.coverage && warped.coverage > 0.9,
        "{found:?}"
    );
    // Three pixels aside everything is elsewhere.
    assert!(copied.common.error_grey > 10.0, "{copied:?}");
    for of in [prior, refined, warped] {
        assert!(of.common.error_grey < 2.0, "{of:?}");
        assert!(of.common.psnr_db > copied.common.psnr_db + 10.0, "{of:?}");
    }
}
