//! Finding the vocabulary by which places are recognized.

use super::memory::MAX_VOCABULARY_BYTES;
use crate::inference::usual_places;
use kilogs_core::places::Vocabulary;
use std::path::{Path, PathBuf};

/// Name of the vocabulary that comes with the program.
const FILE: &str = "places.kgv";

/// The vocabulary in `file`, or, where that is empty, the one that comes with the program; it lives as long as the process. With
/// its checksum: words of two vocabularies have nothing to do with each other.
///
/// # Errors
/// What is wrong, and what to do.
pub fn find(file: &Path) -> Result<(Vocabulary<'static>, u32), String> {
    let places: Vec<PathBuf> = match file.as_os_str().is_empty() {
        true => usual_places().into_iter().map(|folder| folder.join(FILE)).collect(),
        false => vec![file.to_owned()],
    };
    let advice = "give one with --set loop_closure.vocabulary=FILE; models/README.md says how it is made";
    let Some(path) = places.iter().find(|path| path.is_file()) else {
        let places = places.iter().map(|path| path.display().to_string()).collect::<Vec<_>>().join(", ");
        return Err(format!("there is no vocabulary in {places}; {advice}"));
    };
    let bytes = std::fs::read(path).map_err(|e| format!("reading {}: {e}; {advice}", path.display()))?;
    if bytes.len() > MAX_VOCABULARY_BYTES {
        let (found, most) = (bytes.len(), MAX_VOCABULARY_BYTES);
        return Err(format!("{} has {found} bytes, at most {most} are planned for; {advice}", path.display()));
    }
    let crc = crc32fast::hash(&bytes);
    let opened = Vocabulary::open(bytes.leak()).map_err(|problem| format!("{} {problem}; {advice}", path.display()));
    opened.map(|vocabulary| (vocabulary, crc))
}
