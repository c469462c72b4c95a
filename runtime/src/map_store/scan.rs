//! Finding out what a map's folder holds, without an index and whatever happened to it.

use super::{Alignment, Damage, DamageKind, StoreBytes, StoreError, layout};
use kilogs_core::store::{
    ChunkLabel, KEYFRAME_RECORD_BYTES, MapCounts, PAGE_HEADER_BYTES, PageLabel, RecordProblem, StoredKeyframe,
    decode_chunk, decode_keyframe, page_length,
};
use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};

/// Everything that is there and looks whole; bodies of pages and images are not read.
#[derive(Debug, Default)]
pub(super) struct Found {
    /// By frame index; keyframes and held-out views.
    pub(super) keyframes: BTreeMap<u64, StoredKeyframe>,
    /// By page id.
    pub(super) pages: BTreeMap<u32, PageLabel>,
    /// By chunk id.
    pub(super) chunks: BTreeMap<u32, ChunkLabel>,
    /// Some chunk has a learned decoder.
    pub(super) learned_decoder: bool,
    pub(super) damages: Vec<Damage>,
}

impl Found {
    pub(super) fn counts(&self) -> MapCounts {
        let held_out = self.keyframes.values().filter(|keyframe| keyframe.is_held_out).count() as u64;
        MapCounts {
            keyframes: self.keyframes.len() as u64 - held_out,
            held_out,
            images: self.keyframes.values().filter(|keyframe| keyframe.image_bytes > 0).count() as u64,
            chunks: self.chunks.len() as u64,
            pages: self.pages.len() as u64,
            anchors: self.pages.values().map(|label| u64::from(label.n_anchors)).sum(),
            gaussians: self.pages.values().map(|label| u64::from(label.n_gaussians)).sum(),
        }
    }

    fn damage(&mut self, file: impl Into<PathBuf>, kind: DamageKind) {
        self.damages.push(Damage { file: file.into(), kind });
    }
}

/// Lists a map.
///
/// # Errors
/// [`StoreError::Read`] when the folder itself cannot be read; damaged parts are in [`Found::damages`].
pub(super) fn scan(folder: &Path) -> Result<Found, StoreError> {
    let mut found = Found::default();
    scan_keyframes(folder, &mut found)?;
    align(folder, &mut found)?;
    for (page_id, path) in numbered_files(&folder.join(layout::PAGES))? {
        let file = relative(layout::PAGES, &path);
        match read_label(&path)? {
            Ok(label) if label.page_id == page_id => {
                found.pages.insert(page_id, label);
            }
            Ok(label) => found.damage(file, DamageKind::Misnamed { id: label.page_id }),
            Err(problem) => found.damage(file, DamageKind::Record { offset: 0, problem }),
        }
    }
    for (chunk_id, path) in numbered_files(&folder.join(layout::CHUNKS))? {
        let file = relative(layout::CHUNKS, &path);
        let bytes = fs::read(&path).map_err(|e| StoreError::read("opening", &path, e))?;
        match decode_chunk(&bytes).map(|chunk| (chunk.label, chunk.decoder.is_residual())) {
            Ok((label, is_learned)) if label.chunk_id == chunk_id => {
                found.chunks.insert(chunk_id, label);
                found.learned_decoder |= is_learned;
            }
            Ok((label, _)) => found.damage(file, DamageKind::Misnamed { id: label.chunk_id }),
            Err(problem) => found.damage(file, DamageKind::Record { offset: 0, problem }),
        }
    }
    Ok(found)
}

/// Reads the log record by record; a damaged one is stepped over, a later one of the same frame replaces it.
fn scan_keyframes(folder: &Path, found: &mut Found) -> Result<(), StoreError> {
    let path = folder.join(layout::KEYFRAMES);
    let failed = |e| StoreError::read("opening", &path, e);
    let mut log = BufReader::new(File::open(&path).map_err(failed)?);
    let mut record = [0; KEYFRAME_RECORD_BYTES];
    for offset in (0..).step_by(KEYFRAME_RECORD_BYTES) {
        let n_bytes = read_up_to(&mut log, &mut record).map_err(failed)?;
        if n_bytes == 0 {
            break;
        }
        match decode_keyframe(&record[..n_bytes]) {
            Ok(mut keyframe) => {
                if let Some(older) = found.keyframes.get(&keyframe.frame_index).filter(|_| keyframe.image_bytes == 0) {
                    keyframe.image_bytes = older.image_bytes;
                    keyframe.image_crc = older.image_crc;
                }
                found.keyframes.insert(keyframe.frame_index, keyframe);
            }
            Err(problem) => found.damage(layout::KEYFRAMES, DamageKind::Record { offset, problem }),
        }
    }
    Ok(())
}

/// Moves the keyframes to where loops have put them; without a readable alignment they stay where they were mapped.
fn align(folder: &Path, found: &mut Found) -> Result<(), StoreError> {
    match Alignment::read(folder)? {
        Ok(alignment) if alignment.is_empty() => {}
        Ok(alignment) => found.keyframes.values_mut().for_each(|view| alignment.apply(view)),
        Err(problem) => found.damage(layout::ALIGNMENT, DamageKind::Record { offset: 0, problem }),
    }
    Ok(())
}

/// Label of a page whose file has the length that the label asks for.
fn read_label(path: &Path) -> Result<Result<PageLabel, RecordProblem>, StoreError> {
    let failed = |e| StoreError::read("opening", path, e);
    let mut file = File::open(path).map_err(failed)?;
    let mut header = [0; PAGE_HEADER_BYTES];
    let n_bytes = read_up_to(&mut file, &mut header).map_err(failed)?;
    let page = page_length(&header[..n_bytes]);
    let length = file.metadata().map_err(failed)?.len();
    Ok(page.and_then(|(label, needed)| {
        let needed = needed as u64;
        if length < needed {
            let saturate = |bytes: u64| u32::try_from(bytes).unwrap_or(u32::MAX);
            return Err(RecordProblem::Truncated { found: saturate(length), needed: saturate(needed) });
        }
        Ok(label)
    }))
}

/// Fills as much of `buffer` as there is.
fn read_up_to(source: &mut impl Read, buffer: &mut [u8]) -> std::io::Result<usize> {
    let mut n_bytes = 0;
    while n_bytes < buffer.len() {
        match source.read(&mut buffer[n_bytes..]) {
            Ok(0) => break,
            Ok(more) => n_bytes += more,
            Err(e) if e.kind() == std::io::ErrorKind::Interrupted => {}
            Err(e) => return Err(e),
        }
    }
    Ok(n_bytes)
}

/// Finished files of a folder by their number; temporary ones of an interrupted run are not among them.
fn numbered_files(folder: &Path) -> Result<BTreeMap<u32, PathBuf>, StoreError> {
    let failed = |e| StoreError::read("listing", folder, e);
    let mut files = BTreeMap::new();
    for entry in fs::read_dir(folder).map_err(failed)? {
        let path = entry.map_err(failed)?.path();
        let is_finished = path.extension().is_some_and(|extension| extension == "kgs");
        let number = path.file_stem().and_then(|stem| stem.to_str()?.parse().ok());
        if let (true, Some(number)) = (is_finished, number) {
            files.insert(number, path);
        }
    }
    Ok(files)
}

fn relative(folder: &str, path: &Path) -> PathBuf {
    Path::new(folder).join(path.file_name().unwrap_or_default())
}

/// Sizes of the map's files.
pub(super) fn bytes(folder: &Path) -> Result<StoreBytes, StoreError> {
    let in_folder = |name: &str| -> Result<u64, StoreError> {
        let path = folder.join(name);
        let failed = |e| StoreError::read("listing", &path, e);
        let mut sum = 0;
        for entry in fs::read_dir(&path).map_err(failed)? {
            sum += entry.and_then(|entry| entry.metadata()).map_err(failed)?.len();
        }
        Ok(sum)
    };
    let of_file = |name: &str| {
        let path = folder.join(name);
        fs::metadata(&path).map(|data| data.len()).map_err(|e| StoreError::read("opening", &path, e))
    };
    let map_bytes = in_folder(layout::PAGES)? + in_folder(layout::CHUNKS)?;
    let optional = [folder.join(layout::ALIGNMENT), layout::places_path(folder)];
    let optional: u64 = optional.iter().map(|path| fs::metadata(path).map_or(0, |data| data.len())).sum();
    let rest = in_folder(layout::IMAGES)? + of_file(layout::KEYFRAMES)? + of_file(layout::MANIFEST)? + optional;
    Ok(StoreBytes { map_bytes, store_bytes: map_bytes + rest })
}
