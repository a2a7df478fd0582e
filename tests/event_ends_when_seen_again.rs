//! An event ends when its place was seen again, several times in a row, and nothing is surprising there; a look that
//! could not have seen it counts for nothing.

mod watched;

use nalgebra::Point3;
use surprised::{
    model::event::{EndReason, Event, State},
    stages::events::CLEAR_LOOKS,
};
use watched::{Place, View, WALL_M, at, turned};

const CUP: Point3<f64> = Point3::new(0.0, 0.0, 1.95);

fn view() -> View {
    View::calm("r1", at(0.0, 0.0, 0.0), WALL_M)
}

fn with_an_event() -> (Place, Event) {
    let mut place = Place::default();
    let view = view();
    place.see(&view, &mut [view.region(1, CUP, 0.1, 9.0)]);
    let mut changed = place.see(&view, &mut [view.region(1, CUP, 0.1, 9.0)]);
    (place, changed.remove(0))
}

#[test]
fn clear_looks_in_a_row_end_it() {
    let (mut place, event) = with_an_event();
    for _ in 1..CLEAR_LOOKS {
        assert!(place.calm(&view()).is_empty());
    }
    let last_seen_ns = event.last_seen_ns;
    let changed = place.calm(&view());
    assert_eq!(changed.len(), 1);
    assert_eq!(changed[0].id, event.id);
    assert_eq!(changed[0].state, State::End(EndReason::SeenAgain));
    assert_eq!(changed[0].last_seen_ns, last_seen_ns);
    assert_eq!(changed[0].ended_ns, Some(place.stamp_ns()));
}

#[test]
fn a_sighting_begins_the_count_anew() {
    let (mut place, event) = with_an_event();
    for _ in 0..3 {
        for _ in 1..CLEAR_LOOKS {
            assert!(place.calm(&view()).is_empty());
        }
        let mut regions = [view().region(1, CUP, 0.1, 9.0)];
        let changed = place.see(&view(), &mut regions);
        assert!(changed.iter().all(|event| event.state == State::Update));
        assert_eq!(regions[0].event_id, event.id, "it is the same event");
    }
}

#[test]
fn looks_that_could_not_see_it_count_for_nothing() {
    let looks = [
        ("elsewhere", View::calm("r1", turned([0.0; 3], 1.2), WALL_M)),
        ("behind it", View::calm("r1", at(0.0, 0.0, 2.1), WALL_M)),
        (
            "at the border",
            View::calm("r1", turned([0.0; 3], 0.44), WALL_M),
        ),
        ("hidden", view().hidden_by(0.8)),
        ("far away", View::calm("r1", at(0.0, 0.0, -3.0), 5.0)),
    ];
    for (name, look) in looks {
        let (mut place, _) = with_an_event();
        for _ in 0..4 * CLEAR_LOOKS {
            assert!(place.calm(&look).is_empty(), "{name}");
        }
    }
}

#[test]
fn a_look_through_where_it_stood_counts() {
    let (mut place, event) = with_an_event();
    let through = View::calm("r2", at(0.0, 0.0, 0.5), 4.0);
    let changed: Vec<Event> = (0..CLEAR_LOOKS)
        .flat_map(|_| place.calm(&through))
        .collect();
    assert_eq!(changed.len(), 1);
    assert_eq!(changed[0].id, event.id);
}

#[test]
fn evidence_at_its_place_keeps_it_although_no_region_came_of_it() {
    let (mut place, _) = with_an_event();
    let mut warm = view();
    let (column, row) = (80 / 4, 60 / 4);
    let width = warm.evidence.width;
    warm.evidence.data[row * width + column] = 7.0;
    for _ in 0..4 * CLEAR_LOOKS {
        assert!(place.calm(&warm).is_empty());
    }
}
