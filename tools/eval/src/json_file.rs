//! Figures on disk: a file is there whole or not at all.

use serde::Serialize;
use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

/// Replaces `path` by `figures` as JSON: written beside it as `NAME.part`, brought to the disk, then renamed over it.
///
/// # Errors
/// What the system says; the file is then as it was before, and nothing is left beside it.
pub fn replace_json(path: &Path, figures: &impl Serialize) -> io::Result<()> {
    let text = serde_json::to_string_pretty(figures)? + "\n";
    let mut temporary = path.as_os_str().to_owned();
    temporary.push(".part");
    let temporary = PathBuf::from(temporary);
    let replaced = File::create(&temporary).and_then(|mut file| {
        file.write_all(text.as_bytes())?;
        file.sync_data()?;
        fs::rename(&temporary, path)
    });
    if replaced.is_err() {
        // The disk may be full; what is half written helps nobody.
        let _ = fs::remove_file(&temporary);
    }
    replaced
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_replaced_whole_or_stays_as_it_was() {
        let folder = tempfile::tempdir().expect("a folder");
        let (path, temporary) = (folder.path().join("figures.json"), folder.path().join("figures.json.part"));
        let names = || fs::read_dir(folder.path()).expect("listed").count();
        replace_json(&path, &[1, 2]).expect("written");
        assert_eq!((fs::read_to_string(&path).expect("read").as_str(), names()), ("[\n  1,\n  2\n]\n", 1));
        if Path::new("/dev/full").exists() {
            // A disk that is full, where the temporary file is.
            std::os::unix::fs::symlink("/dev/full", &temporary).expect("a link");
            assert!(replace_json(&path, &[3]).is_err());
            assert_eq!((fs::read_to_string(&path).expect("read").as_str(), names()), ("[\n  1,\n  2\n]\n", 1));
        }
        fs::remove_file(&path).and_then(|()| fs::create_dir(&path)).expect("a folder in its place");
        assert!(replace_json(&path, &[3]).is_err());
        assert_eq!(names(), 1);
    }
}
