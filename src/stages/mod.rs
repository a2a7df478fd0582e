//! What is computed, one room a stage.

pub mod depth;
