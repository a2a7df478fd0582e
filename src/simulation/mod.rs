//! A world with known truth, and robots in it: the paper's table, rig, tracker and experiment.
//!
//! ```text
//! story (what happens when) ─┐
//! objects, room ─> scene ────┼─> tracer ─> sensor ─┐
//! rig (arc, drive) ──────────┼─> tracker ──────────┼─> script.capture() ─> write (TUM RGB-D layout)
//! ```
//!
//! World: metres, z up, origin on the floor below the middle of the table. Everything follows from a seed. Absent on
//! purpose: the network, and the service that watches.

pub mod random;

pub mod shapes;

pub mod texture;

mod casters;

pub mod scene;

pub mod tracer;

pub mod objects;

pub mod room;

pub mod story;

pub mod rig;

pub mod tracker;

pub mod sensor;

pub mod script;

pub mod write;

pub mod afterimage;

pub mod judge;
