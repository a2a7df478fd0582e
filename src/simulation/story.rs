//! What happens on the table, and when: which things stand there, and when a person brings or takes one.
//!
//! Frames are counted from 1, as in the paper; fractions are times in between.

use std::ops::Range;

use nalgebra::{Point3, Vector3};

use super::{
    objects::{Kind, Placement},
    random::Stream,
    room::{Person, on_table},
    scene::ObjectId,
};

/// A thing with a name: mask folders and reports call it so.
#[derive(Debug, Clone, PartialEq)]
pub struct Item {
    pub name: &'static str,
    pub kind: Kind,
    pub placement: Placement,
    pub id: ObjectId,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Change {
    Brought,
    Taken,
}

/// A person comes (`enters`), puts an item down or takes it up (`acts`), and has gone (`leaves`).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Event {
    /// Index into the story's items.
    pub item: usize,
    pub change: Change,
    pub enters: f64,
    pub acts: f64,
    pub leaves: f64,
}

/// A stretch of frames with a name, and the item whose region is judged in it.
#[derive(Debug, Clone, PartialEq)]
pub struct Phase {
    pub name: &'static str,
    pub frames: Range<f64>,
    pub evaluated: Option<usize>,
}

#[derive(Debug, Clone, PartialEq)]
pub struct Story {
    /// Those that come and go; what always stands is [`furnishings`].
    pub items: Vec<Item>,
    plot: Plot,
}

#[derive(Debug, Clone, PartialEq)]
enum Plot {
    Written {
        events: Vec<Event>,
        phases: Vec<Phase>,
    },
    /// One event in every window of frames, at each of the spots in turn: something comes, and goes the next time.
    Endless { seed: u64, spots: Vec<Vec<usize>> },
}

/// Frames of patrol in which nothing happens, so that the robots get to know the place.
const QUIET: f64 = 350.0;
/// Frames of patrol that hold one event each.
const WINDOW: f64 = 84.0;

/// What is true at one instant.
#[derive(Debug, Clone, PartialEq)]
pub struct Moment {
    pub phase: &'static str,
    /// Items that stand on the table.
    pub standing: Vec<usize>,
    /// The item in the person's hand, and where its foot is.
    pub carried: Option<(usize, Placement)>,
    pub person: Option<Person>,
    /// The item whose region is judged.
    pub evaluated: Option<usize>,
}

pub const PERSON: ObjectId = ObjectId(1);

/// Things that always stand on the table.
pub fn furnishings() -> Vec<Item> {
    [
        (Kind::CerealBox, -0.43, 0.25, 0.28),
        (Kind::Teapot, -0.13, 0.22, 2.6),
        (Kind::Books, 0.20, 0.25, 0.18),
        (Kind::Plant, 0.54, 0.27, 0.4),
        (Kind::FruitBowl, 0.44, -0.02, 0.3),
        (Kind::Breakfast, 0.40, -0.29, 0.35),
        (Kind::Candle, 0.02, 0.36, 0.0),
    ]
    .into_iter()
    .enumerate()
    .map(|(index, (kind, x, y, yaw))| Item {
        name: kind.name(),
        kind,
        placement: on_table(x, y, yaw),
        id: ObjectId(2 + index as u16),
    })
    .collect()
}

const FIRST_ITEM: u16 = 64;

fn item(index: usize, name: &'static str, kind: Kind, placement: Placement) -> Item {
    Item {
        name,
        kind,
        placement,
        id: ObjectId(FIRST_ITEM + index as u16),
    }
}

impl Story {
    /// Table I of the paper, frames 1 to 1283.
    pub fn tabletop() -> Self {
        let (glass, cup) = (0, 1);
        let event = |item, change, enters, acts, leaves| Event {
            item,
            change,
            enters,
            acts,
            leaves,
        };
        let phase = |name, frames, evaluated| Phase {
            name,
            frames,
            evaluated,
        };
        Self {
            items: vec![
                item(glass, "glass", Kind::Glass, on_table(-0.13, -0.13, 0.0)),
                item(cup, "cup", Kind::BlackCup, on_table(0.10, -0.20, -0.5)),
            ],
            plot: Plot::Written {
                events: vec![
                    event(glass, Change::Brought, 325.0, 340.0, 358.0),
                    event(cup, Change::Brought, 657.0, 675.0, 686.0),
                    event(cup, Change::Taken, 962.0, 980.0, 985.0),
                ],
                phases: vec![
                    phase("A", 1.0..340.0, None),
                    phase("B", 340.0..675.0, Some(glass)),
                    phase("C", 675.0..980.0, Some(cup)),
                    phase("D", 980.0..1284.0, Some(cup)),
                ],
            },
        }
    }

    /// Section V-C: I2 (frames 1 to 316) to learn, then I3, whose frame n is frame 316 + n here.
    pub fn objects() -> Self {
        const I2: f64 = 316.0;
        let shown = [
            (
                "cup",
                Kind::YellowMug,
                on_table(-0.10, -0.17, -0.6),
                40.0,
                315.0,
            ),
            (
                "milk",
                Kind::MilkCarton,
                on_table(-0.02, -0.08, 0.35),
                435.0,
                690.0,
            ),
            (
                "coffee",
                Kind::CoffeeCan,
                on_table(0.04, -0.16, 0.0),
                810.0,
                1050.0,
            ),
        ];
        let mut phases = vec![Phase {
            name: "I2",
            frames: 1.0..I2 + 1.0,
            evaluated: None,
        }];
        let mut events = Vec::new();
        for (index, &(.., first, last)) in shown.iter().enumerate() {
            let (first, after) = (I2 + first, I2 + last + 1.0);
            events.push(Event {
                item: index,
                change: Change::Brought,
                enters: first - 12.0,
                acts: first,
                leaves: first + 10.0,
            });
            events.push(Event {
                item: index,
                change: Change::Taken,
                enters: after - 12.0,
                acts: after,
                leaves: after + 10.0,
            });
            phases.push(Phase {
                name: "I3",
                frames: first..after,
                evaluated: Some(index),
            });
        }
        phases.push(Phase {
            name: "I3",
            frames: I2 + 1.0..f64::INFINITY,
            evaluated: None,
        });
        Self {
            items: shown
                .iter()
                .enumerate()
                .map(|(index, &(name, kind, placement, ..))| item(index, name, kind, placement))
                .collect(),
            plot: Plot::Written { events, phases },
        }
    }

    /// Things come and go for ever, as the seed says.
    pub fn patrol(seed: u64) -> Self {
        /// Where on the table, and what may stand there.
        type Spot = (f64, f64, &'static [(&'static str, Kind)]);
        let spots: [Spot; 4] = [
            (
                -0.13,
                -0.13,
                &[("glass", Kind::Glass), ("apple", Kind::Apple)],
            ),
            (
                0.10,
                -0.21,
                &[("cup", Kind::BlackCup), ("mug", Kind::YellowMug)],
            ),
            (-0.36, -0.26, &[("milk", Kind::MilkCarton)]),
            (0.08, 0.03, &[("coffee", Kind::CoffeeCan)]),
        ];
        let mut items = Vec::new();
        let spots = spots
            .into_iter()
            .map(|(x, y, kinds)| {
                kinds
                    .iter()
                    .map(|&(name, kind)| {
                        let index = items.len();
                        let mut stream = Stream::new(seed, &[0x17e3, index as u64]);
                        let placement = on_table(
                            x + stream.between(-0.02, 0.02),
                            y + stream.between(-0.02, 0.02),
                            stream.between(-0.6, 0.6),
                        );
                        items.push(item(index, name, kind, placement));
                        index
                    })
                    .collect()
            })
            .collect();
        Self {
            items,
            plot: Plot::Endless { seed, spots },
        }
    }

    /// The event of a window of a patrol.
    fn endless_event(seed: u64, spots: &[Vec<usize>], window: u64) -> Event {
        let count = spots.len() as u64;
        let (spot, turn) = ((window % count) as usize, window / count);
        // What was brought in an even turn is taken in the odd one after it.
        let choice =
            Stream::new(seed, &[0xc4, spot as u64, turn / 2]).below(spots[spot].len() as u64);
        let enters = 1.0
            + QUIET
            + window as f64 * WINDOW
            + Stream::new(seed, &[0x3e, window])
                .between(0.0, WINDOW - 36.0)
                .floor();
        Event {
            item: spots[spot][choice as usize],
            change: if turn.is_multiple_of(2) {
                Change::Brought
            } else {
                Change::Taken
            },
            enters,
            acts: enters + 17.0,
            leaves: enters + 32.0,
        }
    }

    /// The event that is under way at `frame`, or else the last one before it.
    pub fn latest_event(&self, frame: f64) -> Option<Event> {
        match &self.plot {
            Plot::Written { events, .. } => events
                .iter()
                .rev()
                .find(|event| event.enters <= frame)
                .copied(),
            Plot::Endless { seed, spots } => {
                let window = ((frame - 1.0 - QUIET) / WINDOW).floor();
                [window, window - 1.0]
                    .into_iter()
                    .filter(|&window| window >= 0.0)
                    .map(|window| Self::endless_event(*seed, spots, window as u64))
                    .find(|event| event.enters <= frame)
            }
        }
    }

    fn standing(&self, frame: f64) -> Vec<usize> {
        match &self.plot {
            Plot::Written { events, .. } => (0..self.items.len())
                .filter(|&item| {
                    events
                        .iter()
                        .rev()
                        .find(|event| event.item == item && event.acts <= frame)
                        .is_some_and(|event| event.change == Change::Brought)
                })
                .collect(),
            Plot::Endless { seed, spots } => {
                let window = ((frame - 1.0 - QUIET) / WINDOW).floor();
                if window < 0.0 {
                    return Vec::new();
                }
                let count = spots.len() as u64;
                // The last acts at each spot lie at most one round of windows back, and the current one may be to come.
                let mut standing: Vec<usize> = (0..count)
                    .filter_map(|spot| {
                        let event = (0..=count)
                            .filter_map(|back| (window as u64).checked_sub(back))
                            .filter(|window| window % count == spot)
                            .map(|window| Self::endless_event(*seed, spots, window))
                            .find(|event| event.acts <= frame)?;
                        (event.change == Change::Brought).then_some(event.item)
                    })
                    .collect();
                standing.sort_unstable();
                standing
            }
        }
    }

    /// What is true at `frame`.
    pub fn moment(&self, frame: f64) -> Moment {
        let latest = self.latest_event(frame);
        let (phase, evaluated) = match &self.plot {
            Plot::Written { phases, .. } => phases
                .iter()
                .find(|phase| phase.frames.contains(&frame))
                .map_or(("", None), |phase| (phase.name, phase.evaluated)),
            Plot::Endless { .. } => (
                if frame < 1.0 + QUIET {
                    "learn"
                } else {
                    "watch"
                },
                latest
                    .filter(|event| event.acts <= frame)
                    .map(|event| event.item),
            ),
        };
        let visit = latest
            .filter(|event| frame < event.leaves)
            .map(|event| self.visit(&event, frame));
        let (person, carried) = match visit {
            Some((person, carried)) => (Some(person), carried),
            None => (None, None),
        };
        Moment {
            phase,
            standing: self.standing(frame),
            carried,
            person,
            evaluated,
        }
    }

    /// The person, and what is in the hand, while an event lasts.
    fn visit(&self, event: &Event, frame: f64) -> (Person, Option<(usize, Placement)>) {
        let item = &self.items[event.item];
        let foot_of_item = item.placement.foot;
        let (grip_radius_m, grip_height) = item.kind.grip_m();
        let at_table = Point3::new(-0.90, foot_of_item.y + 0.2, 0.0);
        let outside = at_table + Vector3::new(-0.8, -0.9, 0.0);
        let shoulder = at_table + Vector3::new(0.25, -0.2, 0.0);
        let forward = Vector3::new(
            foot_of_item.x - shoulder.x,
            foot_of_item.y - shoulder.y,
            0.0,
        )
        .normalize();
        let at_item = foot_of_item - forward * (grip_radius_m + 0.021) + Vector3::z() * grip_height;

        let before = frame < event.acts;
        let nearness = if before {
            (frame - event.enters) / (event.acts - event.enters)
        } else {
            // The first frames after the act still show the hand at the thing.
            (event.leaves - frame) / (event.leaves - event.acts)
        };
        let smooth = |x: f64| {
            let x = x.clamp(0.0, 1.0);
            x * x * (3.0 - 2.0 * x)
        };
        let walked = smooth(nearness / 0.28);
        let reached = smooth((nearness - 0.18) / 0.72);
        let foot = outside + (at_table - outside) * walked;
        let resting = Person::resting_palm(foot) + Vector3::z() * 0.12;
        let lift = 0.10 * (std::f64::consts::PI * reached).sin();
        let palm = resting + (at_item - resting) * reached + Vector3::z() * lift;
        let holding = before == (event.change == Change::Brought);
        let carried = holding.then(|| {
            let placement = Placement {
                foot: foot_of_item + (palm - at_item),
                ..item.placement
            };
            (event.item, placement)
        });
        (
            Person {
                foot,
                palm,
                grip_radius_m,
            },
            carried,
        )
    }
}
