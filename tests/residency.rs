//! Which viewpoints stay on the device: the least recently used make room, and never for one of the same recall.

mod reference;

use reference::Random;
use surprised::engine::gpu::residency::{Place, Residency};

#[test]
fn a_viewpoint_is_brought_once_and_again_after_it_was_written() {
    let mut residency = Residency::new(100, 100);
    residency.begin(100);
    assert_eq!(residency.place(1, (1, 0), 40), Some(Place::Empty(0)));
    assert_eq!(residency.place(1, (1, 0), 40), Some(Place::Held(0)));
    assert_eq!(residency.place(2, (1, 0), 40), Some(Place::Empty(40)));
    residency.begin(100);
    assert_eq!(residency.place(1, (2, 5), 40), Some(Place::Empty(0)));
    assert_eq!(residency.place(1, (2, 5), 40), Some(Place::Held(0)));
    // A memory that began anew.
    assert_eq!(residency.place(1, (2, 6), 40), Some(Place::Empty(0)));
    assert_eq!((residency.pixels(), residency.evicted()), (80, 0));
}

#[test]
fn the_least_recently_used_makes_room() {
    let mut residency = Residency::new(100, 100);
    for id in [1, 2, 1] {
        residency.begin(100);
        residency.place(id, (1, 0), 50).expect("there is room");
    }
    residency.begin(100);
    assert_eq!(residency.place(3, (1, 0), 50), Some(Place::Empty(50)));
    assert_eq!(residency.place(1, (1, 0), 50), Some(Place::Held(0)));
    assert_eq!(residency.evicted(), 1);
}

#[test]
fn views_of_one_recall_never_push_each_other_out() {
    let mut residency = Residency::new(100, 100);
    residency.begin(100);
    assert_eq!(residency.place(1, (1, 0), 60), Some(Place::Empty(0)));
    assert_eq!(residency.place(2, (1, 0), 60), None);
    assert_eq!(residency.place(1, (1, 0), 60), Some(Place::Held(0)));
}

#[test]
fn room_grows_up_to_its_bound_before_anything_must_go() {
    let mut residency = Residency::new(10, 100);
    for id in 0..10 {
        residency.begin(100);
        assert_eq!(residency.place(id, (1, 0), 10), Some(Place::Empty(10 * id)));
    }
    assert_eq!((residency.capacity(), residency.evicted()), (100, 0));
    residency.begin(100);
    assert_eq!(residency.place(99, (1, 0), 10), Some(Place::Empty(0)));
    assert_eq!((residency.capacity(), residency.evicted()), (100, 1));
}

#[test]
fn whatever_is_asked_for_no_two_viewpoints_overlap_and_none_leaves_the_room() {
    let mut random = Random(4);
    let mut residency = Residency::new(64, 1000);
    // Of each viewpoint the last place, and in which recall it was given.
    let mut places: Vec<(u64, u64)> = vec![(0, 0); 30];
    for _ in 0..3000 {
        residency.begin(1000);
        let mut recalled: Vec<(u64, u64)> = Vec::new();
        for _ in 0..random.below(5) {
            let id = random.below(30);
            let pixels = 20 + 7 * id as u64;
            let version = (random.below(2) as u64, 0);
            match residency.place(id as u64, version, pixels) {
                Some(Place::Held(first)) => assert_eq!(places[id].0, first),
                Some(Place::Empty(first)) => places[id].0 = first,
                None => continue,
            }
            recalled.push((places[id].0, pixels));
        }
        recalled.sort_unstable();
        recalled.dedup();
        assert!(residency.capacity() <= 1000 && residency.pixels() <= residency.capacity());
        assert!(
            recalled
                .iter()
                .all(|(first, pixels)| first + pixels <= residency.capacity())
        );
        assert!(
            recalled
                .windows(2)
                .all(|pair| pair[0].0 + pair[0].1 <= pair[1].0)
        );
    }
    assert!(residency.evicted() > 100);
}

#[test]
fn a_bound_that_falls_makes_everything_go_at_once() {
    let mut residency = Residency::new(100, 100);
    residency.begin(100);
    for id in [1, 2] {
        residency.place(id, (1, 0), 50).expect("there is room");
    }
    residency.begin(60);
    assert_eq!((residency.capacity(), residency.pixels()), (60, 0));
    assert_eq!(residency.evicted(), 2);
    assert_eq!(residency.place(2, (1, 0), 50), Some(Place::Empty(0)));
    // And one that rises lets it grow again.
    residency.begin(100);
    assert_eq!(residency.place(1, (1, 0), 50), Some(Place::Empty(50)));
    assert_eq!((residency.capacity(), residency.evicted()), (100, 2));
}
