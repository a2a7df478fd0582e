//! How it is started: a file a verb.

pub mod evaluate;
