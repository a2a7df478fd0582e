//! Where the stages are computed.

pub mod isa;
