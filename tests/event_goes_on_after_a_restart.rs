//! An event that was told of before is the same one afterwards: who sees it again reports it under its id, and it ends
//! when its place is seen without it.

mod watched;

use nalgebra::Point3;
use surprised::{
    model::{
        event::{EndReason, Kind, State},
        report::PixelBox,
    },
    stages::events::CLEAR_LOOKS,
};
use watched::{HEIGHT, Place, View, WALL_M, WIDTH, at};

const CUP: Point3<f64> = Point3::new(0.0, 0.0, 1.95);

#[test]
fn it_is_seen_again_under_its_id_and_ends() {
    let view = View::calm("r1", at(0.0, 0.0, 0.0), WALL_M);
    let mut before = Place::default();
    before.see(&view, &mut [view.region(1, CUP, 0.1, 9.0)]);
    let event = before
        .see(&view, &mut [view.region(1, CUP, 0.1, 9.0)])
        .remove(0);

    let mut place = Place::default();
    place.events.resume(event.clone());
    // Of another robot, from aside.
    let other = View::calm("r2", at(0.1, 0.0, 0.0), WALL_M);
    let mut regions = [other.region(5, CUP, 0.1, 9.0)];
    let changed = place.see(&other, &mut regions);
    assert_eq!(regions[0].event_id, event.id);
    assert_eq!(changed.len(), 1);
    assert_eq!((changed[0].id, changed[0].state), (event.id, State::Update));
    assert_eq!(changed[0].first_seen_ns, event.first_seen_ns);
    assert_eq!(changed[0].sightings, event.sightings + 1);
    let ended: Vec<_> = (0..CLEAR_LOOKS).flat_map(|_| place.calm(&view)).collect();
    assert_eq!(ended.len(), 1);
    assert_eq!(ended[0].state, State::End(EndReason::SeenAgain));
    assert_eq!(ended[0].id, event.id);
    // What comes later is another one.
    let late = Point3::new(0.7, 0.0, 1.95);
    place.see(&view, &mut [view.region(9, late, 0.1, 9.0)]);
    let new = place
        .see(&view, &mut [view.region(9, late, 0.1, 9.0)])
        .remove(0);
    assert!(new.id > event.id);
}

#[test]
fn what_has_ended_stays_ended() {
    let view = View::calm("r1", at(0.0, 0.0, 0.0), WALL_M);
    let mut before = Place::default();
    before.see(&view, &mut [view.region(1, CUP, 0.1, 9.0)]);
    before.see(&view, &mut [view.region(1, CUP, 0.1, 9.0)]);
    let ended = (0..CLEAR_LOOKS).flat_map(|_| before.calm(&view)).last();
    let ended = ended.expect("it was seen again");
    let mut place = Place::default();
    place.events.resume(ended.clone());
    let mut regions = [view.region(1, CUP, 0.1, 9.0)];
    place.see(&view, &mut regions.clone());
    let new = place.see(&view, &mut regions).remove(0);
    assert_eq!(new.state, State::New);
    assert!(new.id > ended.id);
}

#[test]
fn an_unseen_area_ends_when_it_has_been_seen() {
    let mut before = Place::default();
    let known = View::calm("r1", at(0.0, 0.0, 0.0), WALL_M);
    let unknown = known.clone().unseen(PixelBox {
        x_min: 80,
        y_min: 0,
        x_max: WIDTH as u32,
        y_max: HEIGHT as u32,
    });
    before.calm(&unknown);
    let event = before.calm(&unknown).remove(0);
    assert_eq!(event.kind, Kind::Unseen);
    assert!(event.unseen_points.len() > 8, "{event:?}");
    let mut place = Place::default();
    place.events.resume(event.clone());
    let ended: Vec<_> = (0..CLEAR_LOOKS).flat_map(|_| place.calm(&known)).collect();
    assert_eq!(ended.len(), 1);
    assert_eq!((ended[0].id, ended[0].kind), (event.id, Kind::Unseen));
    assert!(ended[0].unseen_points.is_empty());
}
