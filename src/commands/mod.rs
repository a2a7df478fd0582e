//! How the program is started: one file a command.

pub mod archive;

pub mod demo;

pub mod evaluate;

pub mod fleet;

pub mod options;

pub mod output;

pub mod query;

pub mod replay;

pub mod serve;

pub mod simulate;

use clap::{Parser, Subcommand};

use crate::config::ConfigError;

/// The surprise daemon: remembers how places look and notices when they look different.
#[derive(Debug, Parser)]
#[command(version)]
pub struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Demo(demo::Demo),
    Serve(serve::Serve),
    Simulate(simulate::Simulate),
    Replay(replay::Replay),
    Evaluate(evaluate::EvaluateArgs),
    Query(query::Query),
    Export(archive::Export),
    Import(archive::Import),
}

impl Arguments {
    /// # Errors
    /// Whatever made the command fail; [`exit_code`] says which kind.
    pub async fn run(self) -> anyhow::Result<()> {
        match self.command {
            Command::Demo(demo) => demo.run().await,
            Command::Serve(serve) => serve.run().await,
            Command::Simulate(simulate) => simulate.run().await,
            Command::Replay(replay) => replay.run().await,
            Command::Evaluate(evaluate) => evaluate::run(evaluate),
            Command::Query(query) => query.run().await,
            Command::Export(export) => export.run().await,
            Command::Import(import) => import.run().await,
        }
    }
}

/// Arguments that do not go together, where only the command can tell.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct Usage(&'static str);

/// 64 for a wrong configuration, 2 for wrong arguments, as clap's, 1 for everything else, and 0 where only the reader of
/// what was printed has gone.
pub fn exit_code(error: &anyhow::Error) -> u8 {
    if output::is_closed(error) {
        return 0;
    }
    if error.is::<Usage>() {
        return 2;
    }
    let configuration = error.chain().any(|cause| {
        cause.is::<ConfigError>()
            || matches!(
                cause.downcast_ref(),
                Some(crate::service::ServeError::Config(_))
            )
            || matches!(
                cause.downcast_ref(),
                Some(crate::service::client::AskError::Config(_))
            )
            || matches!(
                cause.downcast_ref(),
                Some(crate::service::robot::RobotError::Config(_))
            )
    });
    if configuration { 64 } else { 1 }
}

/// What made a command fail, for people: every cause once, and none of them with the place in a library where it was made.
pub fn explain(error: &anyhow::Error) -> String {
    let mut told = String::new();
    for cause in error.chain() {
        let cause = without_origin(&cause.to_string());
        if told.contains(&cause) {
            continue;
        }
        if !told.is_empty() {
            told += ": ";
        }
        told += &cause;
    }
    told
}

/// Zenoh's errors end with ` at /path/file.rs:line.`
fn without_origin(text: &str) -> String {
    let origin = text.rsplit_once(" at /").and_then(|(what, origin)| {
        let (_, line) = origin.split_once(".rs:")?;
        let after = line.trim_start_matches(|letter: char| letter.is_ascii_digit());
        let is_line = after.len() < line.len();
        is_line.then(|| format!("{what}{}", after.strip_prefix('.').unwrap_or(after)))
    });
    origin.unwrap_or_else(|| text.to_owned())
}

#[cfg(test)]
mod tests {
    use anyhow::anyhow;

    use super::*;

    #[test]
    fn causes_are_told_once_and_without_where_they_were_made() {
        let error = anyhow!("no such port at /root/src/zenoh-link/lib.rs:62.");
        let error = error.context("Zenoh: no such port at /root/src/zenoh-link/lib.rs:62.; see -l");
        assert_eq!(explain(&error), "Zenoh: no such port; see -l");
        let error = anyhow!("not found").context("reading a.txt");
        assert_eq!(explain(&error), "reading a.txt: not found");
        let error = anyhow!("cannot look at /a/b.rs: not found");
        assert_eq!(explain(&error), "cannot look at /a/b.rs: not found");
    }
}
