//! The service over real Zenoh sessions on loopback: one promise a file.

mod rig;

mod web;

mod reports;

mod newest_wins;

mod hurry;

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

mod posted;

mod next_views;

mod modes;

mod forgetting;

mod busy;

mod pages;

mod standing_by;

mod stopping;
