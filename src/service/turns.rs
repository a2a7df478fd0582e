//! Whose turn it is. Frames go before asks, and no frame waits for more than one step of them:
//!
//! ```text
//! round:  each camera's waiting frame, once  ─>  one step of one ask  ─>  next round
//! ```
//!
//! A frame that comes during a step is served in the round after it; one that comes during a round in which its camera
//! was served already waits for the rest of the round, one step, and is next. Asks get a step a round, in turn, so that
//! a long one holds up no short one.

use std::time::{Duration, Instant};

use super::{
    ask::Ask,
    inbox::{Delivery, Inbox},
};
use crate::model::frame::Source;

/// How long a closing worker goes on with what has already come.
const FINISH_WITHIN: Duration = Duration::from_secs(2);

/// What a turn came to.
#[derive(Debug, Default)]
pub struct Turn {
    /// Whose frame was served.
    pub served: Option<Source>,
    /// When to look again even if nothing comes.
    pub wake: Option<Instant>,
}

/// Does what is told. Each call takes the time of one frame at most.
pub trait Hands {
    /// Whether a frame of this camera waits here already.
    fn holds(&self, source: &Source) -> bool;

    /// Takes in what came, but serves nothing.
    fn receive(&mut self, delivery: Delivery);

    /// Serves the frame that waited longest among those that can be, but none of these cameras.
    fn serve(&mut self, but: &[Source]) -> Turn;

    /// Works at an ask for one pass of the engine at most, and returns what is left of it.
    fn step(&mut self, ask: Ask) -> Option<Ask>;

    /// Tells what there is now.
    fn publish(&mut self);
}

/// Until the inbox is closed and what has come is finished.
pub fn take_turns(inbox: &Inbox, hands: &mut impl Hands) {
    hands.publish();
    let mut wake = None;
    let mut finish_by = None;
    // Whose frames were served in this round.
    let mut round: Vec<Source> = Vec::new();
    loop {
        let delivery = inbox.wait(wake, |source| hands.holds(source));
        if delivery.closed && finish_by.is_none() {
            finish_by = Some(Instant::now() + FINISH_WITHIN);
        }
        hands.receive(delivery);
        let turn = hands.serve(&round);
        wake = turn.wake;
        let mut worked = true;
        if let Some(source) = turn.served {
            round.push(source);
        } else if let Some(ask) = inbox.take_ask() {
            inbox.end_ask(hands.step(ask));
            round.clear();
        } else {
            // Those who were served may be served again.
            worked = !round.is_empty();
            round.clear();
        }
        if worked {
            wake = Some(Instant::now());
        }
        hands.publish();
        if finish_by.is_some_and(|finish_by| !worked || Instant::now() >= finish_by) {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::{BTreeMap, BTreeSet};

    use tokio::sync::oneshot;
    use zenoh::bytes::ZBytes;

    use super::*;
    use crate::service::inbox::{ASKS_MAX, Arrival};

    #[derive(Debug, Clone, PartialEq)]
    enum Done {
        Frame(Source),
        Step,
    }

    /// Notes what it is told to do; frames come while it works.
    struct Noting<'a> {
        inbox: &'a Inbox,
        waiting: BTreeSet<Source>,
        done: Vec<Done>,
        /// How much had been done when a camera's waiting frame came.
        came: BTreeMap<Source, usize>,
        /// Steps that the frame waited for which waited for most.
        most_steps: usize,
        steps_left: usize,
        /// Which cameras' next frames come during the work so far done.
        comes_during: fn(usize) -> Vec<Source>,
    }

    fn camera(number: usize) -> Source {
        Source {
            robot: "r".into(),
            camera: number.to_string().into(),
        }
    }

    fn ask() -> Ask {
        // Nobody waits, so that only the hands decide.
        let (answer, _) = oneshot::channel();
        Ask::Mode {
            camera: None,
            set: None,
            answer,
        }
    }

    impl Noting<'_> {
        fn work(&mut self, done: Done) {
            let now = self.done.len();
            self.done.push(done);
            if self.steps_left == 0 {
                return;
            }
            for source in (self.comes_during)(now) {
                if !self.waiting.contains(&source) && !self.came.contains_key(&source) {
                    self.came.insert(source.clone(), now);
                    self.inbox
                        .put_frame(
                            &source,
                            Arrival {
                                payload: ZBytes::new(),
                                arrived: Instant::now(),
                                pulled: false,
                            },
                        )
                        .expect("room");
                }
            }
        }
    }

    impl Hands for Noting<'_> {
        fn holds(&self, source: &Source) -> bool {
            self.waiting.contains(source)
        }

        fn receive(&mut self, delivery: Delivery) {
            for source in delivery.frames {
                drop(self.inbox.take_frame(&source));
                self.waiting.insert(source);
            }
        }

        fn serve(&mut self, but: &[Source]) -> Turn {
            let next = self.waiting.iter().find(|source| !but.contains(source));
            let Some(source) = next.cloned() else {
                return Turn::default();
            };
            self.waiting.remove(&source);
            if let Some(came) = self.came.remove(&source) {
                let since = &self.done[came..];
                let steps = since.iter().filter(|done| **done == Done::Step).count();
                self.most_steps = self.most_steps.max(steps);
            }
            self.work(Done::Frame(source.clone()));
            Turn {
                served: Some(source),
                wake: None,
            }
        }

        fn step(&mut self, ask: Ask) -> Option<Ask> {
            if self.steps_left == 0 {
                self.inbox.close();
                return None;
            }
            self.steps_left -= 1;
            self.work(Done::Step);
            Some(ask)
        }

        fn publish(&mut self) {}
    }

    fn noted(comes_during: fn(usize) -> Vec<Source>) -> (Vec<Done>, usize) {
        let inbox = Inbox::default();
        for _ in 0..ASKS_MAX {
            inbox.put_ask(ask()).expect("room");
        }
        let mut hands = Noting {
            inbox: &inbox,
            waiting: BTreeSet::new(),
            done: Vec::new(),
            came: BTreeMap::new(),
            most_steps: 0,
            steps_left: 1000,
            comes_during,
        };
        take_turns(&inbox, &mut hands);
        (hands.done, hands.most_steps)
    }

    #[test]
    fn a_frame_waits_for_one_step_at_most_however_many_asks_wait() {
        // Two cameras whose next frames come whenever anything is done, and one now and then.
        let (done, most_steps) = noted(|now| {
            let mut sources = vec![camera(0), camera(1)];
            sources.extend((now % 7 == 0).then(|| camera(2)));
            sources
        });
        assert_eq!(most_steps, 1);
        let frames = done.iter().filter(|done| **done != Done::Step).count();
        assert!(frames >= 2 * 999, "{frames} frames beside 1000 steps");
    }

    #[test]
    fn asks_get_a_step_after_every_round_of_frames() {
        let (done, _) = noted(|_| vec![camera(0), camera(1)]);
        let longest = done.split(|done| *done == Done::Step).map(<[Done]>::len);
        assert_eq!(longest.max(), Some(2));
    }

    #[test]
    fn asks_go_on_where_no_frames_come() {
        let (done, _) = noted(|_| Vec::new());
        assert_eq!(done, vec![Done::Step; 1000]);
    }
}
