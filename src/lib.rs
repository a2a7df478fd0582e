//! The surprise daemon: remembers how places look and notices when they look different.
//!
//! ```text
//! robot ──Zenoh──> ingest ─> decode ─> localise ─> depth ─> recall ─> surprise ─> attend ─> publish ──Zenoh──> consumers
//!                  newest    checks    pose or     given    select 7, update,     blocks,   reports,
//!                  wins                markers,    or 3     inter-    KL map      regions   maps on demand
//!                                      rectified   cameras  polate
//!                                                             ^          │
//!                                                             └─ viewpoint memory <─ remember (grow or replace)
//!                                                                       │
//!                                           prior / evaluate / views queries, HTTP
//! ```
//!
//! One worker thread owns one place: its pipeline and its memory. [`pipeline::Pipeline::process`] is a plain function
//! from a frame to a report: no clock, no network, no locks. Zenoh's callbacks only fill bounded queues; questions that
//! need the memory are bounded requests to the same worker; status reads a published snapshot.
//!
//! The modules from the outside in; each names only those below it.

/// How the program is started: one file a command.
pub mod commands;

/// How it is reached: Zenoh, HTTP, the workers and their bounded queues.
pub mod service;

/// Bytes <-> model: keys, messages, every check of what comes from outside.
pub mod wire;

/// How good it is: methods over recordings with truth, what they find and what they cry wolf at.
pub mod evaluation;

/// Recordings in TUM RGB-D layout, with truth where there is some.
pub mod dataset;

/// A world with known truth, and robots in it.
pub mod simulation;

/// The only file that knows the order of the stages.
pub mod pipeline;

/// Where interpolation and surprise are computed.
pub mod engine;

/// The viewpoints of a place, their growth and replacement, and where they last.
pub mod memory;

/// What is computed: plain functions over values and rows.
pub mod stages;

/// Every setting: unit, default, bound, reason.
pub mod config;

/// What flows: frame, camera, pose, belief, viewpoint, report.
pub mod model;

/// Values side by side, and arithmetic on them that becomes vector code.
pub mod lanes;

/// The threads that computations share.
pub mod pool;

/// Which instructions the hot loops are compiled for.
pub mod isa;
