//! What is learnt lasts: in a folder, in any object store, in a real S3-compatible one.

#[path = "../reference/mod.rs"]
mod reference;

mod archives;

mod rig;

mod flaky;

mod suite;

mod leases;

mod outages;

mod residency;

mod s3;
