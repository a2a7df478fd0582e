//! What commands print. Who reads it may have seen enough and go, as `head` does: then a command ends early and quietly.

use std::{
    fmt::Display,
    io::{self, Write as _},
};

#[derive(Debug, thiserror::Error)]
#[error("standard output: {0}")]
struct OutputError(io::Error);

/// A line on standard output.
///
/// # Errors
/// It cannot be written.
pub fn line(line: impl Display) -> anyhow::Result<()> {
    Ok(writeln!(io::stdout().lock(), "{line}").map_err(OutputError)?)
}

/// Lines that end by themselves.
///
/// # Errors
/// As [`line`].
pub fn lines(lines: impl Display) -> anyhow::Result<()> {
    Ok(write!(io::stdout().lock(), "{lines}").map_err(OutputError)?)
}

/// Whether it only says that nobody reads what is printed any more.
pub fn is_closed(error: &anyhow::Error) -> bool {
    error
        .downcast_ref()
        .is_some_and(|OutputError(error)| error.kind() == io::ErrorKind::BrokenPipe)
}
