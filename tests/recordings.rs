//! A recording in TUM RGB-D layout is read as it was written, and what is wrong with one is named.

use std::{fs, path::Path};

use surprised::{
    dataset::{self, truth::ChangeKind},
    model::frame::Source,
};
use tempfile::TempDir;

const WIDTH: u32 = 6;
const HEIGHT: u32 = 4;

/// Three images at 1, 2 and 3 s; poses at 0.9 and 1.1 s, at 2.005 s and none near 3 s.
fn write_recording(folder: &Path) {
    for name in ["rgb", "depth", "mask/cup"] {
        fs::create_dir_all(folder.join(name)).unwrap();
    }
    for second in 1..=3u8 {
        let image = image::RgbImage::from_pixel(WIDTH, HEIGHT, image::Rgb([10 * second, 20, 30]));
        image
            .save(folder.join(format!("rgb/{second}.png")))
            .unwrap();
        let depth: image::ImageBuffer<image::Luma<u16>, Vec<u16>> =
            image::ImageBuffer::from_pixel(WIDTH, HEIGHT, image::Luma([5000 * u16::from(second)]));
        depth
            .save(folder.join(format!("depth/{second}.png")))
            .unwrap();
    }
    let mut mask = image::GrayImage::new(WIDTH, HEIGHT);
    mask.put_pixel(2, 1, image::Luma([255]));
    mask.save(folder.join("mask/cup/1.png")).unwrap();
    write(
        folder,
        "rgb.txt",
        "# stamp file\n1.0 rgb/1.png\n2.0 rgb/2.png\n3.0 rgb/3.png\n",
    );
    write(
        folder,
        "depth.txt",
        "3.01 depth/3.png\n1.01 depth/1.png\n1.995 depth/2.png\n",
    );
    write(
        folder,
        "groundtruth.txt",
        "0.9 1 0 0 0 0 0 1\n1.1 2 0 0 0 0 0 1\n2.005 5 0 0 0 0 0 1\n",
    );
    write(
        folder,
        "calibration.txt",
        "# fx fy cx cy\n100 101 2.5 1.5\n",
    );
    write(
        folder,
        "phases.csv",
        "# timestamp,phase,pass,present,evaluated\n1.0,C,fwd,glass+cup,cup\n2.0,A,back,,\n",
    );
}

fn write(folder: &Path, name: &str, text: &str) {
    fs::write(folder.join(name), text).unwrap();
}

fn source() -> Source {
    Source {
        robot: "r".into(),
        camera: "c".into(),
    }
}

fn recorded() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    write_recording(folder.path());
    folder
}

fn error_of(folder: &TempDir) -> String {
    dataset::open(folder.path()).unwrap_err().to_string()
}

#[test]
fn images_get_the_depth_and_the_pose_of_their_time() {
    let folder = recorded();
    let recordings = dataset::open(folder.path()).unwrap();
    let [recording] = &recordings[..] else {
        panic!("one folder is one recording");
    };
    assert_eq!(recording.entries.len(), 2, "the third image has no pose");
    assert_eq!(recording.skipped, 1);
    let first = recording.frame(0, &source()).unwrap();
    assert_eq!(first.stamp_ns, 1_000_000_000);
    assert_eq!(
        first.depth.given_m(),
        Some([1.0; 24].as_slice()),
        "5000 steps a metre"
    );
    assert_eq!(&first.image.data[..3], [10, 20, 30]);
    assert_eq!((first.intrinsics.width, first.intrinsics.height), (6, 4));
    assert_eq!((first.intrinsics.fy, first.intrinsics.cx), (101.0, 2.5));
    let x = |index: usize| recording.entries[index].world_from_camera.translation.x;
    assert!((x(0) - 1.5).abs() < 1e-9, "halfway between two close poses");
    assert_eq!(x(1), 5.0, "the nearest where poses are far apart");
    assert_eq!(
        recording
            .frame(1, &source())
            .unwrap()
            .depth
            .given_m()
            .unwrap()[0],
        2.0
    );
}

#[test]
fn truth_is_found_by_stamp() {
    let folder = recorded();
    let recording = dataset::open(folder.path()).unwrap().remove(0);
    let moment = &recording.truth.moments[0];
    assert_eq!((moment.phase.as_str(), moment.pass.as_str()), ("C", "fwd"));
    assert_eq!(moment.present, ["glass", "cup"]);
    assert_eq!(moment.evaluated.as_deref(), Some("cup"));
    assert_eq!(recording.truth.moments[1].evaluated, None);
    let mask = recording.truth.mask("cup", 0, (6, 4)).unwrap().unwrap();
    let inside: Vec<usize> = (0..24).filter(|&pixel| mask[pixel]).collect();
    assert_eq!(inside, [8], "row 1, column 2");
    assert_eq!(recording.truth.mask("cup", 1, (6, 4)).unwrap(), None);
}

#[test]
fn runs_in_one_folder_come_in_order_with_their_boxes() {
    let folder = tempfile::tempdir().unwrap();
    for run in ["run2", "run1"] {
        write_recording(&folder.path().join(run));
    }
    write(
        folder.path(),
        "boxes.json",
        r#"{"run2": {"1": [{"box": [1, 0, 4, 3], "kind": "added", "label": "mug", "new_since_previous": true}]}}"#,
    );
    let runs = dataset::open(folder.path()).unwrap();
    let names: Vec<&str> = runs.iter().map(|run| run.name.as_str()).collect();
    assert_eq!(names, ["run1", "run2"]);
    assert!(runs[0].truth.boxes.iter().all(Vec::is_empty));
    let [mug] = &runs[1].truth.boxes[1][..] else {
        panic!("one box at the second viewpoint");
    };
    assert_eq!((mug.kind, mug.pixel_box().area()), (ChangeKind::Added, 9));
}

#[test]
fn what_is_wrong_is_named_with_file_and_line() {
    let folder = recorded();
    write(
        folder.path(),
        "groundtruth.txt",
        "# poses\n\n1.0 1 2 3 0 0 0\n",
    );
    let error = error_of(&folder);
    assert!(error.contains("groundtruth.txt, line 3"), "{error}");
    assert!(error.contains("tx ty tz"), "{error}");

    write(folder.path(), "groundtruth.txt", "1.0 1 2 3 0 0 0 0.5\n");
    let error = error_of(&folder);
    assert!(
        error.contains("line 1") && error.contains("normalise"),
        "{error}"
    );

    write_recording(folder.path());
    write(folder.path(), "phases.csv", "1.0,A,fwd\n");
    let error = error_of(&folder);
    assert!(error.contains("phases.csv, line 1"), "{error}");

    write_recording(folder.path());
    write(folder.path(), "calibration.txt", "100 -100 3 2\n");
    let error = error_of(&folder);
    assert!(error.contains("calibration.txt, line 1"), "{error}");
    assert!(error.contains("positive"), "{error}");

    write_recording(folder.path());
    fs::remove_file(folder.path().join("depth.txt")).unwrap();
    let error = error_of(&folder);
    assert!(error.contains("depth.txt"), "{error}");
}

#[test]
fn a_recording_whose_clocks_disagree_is_refused() {
    let folder = recorded();
    write(folder.path(), "depth.txt", "100.0 depth/1.png\n");
    let error = error_of(&folder);
    assert!(error.contains("clock"), "{error}");
}

#[test]
fn depth_that_is_not_16_bit_is_refused() {
    let folder = recorded();
    image::GrayImage::new(WIDTH, HEIGHT)
        .save(folder.path().join("depth/1.png"))
        .unwrap();
    let recording = dataset::open(folder.path()).unwrap().remove(0);
    let error = recording.frame(0, &source()).unwrap_err().to_string();
    assert!(
        error.contains("depth/1.png") && error.contains("16-bit"),
        "{error}"
    );
}
