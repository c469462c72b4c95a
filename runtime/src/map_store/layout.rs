//! Names of the files of a map, and writing them so that they are there whole or not at all.

use super::StoreError;
use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};

pub(super) const MANIFEST: &str = "manifest.kgs";
pub(super) const KEYFRAMES: &str = "keyframes.kgs";
pub(super) const ALIGNMENT: &str = "alignment.kgs";
const PLACES: &str = "places.kgs";
pub(super) const PAGES: &str = "pages";
pub(super) const CHUNKS: &str = "chunks";
pub(super) const IMAGES: &str = "images";
const TEMPORARY: &str = "tmp";

/// The places by which the map of a folder is recognized.
pub fn places_path(folder: &Path) -> PathBuf {
    folder.join(PLACES)
}

pub(super) fn page_path(folder: &Path, page_id: u32) -> PathBuf {
    folder.join(PAGES).join(format!("{page_id:08}.kgs"))
}

pub(super) fn chunk_path(folder: &Path, chunk_id: u32) -> PathBuf {
    folder.join(CHUNKS).join(format!("{chunk_id:08}.kgs"))
}

pub(super) fn image_path(folder: &Path, frame_index: u64) -> PathBuf {
    folder.join(IMAGES).join(format!("{frame_index:08}.jpg"))
}

/// Makes the folders of an empty map. An older map in the same place is removed; anything else is left alone.
pub(super) fn prepare(folder: &Path) -> Result<(), StoreError> {
    let create = |path: &Path| fs::create_dir_all(path).map_err(|e| StoreError::write("creating", path, e));
    create(folder)?;
    let is_map = folder.join(MANIFEST).exists();
    let mut entries = fs::read_dir(folder).map_err(|e| StoreError::read("listing", folder, e))?;
    if !is_map && entries.next().is_some() {
        return Err(StoreError::Occupied { path: folder.to_owned() });
    }
    for name in [KEYFRAMES, ALIGNMENT, PLACES, MANIFEST] {
        let path = folder.join(name);
        if path.exists() {
            fs::remove_file(&path).map_err(|e| StoreError::write("removing the old", &path, e))?;
        }
    }
    for name in [PAGES, CHUNKS, IMAGES] {
        let path = folder.join(name);
        if path.exists() {
            fs::remove_dir_all(&path).map_err(|e| StoreError::write("removing the old", &path, e))?;
        }
        create(&path)?;
    }
    Ok(())
}

/// Removes what an interrupted run left half-written, and gives the keyframe log back its last whole record.
pub(super) fn mend(folder: &Path, record_bytes: u64) -> Result<(), StoreError> {
    for place in [folder.to_owned(), folder.join(PAGES), folder.join(CHUNKS)] {
        let entries = fs::read_dir(&place).map_err(|e| StoreError::read("listing", &place, e))?;
        for path in entries.flatten().map(|entry| entry.path()) {
            if path.extension().is_some_and(|extension| extension == TEMPORARY) {
                fs::remove_file(&path).map_err(|e| StoreError::write("removing the unfinished", &path, e))?;
            }
        }
    }
    let path = folder.join(KEYFRAMES);
    let failed = |e| StoreError::write("mending", &path, e);
    let log = File::options().write(true).open(&path).map_err(failed)?;
    let length = log.metadata().map_err(failed)?.len();
    log.set_len(length - length % record_bytes).map_err(failed)
}

/// Replaces `path` by `bytes`: written beside it, brought to the disk, then renamed over it.
pub(super) fn replace_file(path: &Path, bytes: &[u8]) -> Result<(), StoreError> {
    let temporary = path.with_extension(TEMPORARY);
    let written = File::create(&temporary).and_then(|mut file| {
        file.write_all(bytes)?;
        file.sync_data()
    });
    if let Err(source) = written {
        // A half-written file is of no use, and on a full disk its space is.
        let _ = fs::remove_file(&temporary);
        return Err(StoreError::write("writing", &temporary, source));
    }
    fs::rename(&temporary, path).map_err(|e| StoreError::write("replacing", path, e))
}

/// Brings the names in `folder` to the disk.
pub(super) fn sync_folder(folder: &Path) -> Result<(), StoreError> {
    File::open(folder).and_then(|handle| handle.sync_all()).map_err(|e| StoreError::write("syncing", folder, e))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_foreign_folder_is_left_alone_and_an_old_map_is_replaced() {
        let scratch = tempfile::tempdir().expect("a scratch folder");
        let photo = scratch.path().join("holiday.jpg");
        fs::write(&photo, b"mine").expect("written");
        assert!(matches!(prepare(scratch.path()), Err(StoreError::Occupied { .. })));
        assert!(photo.exists());

        let map = scratch.path().join("map");
        prepare(&map).expect("an empty place");
        fs::write(map.join(MANIFEST), b"old").expect("written");
        fs::write(page_path(&map, 3), b"old").expect("written");
        prepare(&map).expect("an old map");
        assert!(!map.join(MANIFEST).exists() && !page_path(&map, 3).exists());
    }

    #[test]
    fn a_replacement_leaves_no_temporary_file() {
        let scratch = tempfile::tempdir().expect("a scratch folder");
        let path = scratch.path().join("a.kgs");
        for content in [b"one".as_slice(), b"three"] {
            replace_file(&path, content).expect("written");
            assert_eq!(fs::read(&path).expect("read"), content);
        }
        assert_eq!(fs::read_dir(scratch.path()).expect("listed").count(), 1);
    }
}
