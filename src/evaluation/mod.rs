//! How good it is: methods over recordings with truth, what they find and what they cry wolf at.

pub mod ranking;

pub mod selectivity;

pub mod differencing;

pub mod method;

pub mod measure;

pub mod held_out;

pub mod summary;

pub mod figures;

pub mod table;

pub mod stereo;

pub mod simulated_depth;
