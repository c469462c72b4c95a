//! Reading a map, whole or not.

use super::scan::{self, Found};
use super::{Damage, DamageKind, StoreError, jpeg, layout};
use kilogs_core::store::{
    ChunkLabel, ChunkView, Manifest, MapCounts, PageLabel, PageReader, StoredKeyframe, decode_chunk, decode_manifest,
    decode_page,
};
use nalgebra::Vector3;
use std::collections::BTreeMap;
use std::io::Read;
use std::path::{Path, PathBuf};

/// Sizes of a map on disk.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StoreBytes {
    /// Pages and chunks: what rendering needs.
    pub map_bytes: u64,
    /// Everything, with the images.
    pub store_bytes: u64,
}

/// A map that was opened: tables in memory, pages, chunks and images on disk until they are asked for.
///
/// Costs about 110 bytes per keyframe or held-out view and 40 per page; the budget bounds the former.
#[derive(Debug)]
pub struct MapStoreReader {
    folder: PathBuf,
    manifest: Manifest,
    keyframes: Vec<StoredKeyframe>,
    held_out: Vec<StoredKeyframe>,
    pages: Vec<PageLabel>,
    chunks: BTreeMap<u32, ChunkLabel>,
    learned_decoder: bool,
    damages: Vec<Damage>,
}

impl MapStoreReader {
    /// Opens the map in `folder`; at most `max_keyframes` keyframes and held-out views are admitted.
    ///
    /// What is damaged is left out and listed in [`damages`](Self::damages).
    ///
    /// # Errors
    /// [`StoreError`] when there is no map, its manifest is damaged, or it is larger than the budget.
    pub fn open(folder: &Path, max_keyframes: usize) -> Result<Self, StoreError> {
        let path = folder.join(layout::MANIFEST);
        let bytes = std::fs::read(&path).map_err(|e| StoreError::read("opening", &path, e))?;
        let manifest = decode_manifest(&bytes).map_err(|problem| StoreError::Damaged { path, problem })?;
        let found = scan::scan(folder)?;
        if found.keyframes.len() > max_keyframes {
            return Err(StoreError::OverBudget {
                path: folder.to_owned(),
                what: "keyframes",
                found: found.keyframes.len(),
                capacity: max_keyframes,
                row: "[store.keyframe_table] in memory_budget.toml",
            });
        }
        Ok(Self::from_found(folder, manifest, found))
    }

    fn from_found(folder: &Path, manifest: Manifest, found: Found) -> Self {
        let counts = found.counts();
        let Found { keyframes, pages, chunks, learned_decoder, mut damages } = found;
        let mut held_out = Vec::with_capacity(usize::try_from(counts.held_out).unwrap_or(0));
        let mut mapping = Vec::with_capacity(keyframes.len() - held_out.capacity());
        for view in keyframes.into_values() {
            if view.is_held_out { held_out.push(view) } else { mapping.push(view) }
        }
        let mut keyframes: Vec<StoredKeyframe> = mapping;
        keyframes.sort_by_key(|keyframe| keyframe.keyframe_id);
        let mut reader = Self {
            folder: folder.to_owned(),
            manifest,
            keyframes,
            held_out,
            pages: Vec::new(),
            chunks,
            learned_decoder,
            damages: vec![],
        };
        for page in pages.into_values() {
            reader.pages.push(page);
        }
        if let Some(expected) = &manifest.counts {
            damages.extend(missing_files(expected, &counts));
        }
        reader.damages = damages;
        reader
    }

    /// Folder of the map.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Camera, capacity and counts. Counts are `None` when writing was interrupted.
    pub fn manifest(&self) -> &Manifest {
        &self.manifest
    }

    /// What was left out because it is damaged.
    pub fn damages(&self) -> &[Damage] {
        &self.damages
    }

    /// Mapping keyframes by id.
    pub fn keyframes(&self) -> &[StoredKeyframe] {
        &self.keyframes
    }

    /// Held-out views by frame.
    pub fn held_out(&self) -> &[StoredKeyframe] {
        &self.held_out
    }

    /// Keyframe with this id.
    pub fn keyframe(&self, keyframe_id: u32) -> Option<&StoredKeyframe> {
        let idx = self.keyframes.binary_search_by_key(&keyframe_id, |keyframe| keyframe.keyframe_id).ok()?;
        self.keyframes.get(idx)
    }

    /// Pages by id.
    pub fn pages(&self) -> &[PageLabel] {
        &self.pages
    }

    /// Chunks by id.
    pub fn chunks(&self) -> impl Iterator<Item = &ChunkLabel> {
        self.chunks.values()
    }

    /// Whether some chunk has a learned decoder: the backend that shows the map needs one then.
    pub fn has_learned_decoder(&self) -> bool {
        self.learned_decoder
    }

    /// Distance from a place in the map to the nearest keyframe of a page, m; infinite when all are lost.
    pub fn page_distance_m(&self, page: &PageLabel, position_in_map_m: &Vector3<f64>) -> f64 {
        let first = self.keyframes.partition_point(|keyframe| keyframe.keyframe_id < page.first_keyframe_id);
        let own =
            self.keyframes.iter().skip(first).take_while(|keyframe| keyframe.keyframe_id <= page.last_keyframe_id);
        own.map(|keyframe| (Vector3::from(keyframe.translation_m) - position_in_map_m).norm())
            .fold(f64::INFINITY, f64::min)
    }

    /// Pages with a keyframe within `radius_m` of a place in the map, by id.
    pub fn pages_near<'a>(
        &'a self,
        position_in_map_m: &'a Vector3<f64>,
        radius_m: f64,
    ) -> impl Iterator<Item = &'a PageLabel> {
        self.pages.iter().filter(move |page| self.page_distance_m(page, position_in_map_m) <= radius_m)
    }

    /// Reads and verifies a page; `buffer` is reused and grows to the largest page once.
    ///
    /// # Errors
    /// [`StoreError`] when it is not there or damaged: leave it out and report it.
    pub fn read_page<'b>(
        &self,
        page_id: u32,
        buffer: &'b mut Vec<u8>,
    ) -> Result<(PageLabel, PageReader<'b>), StoreError> {
        let path = layout::page_path(&self.folder, page_id);
        read_into(&path, buffer)?;
        decode_page(buffer).map_err(|problem| StoreError::Damaged { path, problem })
    }

    /// Reads and verifies a chunk; `buffer` is reused.
    ///
    /// # Errors
    /// [`StoreError`] when it is not there or damaged.
    pub fn read_chunk<'b>(&self, chunk_id: u32, buffer: &'b mut Vec<u8>) -> Result<ChunkView<'b>, StoreError> {
        let path = layout::chunk_path(&self.folder, chunk_id);
        read_into(&path, buffer)?;
        decode_chunk(buffer).map_err(|problem| StoreError::Damaged { path, problem })
    }

    /// The camera image of a keyframe or held-out view.
    ///
    /// # Errors
    /// [`StoreError`] when it was not stored, is gone or damaged.
    pub fn read_image(&self, keyframe: &StoredKeyframe) -> Result<image::RgbImage, StoreError> {
        let path = layout::image_path(&self.folder, keyframe.frame_index);
        jpeg::read_rgb(&path, keyframe.image_bytes, keyframe.image_crc)
    }

    /// Sizes on disk.
    ///
    /// # Errors
    /// [`StoreError`] when the folder cannot be listed.
    pub fn bytes(&self) -> Result<StoreBytes, StoreError> {
        scan::bytes(&self.folder)
    }
}

fn missing_files(expected: &MapCounts, found: &MapCounts) -> Vec<Damage> {
    let rows = [
        (layout::KEYFRAMES, expected.keyframes + expected.held_out, found.keyframes + found.held_out),
        (layout::PAGES, expected.pages, found.pages),
        (layout::CHUNKS, expected.chunks, found.chunks),
    ];
    let lost = rows.into_iter().filter(|(_, expected, found)| found < expected);
    lost.map(|(name, expected, found)| Damage {
        file: PathBuf::from(name),
        kind: DamageKind::FilesMissing { n_missing: expected - found },
    })
    .collect()
}

fn read_into(path: &Path, buffer: &mut Vec<u8>) -> Result<(), StoreError> {
    buffer.clear();
    let read = std::fs::File::open(path).and_then(|mut file| file.read_to_end(buffer));
    read.map(|_| ()).map_err(|e| StoreError::read("opening", path, e))
}
