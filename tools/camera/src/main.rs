//! `kilogs-camera`: the capture process.

use std::process::ExitCode;

use clap::Parser;
use kilogs_camera::cli::{CameraArgs, run};

fn main() -> ExitCode {
    env_logger::Builder::from_env(env_logger::Env::default().default_filter_or("info")).init();
    match run(&CameraArgs::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            log::error!("{error}");
            ExitCode::from(error.exit_code())
        }
    }
}
