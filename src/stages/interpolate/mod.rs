//! The prior at a pose where no viewpoint stands (section III-D).
//!
//! Viewpoints and a camera -> one interpolated belief a pixel, with depth (metres) and coverage. In two passes: each
//! mesh is projected into a map of source positions ([`reach`] says which of it a strip sees, [`project`] draws it: what is
//! flat by [`patch`], the rest by its quads), then records are gathered and merged ([`gather`], [`merge`]).
//! The paper averages all covering views; the votes are ours and switchable.

pub mod gather;

pub mod merge;

pub mod patch;

pub mod prior;

pub mod project;

mod quads;

pub mod reach;

pub mod sample;
