use std::process::ExitCode;

use clap::{Parser, Subcommand};
use surprised::commands::evaluate::{self, EvaluateArgs};

#[derive(Parser)]
#[command(version, about)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    Evaluate(EvaluateArgs),
}

fn main() -> ExitCode {
    let result = match Arguments::parse().command {
        Command::Evaluate(arguments) => evaluate::run(arguments),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("surprised: {error:#}");
            ExitCode::FAILURE
        }
    }
}
