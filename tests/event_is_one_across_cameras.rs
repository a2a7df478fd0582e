//! What several cameras of several robots see at one place of the world is one event; what lies apart is another.

mod watched;

use nalgebra::Point3;
use surprised::model::event::{Event, State};
use watched::{Place, View, WALL_M, at, turned};

#[test]
fn two_robots_on_two_sides_of_a_thing_see_one_event() {
    let mut place = Place::default();
    // A box 40 cm wide, seen from the front and from behind: the surfaces' centres are 40 cm apart.
    let front = View::calm("r1", at(0.0, 0.0, 0.0), WALL_M);
    let back = View::calm("r2", turned([0.0, 0.0, 4.0], std::f64::consts::PI), WALL_M);
    let near = Point3::new(0.0, 0.0, 1.85);
    let far = Point3::new(0.0, 0.0, 2.03);
    let mut changed = Vec::new();
    for _ in 0..3 {
        changed.extend(place.see(&front, &mut [front.region(1, near, 0.2, 9.0)]));
        changed.extend(place.see(&back, &mut [back.region(2, far, 0.2, 8.0)]));
    }
    let id = changed[0].id;
    assert!(changed.iter().all(|event| event.id == id), "{changed:?}");
    let robots: Vec<&str> = changed[0].robots.iter().map(|robot| &**robot).collect();
    assert_eq!(robots, ["r1", "r2"]);
    assert_eq!(changed[0].peak.source.robot.as_ref(), "r1");
}

#[test]
fn a_robot_that_joins_is_news() {
    let mut place = Place::default();
    let one = View::calm("r1", at(0.0, 0.0, 0.0), WALL_M);
    let other = View::calm("r2", at(0.2, 0.0, 0.0), WALL_M);
    let cup = Point3::new(0.1, 0.0, 1.95);
    for _ in 0..2 {
        place.see(&one, &mut [one.region(1, cup, 0.05, 9.0)]);
    }
    let changed = place.see(&other, &mut [other.region(2, cup, 0.05, 9.0)]);
    assert_eq!((changed.len(), changed[0].state), (1, State::Update));
    assert_eq!(changed[0].robots.len(), 2);
}

#[test]
fn things_that_lie_apart_are_two_events() {
    let mut place = Place::default();
    let view = View::calm("r1", at(0.0, 0.0, 0.0), WALL_M);
    let (cup, plate) = (Point3::new(-0.15, 0.0, 1.95), Point3::new(0.15, 0.0, 1.95));
    let mut changed: Vec<Event> = Vec::new();
    for _ in 0..2 {
        changed.extend(place.see(
            &view,
            &mut [
                view.region(1, cup, 0.05, 9.0),
                view.region(2, plate, 0.05, 9.0),
            ],
        ));
    }
    assert_eq!(changed.len(), 2);
    assert_ne!(changed[0].id, changed[1].id);
}

#[test]
fn what_moves_stays_one_event_as_long_as_its_camera_follows_it() {
    let mut place = Place::default();
    let view = View::calm("r1", at(0.0, 0.0, 0.0), WALL_M);
    let mut ids = Vec::new();
    for step in 0..15 {
        let person = Point3::new(-0.7 + 0.1 * f64::from(step), 0.0, 1.9);
        let mut regions = [view.region(1, person, 0.05, 9.0)];
        place.see(&view, &mut regions);
        ids.push(regions[0].event_id);
    }
    assert_eq!(ids[0], 0);
    assert!(
        ids[1] != 0 && ids[1..].iter().all(|&id| id == ids[1]),
        "{ids:?}"
    );
}
