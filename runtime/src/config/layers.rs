//! Lays the sources of settings over one another and remembers where each value came from.

use super::table::SETTINGS;
use super::{ConfigError, DEFAULT_TOML};
use crate::settings::Settings;
use std::collections::BTreeMap;
use std::fmt;
use std::path::PathBuf;
use toml::{Table, Value};

/// Where a value came from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Origin {
    /// The defaults in the binary.
    Builtin,
    /// A file given with `--config`.
    File(PathBuf),
    /// A value given with `--set`.
    CommandLine,
}

impl fmt::Display for Origin {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Builtin => f.write_str("built-in default.toml"),
            Self::File(path) => write!(f, "{}", path.display()),
            Self::CommandLine => f.write_str("--set"),
        }
    }
}

/// Settings by full key, each with its origin.
pub(super) struct Layers {
    values: BTreeMap<String, (Value, Origin)>,
}

impl Layers {
    /// The defaults, which name every setting.
    pub(super) fn builtin() -> Result<Self, ConfigError> {
        let mut layers = Self { values: BTreeMap::new() };
        layers.add_table(&parse(DEFAULT_TOML, &Origin::Builtin)?, &Origin::Builtin)?;
        Ok(layers)
    }

    /// Lays a file over what is there.
    pub(super) fn add_file(&mut self, text: &str, path: PathBuf) -> Result<(), ConfigError> {
        let origin = Origin::File(path);
        self.add_table(&parse(text, &origin)?, &origin)
    }

    /// Lays one `key=value` over what is there. A value that is no TOML is a word: `off` means `"off"`.
    pub(super) fn add_assignment(&mut self, assignment: &str) -> Result<(), ConfigError> {
        let Some((key, text)) = assignment.split_once('=') else {
            let reason = format!("\"{assignment}\" has no =; write it as tracking.dynamic_filter=off");
            return Err(ConfigError::Syntax { origin: Origin::CommandLine, reason });
        };
        let (key, text) = (key.trim(), text.trim());
        let value = format!("value = {text}")
            .parse::<Table>()
            .ok()
            .and_then(|mut table| table.remove("value"))
            .unwrap_or_else(|| Value::String(text.to_owned()));
        self.put(key.to_owned(), value, &Origin::CommandLine)
    }

    fn add_table(&mut self, table: &Table, origin: &Origin) -> Result<(), ConfigError> {
        for (section, content) in table {
            let Value::Table(content) = content else {
                let reason =
                    format!("{section} stands outside a section; write it under [tracking], [mapping] or another");
                return Err(ConfigError::Syntax { origin: origin.clone(), reason });
            };
            for (name, value) in content {
                self.put(format!("{section}.{name}"), value.clone(), origin)?;
            }
        }
        Ok(())
    }

    fn put(&mut self, key: String, value: Value, origin: &Origin) -> Result<(), ConfigError> {
        if SETTINGS.iter().all(|setting| setting.key != key) {
            return Err(ConfigError::Unknown { origin: origin.clone(), hint: hint_for(&key), key });
        }
        self.values.insert(key, (value, origin.clone()));
        Ok(())
    }

    /// Checks every value and makes settings of them.
    pub(super) fn into_settings(self) -> Result<Settings, ConfigError> {
        let mut settings = Settings::measured();
        for setting in SETTINGS {
            let Some((value, _)) = self.values.get(setting.key) else { continue };
            setting.put(&mut settings, value).map_err(|reason| self.refusal(setting.key, reason))?;
        }
        match settings.contradiction() {
            None => Ok(settings),
            Some((key, reason)) => Err(self.refusal(key, reason)),
        }
    }

    fn refusal(&self, key: &str, reason: String) -> ConfigError {
        let (value, origin) = match self.values.get(key) {
            Some((value, origin)) => (value.to_string(), origin.clone()),
            None => (String::new(), Origin::Builtin),
        };
        ConfigError::Value { origin, key: key.to_owned(), value, reason }
    }
}

fn parse(text: &str, origin: &Origin) -> Result<Table, ConfigError> {
    text.parse().map_err(|error: toml::de::Error| ConfigError::Syntax {
        origin: origin.clone(),
        reason: format!("not valid TOML: {}", error.to_string().trim_end()),
    })
}

/// The nearest key, or what else there is.
fn hint_for(key: &str) -> String {
    let nearest = SETTINGS.iter().map(|setting| (edit_distance(key, setting.key), setting.key)).min();
    match nearest {
        Some((distance, near)) if distance <= key.len() / 3 => format!("did you mean {near}?"),
        _ => {
            let all: Vec<_> = SETTINGS.iter().map(|setting| setting.key).collect();
            format!("the settings are {}", all.join(", "))
        }
    }
}

/// Fewest insertions, deletions and replacements that turn one word into the other.
fn edit_distance(from: &str, to: &str) -> usize {
    let to: Vec<char> = to.chars().collect();
    let mut row: Vec<usize> = (0..=to.len()).collect();
    for (i, a) in from.chars().enumerate() {
        let mut diagonal = row[0];
        row[0] = i + 1;
        for (j, b) in to.iter().enumerate() {
            let replaced = diagonal + usize::from(a != *b);
            diagonal = row[j + 1];
            row[j + 1] = replaced.min(row[j] + 1).min(diagonal + 1);
        }
    }
    row[to.len()]
}
