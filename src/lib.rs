//! The surprise daemon: remembers how places look and notices when they look different.

pub mod model;

pub mod simulation;

pub mod stages {
    //! The steps of the way of a frame, each a plain function.

    pub mod localise;
}
