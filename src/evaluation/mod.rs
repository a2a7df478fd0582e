//! How good it is.

pub mod stereo;
