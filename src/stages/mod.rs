//! What is computed, in the order of a frame's way. Plain functions over values and rows; they know `model` alone.

pub mod stamp_order;

pub mod pose_track;

pub mod rectify;

pub mod localise;

pub mod depth;

pub mod select;

pub mod view_tree;

pub mod refine;

pub mod interpolate;

pub mod exposure;

pub mod update;

pub mod surprise;

pub mod attend;

pub mod events;

pub mod next_view;
