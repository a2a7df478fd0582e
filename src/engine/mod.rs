//! Where interpolation and surprise are computed.

pub mod cpu;
