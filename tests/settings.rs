//! Settings: a preset, changed by name, refused as a whole where anything is wrong.

use surprised::config::{ConfigError, Preset, Settings};

fn layered(pairs: &[&str]) -> Result<Settings, ConfigError> {
    let pairs: Vec<String> = pairs.iter().map(|pair| (*pair).to_owned()).collect();
    Settings::layered(Preset::Robust, None, &pairs)
}

#[test]
fn a_robot_may_have_pose_noise_of_its_own() {
    let settings = layered(&[
        "robots.cart.pose_position_sd_m=0.01",
        "pose_rotation_sd_rad=0.02",
    ])
    .expect("both are settings");
    let (cart, other) = (settings.pose_noise("cart"), settings.pose_noise("arm"));
    assert_eq!((cart.position_m, cart.rotation_rad), (0.01, 0.02));
    assert_eq!((other.position_m, other.rotation_rad), (0.002, 0.02));
}

#[test]
fn what_is_typed_as_a_person_would_is_understood() {
    let settings = layered(&["sigma_max=2", "evidence=blocks", " views = 5 "]).expect("settings");
    assert_eq!((settings.sigma_max, settings.views), (2.0, 5));
}

#[test]
fn wrong_settings_are_refused_by_name() {
    for (pair, named) in [
        ("no_such=1", "no_such"),
        ("views", "views"),
        ("views=17", "views"),
        ("views=many", "views"),
        ("forgetting=nan", "forgetting"),
        ("robots.cart.speed=1", "speed"),
        ("robots.cart.pose_position_sd_m=-1", "pose_position_sd_m"),
        ("robots=3", "robots"),
    ] {
        let error = layered(&[pair]).expect_err(pair).to_string();
        assert!(error.contains(named), "{pair}: {error}");
    }
}
