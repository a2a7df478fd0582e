//! Arguments -> one call -> exit code.

use std::{io::IsTerminal, process::ExitCode};

use clap::Parser;
use surprised::commands::{Arguments, exit_code};
use tracing_subscriber::EnvFilter;

#[tokio::main]
async fn main() -> ExitCode {
    let arguments = Arguments::parse();
    // RUST_LOG says what is logged; standard output belongs to answers.
    tracing_subscriber::fmt()
        .with_env_filter(
            EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("surprised=info")),
        )
        .with_ansi(std::io::stderr().is_terminal())
        .with_writer(std::io::stderr)
        .init();
    match arguments.run().await {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("surprised: {error:#}");
            ExitCode::from(exit_code(&error))
        }
    }
}
