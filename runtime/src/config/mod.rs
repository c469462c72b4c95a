//! Configuration as typed: the built-in defaults, then a file, then single values from the command line.
//!
//! The built-in `default.toml` names every setting; what is not in it is unknown. [`Settings`] is what the rest of
//! the program sees.

mod layers;
mod schema;
mod table;

pub use layers::Origin;

use crate::settings::Settings;
use layers::Layers;
use std::path::PathBuf;

/// The default of every setting, with units, ranges and sources.
pub const DEFAULT_TOML: &str = include_str!("../../config/default.toml");

/// Options that every command with settings takes.
#[derive(Debug, Clone, Default, clap::Args)]
pub struct ConfigArgs {
    /// Settings file; what it does not name keeps its default.
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// One setting, such as tracking.dynamic_filter=off; may be given many times and beats the file.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub set: Vec<String>,
}

/// Reads all layers and checks them.
///
/// # Errors
/// [`ConfigError`] naming key, value, range and where the value came from. Its exit code is 2.
pub fn load(args: &ConfigArgs) -> Result<Settings, ConfigError> {
    let mut layers = Layers::builtin()?;
    if let Some(path) = &args.config {
        let text =
            std::fs::read_to_string(path).map_err(|source| ConfigError::Unreadable { file: path.clone(), source })?;
        layers.add_file(&text, path.clone())?;
    }
    for assignment in &args.set {
        layers.add_assignment(assignment)?;
    }
    layers.into_settings()
}

/// Why a configuration cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file is not there or not readable.
    #[error("reading the settings {}: {source}; check the path given with --config", file.display())]
    Unreadable {
        /// The file.
        file: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The text is not TOML, or not of the shape of `default.toml`.
    #[error("{origin}: {reason}")]
    Syntax {
        /// Where the text came from.
        origin: Origin,
        /// What is wrong and what to write.
        reason: String,
    },
    /// There is no such setting.
    #[error("{origin}: there is no setting {key}; {hint}")]
    Unknown {
        /// Where the key came from.
        origin: Origin,
        /// The key.
        key: String,
        /// The nearest known key, or all of the section.
        hint: String,
    },
    /// The value is not allowed.
    #[error("{origin}: {key} = {value}: {reason}")]
    Value {
        /// Where the value came from.
        origin: Origin,
        /// The key.
        key: String,
        /// The value as written.
        value: String,
        /// The range, or what is possible.
        reason: String,
    },
}

#[cfg(test)]
mod tests;
