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
