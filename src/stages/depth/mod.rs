//! Depth from three cameras.

mod belief_propagation;
mod checkerboard;
mod lanes;
mod messages;

pub use belief_propagation::{BeliefPropagation, Contrast, PropagationSettings, Smoothness};
pub use checkerboard::CostVolume;
pub use messages::Belief;
