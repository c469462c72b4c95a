//! Replacing parts of a map that is complete.

use super::{MapStoreReader, StoreError, StoreSummary, layout, scan};
use kilogs_core::store::{
    ChunkBackground, ChunkLabel, DecoderParams, Manifest, MapCounts, PageEncoder, PageFull, PageLabel, encode_chunk,
    encode_manifest, page_anchors,
};
use std::path::PathBuf;

/// Replaces pages and chunks one by one, each as a whole: whatever ends the process, every file of the map is the old or
/// the new one.
///
/// Memory: the largest page or chunk.
#[derive(Debug)]
pub struct MapStoreEditor {
    folder: PathBuf,
    manifest: Manifest,
    memory: Box<[u8]>,
}

impl MapStoreEditor {
    /// Begins to edit `map` with room for pages and chunks of `page_bytes`. Writes the manifest as it is, so that a folder
    /// that cannot be written is known at once.
    ///
    /// # Errors
    /// [`StoreError::Write`] when it cannot.
    pub fn open(map: &MapStoreReader, page_bytes: usize) -> Result<Self, StoreError> {
        let (folder, manifest) = (map.folder().to_owned(), *map.manifest());
        layout::replace_file(&folder.join(layout::MANIFEST), &encode_manifest(&manifest))?;
        Ok(Self { folder, manifest, memory: vec![0; page_bytes].into() })
    }

    /// Like [`open`](Self::open), to replace pages with all that their anchors can come to have.
    ///
    /// # Errors
    /// [`StoreError::OverBudget`] when a page has more anchors than the memory is for; like [`open`](Self::open) else.
    pub fn open_for_pages(map: &MapStoreReader, page_bytes: usize) -> Result<Self, StoreError> {
        let capacity = page_anchors(page_bytes, map.manifest().gaussians_per_anchor as usize);
        match map.pages().iter().max_by_key(|page| page.n_anchors) {
            Some(page) if page.n_anchors as usize > capacity => {
                let path = layout::page_path(map.folder(), page.page_id);
                Err(over_budget(path, ("anchors", page.n_anchors as usize), capacity))
            }
            _ => Self::open(map, page_bytes),
        }
    }

    /// Replaces or adds the page of `label`'s id by what `fill` pushes; its label as written.
    ///
    /// # Errors
    /// [`StoreError::OverBudget`] when it does not fit into the memory, [`StoreError::Write`]; the old page stays.
    pub fn replace_page(
        &mut self,
        label: PageLabel,
        fill: impl FnOnce(&mut PageEncoder<&mut [u8]>) -> Result<(), PageFull>,
    ) -> Result<PageLabel, StoreError> {
        let label = PageLabel { gaussians_per_anchor: self.manifest.gaussians_per_anchor, ..label };
        let path = layout::page_path(&self.folder, label.page_id);
        let encoded = PageEncoder::new(&mut *self.memory, label).and_then(|mut page| {
            fill(&mut page)?;
            let written = page.label();
            page.finish().map(|(memory, n_bytes)| (written, memory.get(..n_bytes).unwrap_or_default()))
        });
        match encoded {
            Ok((written, bytes)) => layout::replace_file(&path, bytes).map(|()| written),
            Err(full) => {
                let capacity = full.capacity_bytes as usize;
                Err(over_budget(path, ("bytes or more", capacity + 1), capacity))
            }
        }
    }

    /// Replaces a chunk.
    ///
    /// # Errors
    /// Like [`replace_page`](Self::replace_page); the old chunk stays.
    pub fn replace_chunk(
        &mut self,
        label: &ChunkLabel,
        decoder: DecoderParams<'_>,
        background: ChunkBackground<'_>,
    ) -> Result<(), StoreError> {
        let path = layout::chunk_path(&self.folder, label.chunk_id);
        match encode_chunk(label, decoder, background, &mut self.memory) {
            Some(n_bytes) => layout::replace_file(&path, self.memory.get(..n_bytes).unwrap_or_default()),
            None => Err(over_budget(path, ("bytes or more", self.memory.len() + 1), self.memory.len())),
        }
    }

    /// Gives every chunk of `map` the decoder of the newest one.
    ///
    /// # Errors
    /// Like [`replace_page`](Self::replace_page), and when a chunk cannot be read; the others have it then.
    pub fn share_newest_decoder(&mut self, map: &MapStoreReader) -> Result<(), StoreError> {
        let (mut newest, mut file, mut texels) = (Vec::new(), Vec::new(), Vec::new());
        let Some(last) = map.chunks().last().map(|label| label.chunk_id) else { return Ok(()) };
        let newest = map.read_chunk(last, &mut newest)?;
        for label in map.chunks().filter(|label| label.chunk_id != last) {
            let chunk = map.read_chunk(label.chunk_id, &mut file)?;
            texels.resize(chunk.background_texels(), [0.0; 3]);
            chunk.read_background(&mut texels);
            let background = ChunkBackground { width: chunk.background_width, texels: &texels };
            let label = ChunkLabel { revision: label.revision.saturating_add(1), ..*label };
            self.replace_chunk(&label, newest.decoder, background)?;
        }
        Ok(())
    }

    /// Brings the names to the disk and counts anew. The counts of a map whose writing was interrupted stay unknown.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn finish(self) -> Result<StoreSummary, StoreError> {
        for name in [layout::PAGES, layout::CHUNKS] {
            layout::sync_folder(&self.folder.join(name))?;
        }
        let counts = scan::scan(&self.folder)?.counts();
        // Files that were lost before stay missed.
        let kept = |old: MapCounts| MapCounts {
            keyframes: counts.keyframes.max(old.keyframes),
            held_out: counts.held_out.max(old.held_out),
            chunks: counts.chunks.max(old.chunks),
            pages: counts.pages.max(old.pages),
            ..counts
        };
        let manifest = Manifest { counts: self.manifest.counts.map(kept), ..self.manifest };
        layout::replace_file(&self.folder.join(layout::MANIFEST), &encode_manifest(&manifest))?;
        layout::sync_folder(&self.folder)?;
        Ok(StoreSummary { counts, bytes: scan::bytes(&self.folder)? })
    }
}

fn over_budget(path: PathBuf, (what, found): (&'static str, usize), capacity: usize) -> StoreError {
    let row = "[store.page_anchors] in memory_budget.toml";
    StoreError::OverBudget { path, what, found, capacity, row }
}

#[cfg(test)]
mod tests {
    use super::super::tests::{create, open, scratch};
    use super::*;

    /// Decoder and background of a chunk.
    fn chunk(map: &MapStoreReader, chunk_id: u32) -> (u32, Vec<u8>, Vec<[f32; 3]>) {
        let mut file = Vec::new();
        let view = map.read_chunk(chunk_id, &mut file).expect("a whole chunk");
        let mut texels = vec![[0.0; 3]; view.background_texels()];
        view.read_background(&mut texels);
        (view.decoder.kind, view.decoder.bytes.to_vec(), texels)
    }

    #[test]
    fn a_shared_decoder_is_the_newest_one_and_skies_stay() {
        let scratch = scratch();
        let store = create(scratch.path());
        for chunk_id in 0..3_u8 {
            let label = ChunkLabel { chunk_id: chunk_id.into(), ..ChunkLabel::default() };
            let decoder = DecoderParams { kind: 1, bytes: &[chunk_id; 8] };
            let background = ChunkBackground { width: 2, texels: &[[f32::from(chunk_id); 3]; 4] };
            store.write_chunk(&label, decoder, background).expect("taken");
        }
        store.finish().expect("written");
        let map = open(scratch.path());
        let mut editor = MapStoreEditor::open(&map, 4096).expect("writable");
        editor.share_newest_decoder(&map).expect("shared");
        editor.finish().expect("written");
        let map = open(scratch.path());
        for chunk_id in 0..3_u8 {
            assert_eq!(chunk(&map, chunk_id.into()), (1, vec![2; 8], vec![[f32::from(chunk_id); 3]; 4]));
        }
    }
}
