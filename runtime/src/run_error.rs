//! Everything that can end a command, and the exit code it ends with.

use crate::budget::BudgetError;
use crate::config::ConfigError;
use crate::output::OutputError;
use std::process::ExitCode;

/// Why a command failed. Only `main` prints it, the whole chain, once.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// The settings cannot be used.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The memory budget cannot be used or does not hold the plan.
    #[error(transparent)]
    Budget(#[from] BudgetError),
    /// An option has a value that cannot be used here.
    #[error("{0}")]
    Usage(String),
    /// The camera, the recording or another input.
    #[error("{0}")]
    Input(String),
    /// The capture process or its recording, which know their own exit code.
    #[error("{text}")]
    Camera {
        /// Its exit code.
        code: u8,
        /// What it says.
        text: String,
    },
    /// The compute device.
    #[error("{0}")]
    Device(String),
    /// The map store.
    #[error(transparent)]
    Store(#[from] crate::map_store::StoreError),
    /// Looking at a stored map.
    #[error(transparent)]
    Render(#[from] crate::render_views::command::RenderError),
    /// Exporting a stored map.
    #[error(transparent)]
    Export(#[from] crate::export::ExportError),
    /// The output folder.
    #[error(transparent)]
    Output(#[from] OutputError),
    /// The run itself did not come to its end.
    #[error("{0}")]
    Run(String),
}

impl RunError {
    /// The exit code of contracts.md: 1 run failed, 2 usage, configuration or budget, 3 input, 4 device, 5 map store.
    pub fn code(&self) -> u8 {
        match self {
            Self::Output(_) | Self::Run(_) => 1,
            Self::Config(_) | Self::Budget(_) | Self::Usage(_) => 2,
            Self::Input(_) => 3,
            Self::Camera { code, .. } => *code,
            Self::Device(_) => 4,
            Self::Store(_) => 5,
            Self::Render(error) => error.code(),
            Self::Export(error) => error.code(),
        }
    }

    /// A result that standard output did not take.
    pub(crate) fn stdout(error: std::io::Error) -> Self {
        Self::Run(format!("writing to standard output: {error}; check what it leads to"))
    }
}

impl From<kilogs_camera::cli::CameraError> for RunError {
    fn from(error: kilogs_camera::cli::CameraError) -> Self {
        Self::Camera { code: error.exit_code(), text: error.to_string() }
    }
}

impl From<kilogs_eval::EvalError> for RunError {
    fn from(error: kilogs_eval::EvalError) -> Self {
        match error {
            kilogs_eval::EvalError::Unwritable { .. } => Self::Run(error.to_string()),
            _ => Self::Input(error.to_string()),
        }
    }
}

impl From<&RunError> for ExitCode {
    fn from(error: &RunError) -> Self {
        Self::from(error.code())
    }
}

impl From<kilogs_camera::source::SourceError> for RunError {
    fn from(error: kilogs_camera::source::SourceError) -> Self {
        kilogs_camera::cli::CameraError::from(error).into()
    }
}
