pub mod config;

pub mod commands;

pub mod pipeline;

pub mod stages;

pub mod engine;

pub mod memory;

pub mod evaluation;

pub mod dataset;

pub mod model;
