//! An event is where its thing is now: what a hand has put down, not the hand; and it ends when that place is clear.

mod watched;

use nalgebra::Point3;
use surprised::model::event::State;
use watched::{Place, View, WALL_M, at};

const HAND: Point3<f64> = Point3::new(-0.2, 0.0, 1.9);
const CUP: Point3<f64> = Point3::new(0.2, 0.0, 1.95);

/// A hand, then the cup that it has left, reported as the same region; the last frame of the hand.
fn put_down(place: &mut Place, view: &View) -> u64 {
    for _ in 0..3 {
        place.see(view, &mut [view.region(1, HAND, 0.1, 40.0)]);
    }
    let hand_until = place.frames;
    for _ in 0..12 {
        place.see(view, &mut [view.region(1, CUP, 0.05, 9.0)]);
    }
    hand_until
}

#[test]
fn it_has_the_place_and_the_picture_of_what_was_put_down() {
    let mut place = Place::default();
    let view = View::calm("r1", at(0.0, 0.0, 0.0), WALL_M);
    let hand_until = put_down(&mut place, &view);
    let news = (0..12).find_map(|_| {
        place
            .see(&view, &mut [view.region(1, CUP, 0.05, 9.0)])
            .pop()
    });
    let event = news.expect("it is told of once a second");
    assert_eq!(event.center_in_world, Some(CUP));
    assert!(event.extent_in_world.x < 0.07, "{}", event.extent_in_world);
    assert!(
        event.peak.sequence > hand_until,
        "the picture is the hand's"
    );
    assert_eq!(event.peak_surprise, 40.0);
}

#[test]
fn it_lasts_until_the_place_where_it_is_now_is_clear() {
    let mut place = Place::default();
    let view = View::calm("r1", at(0.0, 0.0, 0.0), WALL_M);
    put_down(&mut place, &view);
    // Of the two places this camera sees only the first.
    let beside = View::calm("r2", at(-0.9, 0.0, 0.0), WALL_M);
    for _ in 0..20 {
        let changed = place.calm(&beside);
        assert!(changed.is_empty(), "{changed:?}");
    }
    let ended = (0..20)
        .find_map(|_| place.calm(&view).pop())
        .expect("it ends");
    assert!(matches!(ended.state, State::End(_)), "{ended:?}");
}
