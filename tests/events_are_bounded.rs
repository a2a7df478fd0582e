//! However much is surprising, a place follows a bounded number of events: the one unseen longest makes room.

mod watched;

use nalgebra::Point3;
use surprised::{
    model::event::{EndReason, State},
    stages::events::OPEN_MAX,
};
use watched::{Place, View, WALL_M, at};

#[test]
fn the_one_unseen_longest_makes_room() {
    let mut place = Place::default();
    let (mut begun, mut ended) = (Vec::new(), Vec::new());
    for thing in 0..3 * OPEN_MAX as u64 {
        // Each of its own, far from the others, so that nothing looks at those before.
        let x = 10.0 * thing as f64;
        let view = View::calm("r1", at(x, 0.0, 0.0), WALL_M);
        for _ in 0..2 {
            let regions = &mut [view.region(thing + 1, Point3::new(x, 0.0, 2.0), 0.1, 9.0)];
            for event in place.see(&view, regions) {
                match event.state {
                    State::New => begun.push(event.id),
                    State::End(reason) => {
                        assert_eq!(reason, EndReason::NoRoom);
                        ended.push(event.id);
                    }
                    State::Update => {}
                }
            }
        }
    }
    assert_eq!(begun.len(), 3 * OPEN_MAX);
    assert_eq!(
        ended,
        begun[..2 * OPEN_MAX],
        "the oldest go, in their order"
    );
}

#[test]
fn thousands_of_regions_in_a_frame_are_borne() {
    let mut place = Place::default();
    let view = View::calm("r1", at(0.0, 0.0, 0.0), WALL_M);
    for round in 0..20u64 {
        let mut regions: Vec<_> = (0..1000u64)
            .map(|index| {
                let center = Point3::new(index as f64, round as f64, 2.0);
                let mut region = view.region(1, Point3::new(0.0, 0.0, 2.0), 0.01, 9.0);
                region.id = 1000 * round + index + 1;
                region.center_in_world = Some(center);
                region
            })
            .collect();
        let changed = place.see(&view, &mut regions);
        assert!(changed.len() <= 2 * OPEN_MAX);
    }
}
