//! Where pages go when they leave memory.

use crate::map_store::{MapStoreWriter, PageDraft, WriteRefusal};
use kilogs_core::store::{ChunkBackground, ChunkLabel, DecoderParams, PageLabel};

/// Takes pages and chunks of the map; bounded, and allowed to be busy.
pub trait PageSink {
    /// Begins a page.
    ///
    /// # Errors
    /// [`WriteRefusal`]; the mapper keeps the anchors and comes again.
    fn begin_page(&mut self, label: PageLabel) -> Result<PageDraft, WriteRefusal>;

    /// Takes a page that was begun.
    ///
    /// # Errors
    /// [`WriteRefusal::Stopped`]; the mapper keeps the anchors.
    fn commit_page(&mut self, draft: PageDraft) -> Result<(), WriteRefusal>;

    /// Takes a chunk's decoder and background.
    ///
    /// # Errors
    /// [`WriteRefusal`]; the mapper comes again.
    fn write_chunk(
        &mut self,
        label: ChunkLabel,
        decoder: DecoderParams<'_>,
        background: ChunkBackground<'_>,
    ) -> Result<(), WriteRefusal>;
}

impl PageSink for &MapStoreWriter {
    fn begin_page(&mut self, label: PageLabel) -> Result<PageDraft, WriteRefusal> {
        MapStoreWriter::begin_page(self, label)
    }

    fn commit_page(&mut self, draft: PageDraft) -> Result<(), WriteRefusal> {
        MapStoreWriter::commit_page(self, draft)
    }

    fn write_chunk(
        &mut self,
        label: ChunkLabel,
        decoder: DecoderParams<'_>,
        background: ChunkBackground<'_>,
    ) -> Result<(), WriteRefusal> {
        MapStoreWriter::write_chunk(self, &label, decoder, background)
    }
}
