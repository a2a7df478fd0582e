//! Does a stamp follow the ones before it?
//!
//! Stamps of one stream (nanoseconds) -> follows, or goes back. The rule, which needs no clock of its own:
//!
//! 1. A stamp after the last one follows. If it leaps ahead by more than a minute, the time before the leap is kept.
//! 2. A stamp that continues the time before a leap follows: the leap was one wild stamp.
//! 3. Any other goes back. When three in a row go back but follow each other, the stream's clock was reset: the third
//!    follows, and the order starts anew from it.
//!
//! So one wild stamp, ahead or back, costs no other frame, a reset clock costs two, and nothing locks a stream out.

/// Farther ahead is a pause, or wild.
const LEAP_NS: i64 = 60_000_000_000;
/// Stamps that go back, yet follow each other, until the clock counts as reset.
const RESET_RUN: u32 = 3;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Order {
    Follows,
    /// It follows, but what came at this stamp and later was wild.
    FollowsBeforeLeap(i64),
    /// It follows on a new clock: older stamps mean nothing any more.
    FollowsReset,
    GoesBack {
        last_ns: i64,
    },
}

/// Of one stream.
#[derive(Debug, Clone, Default)]
pub struct StampOrder {
    last_ns: Option<i64>,
    before_leap_ns: Option<i64>,
    /// The last stamp that went back, and how many did so in a row.
    back: Option<(i64, u32)>,
}

fn continues(from_ns: i64, to_ns: i64) -> bool {
    // Differences of stamps centuries apart saturate: they are a leap in any case.
    to_ns > from_ns && to_ns.saturating_sub(from_ns) <= LEAP_NS
}

impl StampOrder {
    pub fn last_ns(&self) -> Option<i64> {
        self.last_ns
    }

    /// Counts stamps that go back; changes nothing else until [`Self::accept`].
    pub fn judge(&mut self, stamp_ns: i64) -> Order {
        let Some(last_ns) = self.last_ns else {
            return Order::Follows;
        };
        if stamp_ns > last_ns {
            return Order::Follows;
        }
        if self
            .before_leap_ns
            .is_some_and(|before| continues(before, stamp_ns))
        {
            return Order::FollowsBeforeLeap(last_ns);
        }
        let run = match self.back {
            Some((previous, run)) if continues(previous, stamp_ns) => run + 1,
            _ => 1,
        };
        self.back = Some((stamp_ns, run));
        if run >= RESET_RUN {
            Order::FollowsReset
        } else {
            Order::GoesBack { last_ns }
        }
    }

    /// Goes on from a stamp that was judged to follow, once nothing else speaks against it.
    pub fn accept(&mut self, stamp_ns: i64) {
        self.before_leap_ns = self
            .last_ns
            .filter(|&last| stamp_ns > last && !continues(last, stamp_ns));
        self.last_ns = Some(stamp_ns);
        self.back = None;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: i64 = 1_000_000_000;

    /// Which of the stamps (seconds) are accepted.
    fn accepted(stamps_s: &[i64]) -> Vec<i64> {
        let mut order = StampOrder::default();
        stamps_s
            .iter()
            .copied()
            .filter(|stamp| {
                let follows = !matches!(order.judge(stamp * SECOND), Order::GoesBack { .. });
                if follows {
                    order.accept(stamp * SECOND);
                }
                follows
            })
            .collect()
    }

    #[test]
    fn stamps_that_go_back_or_repeat_are_refused() {
        assert_eq!(accepted(&[10, 11, 11, 9, 12]), [10, 11, 12]);
    }

    #[test]
    fn a_wild_stamp_ahead_costs_no_later_frame() {
        assert_eq!(
            accepted(&[10, 11, 5000, 12, 13, 14]),
            [10, 11, 5000, 12, 13, 14]
        );
    }

    #[test]
    fn a_wild_stamp_back_costs_only_itself() {
        assert_eq!(accepted(&[1000, 1001, 3, 1002]), [1000, 1001, 1002]);
    }

    #[test]
    fn wild_stamps_again_and_again_lock_nobody_out() {
        assert_eq!(
            accepted(&[10, 9000, 11, 9001, 12, 9002, 13]),
            [10, 9000, 11, 9001, 12, 9002, 13]
        );
    }

    #[test]
    fn a_reset_clock_is_followed_from_its_third_frame() {
        assert_eq!(accepted(&[1000, 1001, 1, 2, 3, 4]), [1000, 1001, 3, 4]);
    }

    #[test]
    fn a_long_pause_is_no_reason_to_refuse() {
        assert_eq!(accepted(&[10, 4000, 4001]), [10, 4000, 4001]);
    }

    #[test]
    fn extreme_stamps_do_not_overflow() {
        let mut order = StampOrder::default();
        for stamp in [i64::MIN, i64::MAX, i64::MIN, 0, i64::MAX, -1] {
            order.judge(stamp);
            order.accept(stamp);
        }
        assert_eq!(order.last_ns(), Some(-1));
    }
}
