//! A frame's depth may be given or computed from what cameras beside it saw: both come to the same memory.

use std::sync::Arc;

use nalgebra::Vector3;
use surprised::{
    config::Settings,
    model::{
        camera::Intrinsics,
        frame::{DepthSource, Frame, GreyImage, RgbImage, SideView, Sides, Source},
        pose::Pose,
        viewpoint::{LOWER_RIGHT, Mesh, MeshCut, UPPER_LEFT},
    },
    pipeline::{Pipeline, depth_range},
    simulation::script::{Script, Views},
};

fn pipeline(settings: &Settings) -> Pipeline {
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(2)
        .build()
        .expect("two threads");
    Pipeline::new(settings.clone(), Arc::new(pool))
}

fn frame(image: RgbImage, intrinsics: Intrinsics, depth: DepthSource) -> Frame {
    Frame {
        source: Source {
            robot: "anna".into(),
            camera: "head".into(),
        },
        stamp_ns: 0,
        sequence: 0,
        image,
        depth,
        intrinsics,
        world_from_camera: Pose::identity(),
        pose_noise: None,
    }
}

/// Share of a mesh's triangles that exist.
fn joined(mesh: &Mesh) -> f64 {
    let triangles: u32 = mesh.cut.iter().map(|quad| quad.count_ones()).sum();
    f64::from(triangles) / (2 * mesh.cut.len()) as f64
}

#[test]
fn computed_depth_agrees_with_given_depth() {
    let script = Script::tabletop(1);
    let capture = script.capture(0, 40, Views::Triple);
    let intrinsics = script.stations[0].rig.intrinsics;
    let sides = script
        .sides(0, &capture)
        .expect("all cameras were rendered");
    let settings = Settings::robust();
    let given = DepthSource::Given(capture.middle.depth_m.clone());
    let computed = DepthSource::Sides(Box::new(sides));
    let [given, computed] = [given, computed].map(|depth| {
        let mut pipeline = pipeline(&settings);
        let frame = frame(capture.middle.image.clone(), intrinsics, depth);
        pipeline.process(&frame).expect("a good frame");
        // The second is compared with what the first one taught.
        let report = pipeline.process(&frame).expect("a good frame");
        assert!(report.coverage > 0.9, "{}", report.coverage);
        pipeline.memory().viewpoints()[0].mesh.clone()
    });
    let mut errors: Vec<f32> = given
        .depth_m
        .iter()
        .zip(&computed.depth_m)
        .filter(|(given, computed)| **given > 0.0 && **computed > 0.0)
        .map(|(given, computed)| (given - computed).abs() / given)
        .collect();
    assert!(
        errors.len() * 100 > intrinsics.pixels() * 97,
        "{}",
        errors.len()
    );
    errors.sort_by(f32::total_cmp);
    let (median, most) = (errors[errors.len() / 2], errors[errors.len() * 9 / 10]);
    println!("median error {median}, nine of ten below {most}");
    assert!(median < 0.012, "median error {median}");
    println!(
        "joined: given {}, computed {}",
        joined(&given),
        joined(&computed)
    );
    assert!(joined(&computed) > joined(&given) - 0.02);
}

#[test]
fn a_surface_in_steps_of_a_label_is_not_cut_and_an_edge_is() {
    let range = depth_range(&Settings::robust());
    let intrinsics = Intrinsics {
        width: 40,
        height: 2,
        fx: 40.0,
        fy: 40.0,
        cx: 20.0,
        cy: 1.0,
    };
    let steps = |step: usize| -> Vec<f32> {
        let label = |x: usize| (x / 4 * step + 2) as f64;
        (0..80)
            .map(|i| (1.0 / range.inverse_depth(label(i % 40))) as f32)
            .collect()
    };
    let cut = MeshCut {
        share: 0.05,
        inverse_depth: 1.5 * range.step() as f32,
    };
    let slanted = Mesh::new(intrinsics, steps(1), cut);
    assert!(
        slanted
            .cut
            .iter()
            .all(|quad| *quad == UPPER_LEFT + LOWER_RIGHT)
    );
    assert!(joined(&Mesh::new(intrinsics, steps(1), 0.05)) < 1.0);
    // Two of 0.04 are more than the share of 0.05 only where it is far.
    let edges = Mesh::new(intrinsics, steps(2), cut);
    assert_eq!(edges.cut[3], 0, "between 4 and 5 m");
}

#[test]
fn rigs_of_any_size_and_shape_are_processed_and_impossible_ones_refused() {
    let noise = |pixels: usize, seed: usize| -> Vec<u8> {
        (0..pixels)
            .map(|i| ((i * 7919 + seed * 104_729) % 251) as u8)
            .collect()
    };
    let lens = |width: usize, height: usize| Intrinsics {
        width,
        height,
        fx: width as f64,
        fy: width as f64,
        cx: 0.5 * width as f64,
        cy: 0.5 * height as f64,
    };
    let mut pipeline = pipeline(&Settings {
        depth_labels: 17,
        ..Settings::robust()
    });
    let mut computed = 0;
    for (width, height) in [(16, 16), (17, 33), (64, 16), (31, 48)] {
        for (beside, turn) in [
            (Vector3::new(0.1, 0.0, 0.0), Vector3::zeros()),
            (Vector3::new(0.0, 9.9, 0.0), Vector3::new(0.0, 0.0, 1.0)),
            (Vector3::new(1e-4, 0.0, -10.0), Vector3::new(0.9, 0.3, 0.0)),
            (Vector3::new(0.0, 0.0, 10.0), Vector3::zeros()),
        ] {
            let side = |seed: usize, sign: f64| {
                let intrinsics = lens(width + seed, height);
                SideView {
                    image: GreyImage {
                        width: width + seed,
                        height,
                        data: noise((width + seed) * height, seed),
                    },
                    intrinsics,
                    middle_from_side: Pose::new(beside * sign, turn * sign),
                }
            };
            let image = RgbImage {
                width,
                height,
                data: noise(3 * width * height, 5),
            };
            let sides = Sides {
                left: side(0, -1.0),
                right: side(3, 1.0),
            };
            let mut good = frame(
                image,
                lens(width, height),
                DepthSource::Sides(Box::new(sides)),
            );
            match pipeline.process(&good) {
                Ok(_) => computed += 1,
                // Cameras that look past each other say nothing.
                Err(error) => assert_eq!(error.code(), "no_depth", "{error}"),
            }
            let DepthSource::Sides(sides) = &mut good.depth else {
                unreachable!("it was made of sides")
            };
            sides.right.image.width -= 1;
            let refused = pipeline.process(&good).expect_err("the size is wrong");
            assert_eq!(refused.code(), "side_size");
        }
    }
    assert!(computed >= 4, "{computed} rigs see something");
}
