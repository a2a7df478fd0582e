pub mod engine;

pub mod evaluation;

pub mod model;

pub mod stages;
