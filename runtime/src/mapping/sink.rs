//! Where pages go when they leave memory, and where they come from when the vehicle is there again.

use crate::map_store::{MapStoreWriter, PageDraft, ReadFile, StoredFile, WriteRefusal};
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

/// Gives back what a sink took; bounded, and in the order of the requests.
pub trait PageSource {
    /// Files that can be asked for now.
    fn n_free(&self) -> usize;

    /// Asks for a file.
    ///
    /// # Errors
    /// [`WriteRefusal`]; the mapper does without.
    fn request(&mut self, file: StoredFile) -> Result<(), WriteRefusal>;

    /// The next file that was asked for. In lock-step it comes when it `is_due`, live when it is there.
    fn next(&mut self, is_due: bool) -> Option<ReadFile>;

    /// Takes the memory of a file back.
    fn give_back(&mut self, read: ReadFile);
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

impl PageSource for &MapStoreWriter {
    fn n_free(&self) -> usize {
        self.n_free_reads()
    }

    fn request(&mut self, file: StoredFile) -> Result<(), WriteRefusal> {
        MapStoreWriter::request(self, file)
    }

    fn next(&mut self, is_due: bool) -> Option<ReadFile> {
        self.next_read(is_due)
    }

    fn give_back(&mut self, read: ReadFile) {
        MapStoreWriter::give_back(self, read);
    }
}
