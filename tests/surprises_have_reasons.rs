//! The judge of the simulated robots tells what a surprise was about, what was noticed, and what nothing explains.

use surprised::{
    model::{pose::view_distance_m, report::PixelBox},
    simulation::{
        judge::Judge,
        script::{Capture, Script, Views},
        story::PERSON,
    },
};

/// Half a box's side, pixels.
const HALF: u32 = 12;

fn around(x: u32, y: u32) -> PixelBox {
    PixelBox {
        x_min: x - HALF,
        y_min: y - HALF,
        x_max: x + HALF,
        y_max: y + HALF,
    }
}

/// The middle of the set pixels.
fn middle_of(set: impl Iterator<Item = bool>, width: usize) -> (u32, u32) {
    let places: Vec<_> = set.enumerate().filter(|(_, set)| *set).collect();
    assert!(places.len() > 500, "it is in view: {} pixels", places.len());
    let mean = |of: fn(usize, usize) -> usize| {
        places.iter().map(|(at, _)| of(*at, width)).sum::<usize>() / places.len()
    };
    (
        mean(|at, width| at % width) as u32,
        mean(|at, width| at / width) as u32,
    )
}

#[test]
fn a_thing_is_noticed_where_it_stands_and_nothing_explains_a_surprise_elsewhere() {
    let script = Script::tabletop(1);
    let mut judge = Judge::new(&script);
    let capture = |frame| script.capture(0, frame, Views::Middle);
    assert!(judge.take(0, &capture(100), &[]).is_empty());
    for frame in 760..763 {
        judge.take(0, &capture(frame), &[]);
    }
    let verdict = judge.verdict();
    assert_eq!((verdict.placed, verdict.noticed), (2, 0));

    let seen = capture(763);
    let width = seen.middle.image.width;
    let cup = middle_of(
        seen.middle.masks[1].iter().map(|&value| value == 255),
        width,
    );
    let far_off = around(20, 20);
    let reasons = judge.take(0, &seen, &[(1, around(cup.0, cup.1)), (2, far_off)]);
    assert_eq!(reasons, [Some("cup"), None]);
    let verdict = judge.verdict();
    assert_eq!((verdict.placed, verdict.noticed), (2, 1));
    assert_eq!(verdict.false_alarms, 1);
}

/// The frame among these whose true pose is nearest to that of another.
fn nearest(script: &Script, frames: std::ops::Range<u64>, frame: u64) -> u64 {
    let pose = script.world_from_camera(0, frame as f64);
    frames
        .min_by(|&a, &b| {
            let distance = |frame: u64| {
                view_distance_m(&pose, &script.world_from_camera(0, frame as f64), 1.0)
            };
            distance(a).total_cmp(&distance(b))
        })
        .expect("there are frames")
}

#[test]
fn where_the_person_stood_is_judged_neither_way_until_the_robot_has_come_back() {
    let script = Script::objects(1);
    let capture = |frame| script.capture(0, frame, Views::Middle);
    let is_person = |capture: &Capture| -> Vec<bool> {
        capture
            .middle
            .object
            .iter()
            .map(|&id| id == PERSON)
            .collect()
    };
    let mut judge = Judge::new(&script);
    // The person brings the first thing while the robot drives from Q1 to Q2.
    let met = 357;
    let person = is_person(&capture(met));
    let width = script.stations[0].rig.intrinsics.width;
    let (x, y) = middle_of(person.iter().copied(), width);
    for frame in [met - 1, met] {
        judge.take(0, &capture(frame), &[]);
    }
    // On to Q2, where the person is long gone.
    for frame in 420..430 {
        judge.take(0, &capture(frame), &[]);
    }
    // Past the place on the way back, twice.
    let there = nearest(&script, 480..630, met);
    let verdicts: Vec<_> = [there, there + 12, there]
        .iter()
        .enumerate()
        .map(|(index, &frame)| {
            let back = capture(frame);
            assert!(
                is_person(&back).iter().all(|person| !person),
                "nobody is there"
            );
            let id = 10 * index as u64;
            let elsewhere = around(300, 20);
            judge.take(0, &back, &[(id, around(x, y)), (id + 1, elsewhere)])
        })
        .collect();
    assert_eq!(
        verdicts[0],
        [Some("where the person was"), None],
        "it may still be expected there, and only there"
    );
    assert_eq!(verdicts[2], [None, None], "the robot had passed since");
}
