//! A large area that no viewpoint knows becomes an event when it is seen a second time, and ends when it was seen again
//! and is known.

mod watched;

use surprised::{
    model::{
        event::{EndReason, Kind, State},
        report::PixelBox,
    },
    stages::events::CLEAR_LOOKS,
};
use watched::{HEIGHT, Place, View, WALL_M, WIDTH, at, turned};

fn right(x_min: u32) -> PixelBox {
    PixelBox {
        x_min,
        y_min: 0,
        x_max: WIDTH as u32,
        y_max: HEIGHT as u32,
    }
}

#[test]
fn it_is_told_when_it_comes_into_view_again_and_ends_when_it_is_known() {
    let mut place = Place::default();
    let known = View::calm("r1", at(0.0, 0.0, 0.0), WALL_M);
    let half = known.clone().unseen(right(80));
    assert!(place.calm(&half).is_empty());
    let changed = place.calm(&half);
    assert_eq!(changed.len(), 1);
    let event = &changed[0];
    assert_eq!((event.kind, event.state), (Kind::Unseen, State::New));
    assert!((event.unseen_share - 0.5).abs() < 0.02);
    let center = event.center_in_world.expect("it has depth");
    assert!(
        (center.x - 0.53).abs() < 0.1 && (center.z - WALL_M).abs() < 1e-6,
        "{center}"
    );
    for _ in 1..CLEAR_LOOKS {
        assert!(place.calm(&known).is_empty());
    }
    let changed = place.calm(&known);
    assert_eq!(changed[0].id, event.id);
    assert_eq!(changed[0].state, State::End(EndReason::SeenAgain));
}

#[test]
fn what_is_learnt_at_once_is_told_too() {
    let mut place = Place::default();
    let known = View::calm("r1", at(0.0, 0.0, 0.0), WALL_M);
    assert!(place.calm(&known.clone().unseen(right(0))).is_empty());
    assert_eq!(place.calm(&known)[0].state, State::New);
}

#[test]
fn a_wild_pose_that_does_not_come_twice_is_none() {
    let mut place = Place::default();
    let known = View::calm("r1", at(0.0, 0.0, 0.0), WALL_M);
    let wild = View::calm("r1", turned([5.0, 0.0, 9.0], 2.0), WALL_M).unseen(right(0));
    assert!(place.calm(&wild).is_empty());
    for _ in 0..200 {
        assert!(place.calm(&known).is_empty());
    }
}

#[test]
fn slivers_beside_things_are_none() {
    let mut place = Place::default();
    let sliver = View::calm("r1", at(0.0, 0.0, 0.0), WALL_M).unseen(right(156));
    for _ in 0..10 {
        assert!(place.calm(&sliver).is_empty());
    }
}

#[test]
fn a_robot_that_goes_on_into_the_unknown_makes_one_event_that_grows() {
    let mut place = Place::default();
    let mut events = Vec::new();
    for step in 0..30 {
        let pose = at(0.15 * f64::from(step), 0.0, 0.0);
        let share = if step == 0 { right(0) } else { right(144) };
        let view = View::calm("r1", pose, WALL_M).unseen(share);
        events.extend(place.calm(&view));
    }
    assert!(events.len() > 1);
    assert!(events.iter().all(|event| event.id == events[0].id));
    let last = events.last().expect("there are some");
    assert_eq!(last.state, State::Update);
    assert!(last.extent_in_world.x > 2.0, "{}", last.extent_in_world);
}
