//! What flows: the values that pass from stage to stage. No behaviour beyond their own geometry and storage.

pub mod belief;

pub mod camera;

pub mod frame;

pub mod mode;
pub mod patch;

pub mod pose;

pub mod refusal;

pub mod report;

pub mod event;

pub mod viewpoint;
