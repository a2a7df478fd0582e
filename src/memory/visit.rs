//! Which viewpoints a camera has written during its present visit (step 2 of the robust preset).
//!
//! A fast learner must not eat its own novelty: a view is *fresh* from when it is written until it leaves the nearest
//! seven, and counts little in votes until it was rewritten often, as happens to a robot that stands still.

/// Weight of a view written once in this visit, and what each rewriting beyond those of a passing robot adds: a standing
/// robot, whose one fresh view faces six others, learns after 34 frames.
const FRESH_WEIGHT: f32 = 0.2;
/// A robot that passes at 8 mm a frame writes a view, made every 25 mm, so often again.
const REWRITTEN_IN_PASSING: u32 = 3;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Fresh {
    id: u64,
    rewritten: u32,
}

/// Of one camera of one robot.
#[derive(Debug, Clone, Default)]
pub struct Visit {
    fresh: Vec<Fresh>,
}

impl Visit {
    /// Forgets views that left the nearest seven.
    pub fn select(&mut self, selected_ids: &[u64]) {
        self.fresh.retain(|fresh| selected_ids.contains(&fresh.id));
    }

    /// `(weight, fresh)` of a view.
    pub fn weight(&self, id: u64) -> (f32, bool) {
        match self.fresh.iter().find(|fresh| fresh.id == id) {
            Some(fresh) => {
                let beyond_passing = fresh.rewritten.saturating_sub(REWRITTEN_IN_PASSING);
                (FRESH_WEIGHT * (1 + beyond_passing) as f32, true)
            }
            None => (1.0, false),
        }
    }

    /// Notes that the camera's frame became this viewpoint.
    pub fn wrote(&mut self, id: u64) {
        match self.fresh.iter_mut().find(|fresh| fresh.id == id) {
            Some(fresh) => fresh.rewritten += 1,
            None => self.fresh.push(Fresh { id, rewritten: 0 }),
        }
    }
}
