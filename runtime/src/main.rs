//! `kilogs`: the command line.

use kilogs::seal::CountingAllocator;
use std::process::ExitCode;

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;

fn main() -> ExitCode {
    let mut log = env_logger::Builder::from_env(env_logger::Env::default().default_filter_or("info"));
    log.format_target(false).format_timestamp_millis().init();
    match kilogs::cli::main() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            let mut said = error.to_string();
            eprintln!("error: {said}");
            let mut cause = std::error::Error::source(&error);
            while let Some(inner) = cause {
                let why = inner.to_string();
                // Most messages name their cause themselves.
                if !said.contains(&why) {
                    eprintln!("  because: {why}");
                    said = why;
                }
                cause = inner.source();
            }
            ExitCode::from(&error)
        }
    }
}
