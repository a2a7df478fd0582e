//! A region becomes an event when a second frame has it too; a flicker of one frame is none.

mod watched;

use nalgebra::Point3;
use surprised::model::event::{Kind, State};
use watched::{Place, View, WALL_M, at};

const CUP: Point3<f64> = Point3::new(0.1, 0.0, 2.0);

#[test]
fn a_second_frame_makes_it_new_from_the_first_on() {
    let mut place = Place::default();
    let view = View::calm("r1", at(0.0, 0.0, 0.0), WALL_M);
    let mut regions = [view.region(1, CUP, 0.1, 9.0)];
    assert!(place.see(&view, &mut regions).is_empty());
    assert_eq!(regions[0].event_id, 0, "nobody was told of it yet");
    let first_ns = place.stamp_ns();
    let changed = place.see(&view, &mut regions);
    assert_eq!(changed.len(), 1);
    let event = &changed[0];
    assert_eq!((event.kind, event.state), (Kind::Change, State::New));
    assert_eq!((event.first_seen_ns, event.sightings), (first_ns, 2));
    assert_eq!(event.center_in_world, Some(CUP));
    assert!((event.extent_in_world.x - 0.1).abs() < 0.01);
    assert_eq!(regions[0].event_id, event.id);
    let picture = event.picture.as_ref().expect("it was pictured");
    assert!(picture.seen.width > 30 && picture.expected.is_some());
}

#[test]
fn a_flicker_of_one_frame_is_dropped_when_its_camera_sees_the_place_without_it() {
    let mut place = Place::default();
    let view = View::calm("r1", at(0.0, 0.0, 0.0), WALL_M);
    for round in 0..20 {
        let mut regions = [view.region(1 + round, CUP, 0.1, 9.0)];
        assert!(place.see(&view, &mut regions).is_empty(), "round {round}");
        assert!(place.calm(&view).is_empty());
    }
}

#[test]
fn what_is_learnt_at_once_is_new_as_long_as_it_is_still_there() {
    let mut place = Place::default();
    let view = View::calm("r1", at(0.0, 0.0, 0.0), WALL_M);
    let region = view.region(1, CUP, 0.1, 40.0);
    let first = view.clone().showing(&region, true);
    assert!(place.see(&first, &mut [region.clone()]).is_empty());
    // Seen from elsewhere, it is in another place of the image.
    let moved = View::calm("r1", at(0.1, 0.05, 0.0), WALL_M);
    let still_there = moved.region(1, CUP, 0.1, 40.0);
    let changed = place.calm(&moved.showing(&still_there, false));
    assert_eq!((changed.len(), changed[0].state), (1, State::New));
    assert_eq!((changed[0].sightings, changed[0].peak_surprise), (1, 40.0));
}

#[test]
fn what_is_gone_in_the_next_frame_was_a_flicker() {
    let mut place = Place::default();
    let view = View::calm("r1", at(0.0, 0.0, 0.0), WALL_M);
    let region = view.region(1, CUP, 0.1, 40.0);
    let flash = view.clone().showing(&region, true);
    for _ in 0..10 {
        assert!(place.see(&flash, &mut [region.clone()]).is_empty());
        assert!(place.calm(&view).is_empty());
    }
}

#[test]
fn another_camera_that_sees_nothing_there_does_not_drop_it() {
    let mut place = Place::default();
    let one = View::calm("r1", at(0.0, 0.0, 0.0), WALL_M);
    let other = View::calm("r2", at(0.0, 0.0, 0.0), WALL_M);
    assert!(
        place
            .see(&one, &mut [one.region(1, CUP, 0.1, 9.0)])
            .is_empty()
    );
    assert!(place.calm(&other).is_empty());
    let changed = place.see(&one, &mut [one.region(1, CUP, 0.1, 9.0)]);
    assert_eq!(changed[0].state, State::New);
}

#[test]
fn news_are_told_once_a_second_or_when_the_peak_rises() {
    let mut place = Place::default();
    let view = View::calm("r1", at(0.0, 0.0, 0.0), WALL_M);
    let mut told = Vec::new();
    for frame in 0..31 {
        let surprise = if frame == 15 { 12.0 } else { 9.0 };
        for event in place.see(&view, &mut [view.region(1, CUP, 0.1, surprise)]) {
            told.push((frame, event.state, event.peak_surprise));
        }
    }
    assert_eq!(
        told,
        [
            (1, State::New, 9.0),
            (11, State::Update, 9.0),
            (15, State::Update, 12.0),
            (25, State::Update, 12.0),
        ]
    );
}
