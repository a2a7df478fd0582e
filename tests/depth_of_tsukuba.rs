//! Three cameras see more than two, and well: at most 2.0 % of Middlebury's tsukuba is wrong by more than a pixel.

use std::path::PathBuf;
use surprised::{
    config::Settings,
    evaluation::stereo::{BadPixels, Cameras, StereoScene, evaluate},
    stages::depth::DepthSettings,
};

#[test]
fn at_most_two_percent_of_tsukuba_is_wrong_and_more_with_two_cameras() {
    let data = std::env::var_os("SURPRISED_DATA")
        .map_or_else(|| PathBuf::from("../shared/data"), PathBuf::from);
    let folder = data.join("tsukuba");
    if !folder.exists() {
        eprintln!("skipped: no recordings at {}", folder.display());
        return;
    }
    let scene = StereoScene::open(&folder).unwrap();
    let range = scene.disparities(Settings::robust().depth_labels);
    let bad =
        |cameras| -> BadPixels { evaluate(&scene, DepthSettings::default(), cameras, &range) };
    let (three, two) = (bad(Cameras::Three), bad(Cameras::Two));
    println!("three cameras: {three:#.2?}\ntwo cameras: {two:#.2?}");
    assert!(three.bad_over_1px <= 2.0, "{three:?}");
    assert!(three.bad_over_1px < two.bad_over_1px, "{three:?} {two:?}");
    assert!(
        three.near_discontinuities < two.near_discontinuities,
        "{three:?} {two:?}"
    );
    assert!(three.invalid < 1.0, "{three:?}");
}
