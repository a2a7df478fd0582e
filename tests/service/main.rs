//! The service over real Zenoh sessions on loopback: one promise a file.

mod rig;

mod reports;

mod newest_wins;

mod maps_on_demand;

mod refusals;

mod clocks;

mod poses;

mod calibrations;

mod rigs;

mod pulls;

mod neighbours;

mod nonsense;

mod questions;

mod pages;

mod stopping;
