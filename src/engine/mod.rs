//! Where interpolation and surprise are computed.

pub mod isa;

pub mod cpu;
