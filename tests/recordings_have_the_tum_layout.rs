//! A written script can be read back as a recording in TUM RGB-D layout.

use std::{fs, path::Path};

use surprised::{
    simulation::{
        script::{Script, Views},
        write::{Options, Truth, WriteError, recording},
    },
    stages::depth::InverseDepthRange,
};

fn lines(dir: &Path, name: &str) -> Vec<String> {
    fs::read_to_string(dir.join(name))
        .unwrap()
        .lines()
        .map(String::from)
        .collect()
}

fn some(truth: Truth) -> Options {
    Options {
        station: 0,
        frames: 670..680,
        step: 3,
        truth,
        jpeg_quality: 92,
    }
}

#[test]
fn every_list_names_every_frame_and_every_file_is_there() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let script = Script::tabletop(1);
    let summary = recording(dir, &script, &some(Truth::Exact)).unwrap();
    assert_eq!((summary.frames, summary.without_pose), (4, 0));
    assert_eq!(
        lines(dir, "calibration.txt"),
        ["# fx fy cx cy", "262.5 262.5 159.5 119.5"]
    );
    assert_eq!(lines(dir, "rgb.txt")[0], "# timestamp filename");
    assert_eq!(
        lines(dir, "groundtruth.txt")[0],
        "# timestamp tx ty tz qx qy qz qw"
    );
    // Frame 670 (from 0) is taken 670 / 7 s after the start.
    assert_eq!(lines(dir, "rgb.txt")[1], "1095.714286 rgb/1095.714286.jpg");
    assert_eq!(
        lines(dir, "depth.txt")[1],
        "1095.714286 depth/1095.714286.png"
    );
    let phases = lines(dir, "phases.csv");
    assert_eq!(phases[0], "# timestamp,phase,pass,present,evaluated");
    assert_eq!(phases[1], "1095.714286,B,back,glass+person,glass");
    assert_eq!(phases[3], "1096.571429,C,fwd,glass+cup+person,cup");
    for list in ["rgb.txt", "depth.txt"] {
        assert_eq!(lines(dir, list).len(), 5);
        for line in &lines(dir, list)[1..] {
            let file = line.split(' ').nth(1).unwrap();
            let image = image::open(dir.join(file)).unwrap();
            assert_eq!((image.width(), image.height()), (320, 240));
        }
    }
    for (index, line) in lines(dir, "groundtruth.txt")[1..].iter().enumerate() {
        let numbers: Vec<f64> = line.split(' ').map(|n| n.parse().unwrap()).collect();
        let pose = script.world_from_camera(0, 670.0 + 3.0 * index as f64);
        let t = pose.translation.vector;
        let q = pose.rotation.coords;
        for (got, expected) in numbers[1..].iter().zip([t.x, t.y, t.z, q.x, q.y, q.z, q.w]) {
            assert!((got - expected).abs() < 1e-6);
        }
    }
    let capture = script.capture(0, 676, Views::Middle);
    let depth = image::open(dir.join("depth/1096.571429.png")).unwrap();
    let depth = depth.as_luma16().expect("16 bit");
    for (pixel, &metres) in depth.pixels().zip(&capture.middle.depth_m) {
        let written = f32::from(pixel.0[0]) / 5000.0;
        assert!(
            (written - metres).abs() <= 1.01e-4,
            "{written} instead of {metres}"
        );
    }
    for (item, name) in ["glass", "cup"].into_iter().enumerate() {
        let mask = image::open(dir.join(format!("mask/{name}/1096.571429.png"))).unwrap();
        assert_eq!(
            mask.as_luma8().expect("8 bit").as_raw(),
            &capture.middle.masks[item]
        );
    }
}

#[test]
fn the_shade_of_the_cup_is_ignored_and_the_cup_is_not() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let script = Script::tabletop(1);
    recording(dir, &script, &some(Truth::Exact)).unwrap();
    let ignored = image::open(dir.join("ignore/1096.571429.png")).unwrap();
    let ignored = ignored.as_luma8().expect("8 bit").as_raw();
    let capture = script.capture(0, 676, Views::Middle);
    for mask in &capture.middle.masks {
        assert!(
            mask.iter()
                .zip(ignored)
                .all(|(item, ignored)| item & ignored == 0)
        );
    }
    // Where the cloth is darker than in the same picture without the cup.
    let cup = &capture.middle.masks[1];
    let low = (0..cup.len())
        .rfind(|&pixel| cup[pixel] == 255)
        .expect("it is in view");
    let shaded = (0..2).any(|below| ignored[low + below * capture.middle.image.width] == 255);
    assert!(shaded, "below the cup's foot lies its shade");
    let share = ignored.iter().filter(|&&value| value == 255).count() as f64 / ignored.len() as f64;
    assert!((0.002..0.2).contains(&share), "{share} of the image");
}

#[test]
fn a_robot_without_a_depth_camera_writes_what_its_three_cameras_tell() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let script = Script::tabletop(1);
    let range = InverseDepthRange::new(0.05, 2.5, 64).unwrap();
    recording(dir, &script, &some(Truth::Computed(range))).unwrap();
    let stamp = &lines(dir, "depth.txt")[1];
    let written = image::open(dir.join(stamp.split(' ').nth(1).unwrap())).unwrap();
    let frame = (stamp.split(' ').next().unwrap().parse::<f64>().unwrap() - 1000.0) * 7.0;
    let capture = script.capture(0, frame.round() as u64, Views::Middle);
    let mut errors: Vec<f32> = written
        .as_luma16()
        .expect("16 bit")
        .pixels()
        .zip(&capture.middle.depth_m)
        .filter(|(written, _)| written.0[0] > 0)
        .map(|(written, truth_m)| (f32::from(written.0[0]) / 5000.0 - truth_m).abs() / truth_m)
        .collect();
    errors.sort_by(f32::total_cmp);
    let median = errors[errors.len() / 2];
    // Far above what 16 bits lose, far below a wrong unit or another frame.
    assert!(median > 1e-3 && median < 2e-2, "{median}");
}

#[test]
fn measured_poses_are_near_the_truth_and_measured_depth_sees_through_glass() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let script = Script::tabletop(1);
    let summary = recording(dir, &script, &some(Truth::Measured)).unwrap();
    assert_eq!(summary.frames + summary.without_pose, 4);
    assert!(summary.frames > 0);
    for line in &lines(dir, "groundtruth.txt")[1..] {
        let numbers: Vec<f64> = line.split(' ').map(|n| n.parse().unwrap()).collect();
        let frame = (numbers[0] - 1000.0) * 7.0;
        let truth = script.world_from_camera(0, frame).translation.vector;
        let off = (0..3)
            .map(|i| (numbers[1 + i] - truth[i]).powi(2))
            .sum::<f64>()
            .sqrt();
        assert!(off > 0.0 && off < 3e-3, "{off} m");
    }
    let capture = script.capture(0, 670, Views::Middle);
    let glass = script.story.items[0].id;
    let (mut seen, mut through) = (0, 0);
    for at in 0..capture.depth_m.len() {
        if capture.middle.object[at] == glass {
            seen += 1;
            through += u32::from(capture.depth_m[at] > capture.middle.depth_m[at] + 0.02);
        }
    }
    assert!(through * 10 > seen * 8, "{through} of {seen}");
}

#[test]
fn what_cannot_be_written_is_an_error() {
    let script = Script::tabletop(1);
    let dir = tempfile::tempdir().unwrap();
    let mut options = some(Truth::Exact);
    options.station = 1;
    assert!(matches!(
        recording(dir.path(), &script, &options),
        Err(WriteError::NoStation {
            station: 1,
            stations: 1
        })
    ));
    options.station = 0;
    options.step = 0;
    assert!(matches!(
        recording(dir.path(), &script, &options),
        Err(WriteError::Step)
    ));
    let file = dir.path().join("file");
    fs::write(&file, "").unwrap();
    let error = recording(&file, &script, &some(Truth::Exact)).unwrap_err();
    assert!(error.to_string().contains("file"), "{error}");
}
