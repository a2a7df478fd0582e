pub mod commands;

pub mod service;

pub mod wire;

pub mod config;

pub mod pipeline;

pub mod stages;

pub mod engine;

pub mod memory;

pub mod evaluation;

pub mod dataset;

pub mod model;
