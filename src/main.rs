//! Arguments -> one call -> exit code.

use std::{io::IsTerminal, process::ExitCode};

use clap::Parser;
use surprised::commands::{Arguments, exit_code, explain};
use tracing_subscriber::EnvFilter;

fn main() -> ExitCode {
    quieten_drivers();
    give_memory_back();
    run()
}

/// The system's allocator would keep what viewpoints leave behind when they leave RAM, in pieces that no other one fits:
/// measured with a place far larger than its budget, the process grew to three times as much. Blocks of their size come from
/// the system and go back there.
fn give_memory_back() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    {
        const BLOCK_BYTES: libc::c_int = 1 << 20;
        // SAFETY: this is the only thread; what is refused stays as it was.
        unsafe { libc::mallopt(libc::M_MMAP_THRESHOLD, BLOCK_BYTES) };
    }
}

/// wgpu asks the Vulkan loader for windows even where none is wanted. Mesa's device selection then looks for a display
/// and, where nobody is logged in, complains on standard error. What a user has set is left alone.
fn quieten_drivers() {
    let is_set = |name| std::env::var_os(name).is_some();
    if !is_set("XDG_RUNTIME_DIR") && !is_set("MESA_VK_DEVICE_SELECT") && !is_set("NODEVICE_SELECT")
    {
        // SAFETY: this is the only thread.
        unsafe { std::env::set_var("NODEVICE_SELECT", "1") };
    }
}

#[tokio::main]
async fn run() -> ExitCode {
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
            let code = exit_code(&error);
            if code != 0 {
                eprintln!("surprised: {}", explain(&error));
            }
            ExitCode::from(code)
        }
    }
}
