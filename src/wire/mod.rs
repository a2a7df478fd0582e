//! Bytes <-> model. The messages of `proto/surprised/v1`, the keys they travel on, and every check that what comes from
//! outside must pass before a stage sees it.

pub mod keys;

pub mod decode;

pub mod encode;

pub mod picture;

pub mod schema;

/// The messages as the contract has them; nothing in them has been checked.
pub mod proto {
    include!(concat!(env!("OUT_DIR"), "/surprised.v1.rs"));
}
