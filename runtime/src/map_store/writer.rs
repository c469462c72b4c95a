//! Writing a map while the vehicle drives.

use super::queue::{Buffer, Job, Pool, Queue, Unavailable};
use super::worker::Worker;
use super::{MapStoreReader, ReadFile, StoreBytes, StoreError, StoredFile, jpeg, layout, scan};
use kilogs_core::store::{
    ChunkBackground, ChunkLabel, DecoderParams, KEYFRAME_RECORD_BYTES, Manifest, MapCounts, PageEncoder, PageFull,
    PageLabel, StoredKeyframe, encode_chunk, encode_manifest, page_file_bytes,
};
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::thread::JoinHandle;

/// JPEG quality of stored images. At 80 they are a quarter to a third smaller than at 90 and lie 42 to 45 dB from KITTI's, whose
/// difference is a hundredth of what a refined map leaves over.
pub const DEFAULT_JPEG_QUALITY: u8 = 80;

/// Fixed memory of a store that is being written; every element is allocated at the start.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StoreCapacity {
    /// Bytes of one page (or chunk) buffer: bounds the anchors of a page.
    pub page_bytes: usize,
    /// Page buffers: those being filled and those waiting for the disk.
    pub page_buffers: usize,
    /// Image buffers, each one frame as the camera delivers it.
    pub image_buffers: usize,
    /// Buffers of the size of a page for files that are read back; none for who only writes.
    pub read_buffers: usize,
}

/// What happens when everything is waiting for the disk.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WhenBusy {
    /// The caller waits: lock-step, where the same input must give the same store.
    Wait,
    /// The caller is refused, keeps what it has and comes again: live.
    Refuse,
}

/// How a map is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StoreSettings {
    /// Fixed memory.
    pub capacity: StoreCapacity,
    /// JPEG quality of the stored images, 1 to 100.
    pub jpeg_quality: u8,
    /// What happens when everything is waiting for the disk.
    pub when_busy: WhenBusy,
}

/// Pixels of a camera image in the manifest's size and format.
#[derive(Debug, Clone, Copy)]
pub struct StoreImage<'a> {
    /// Rows of pixels.
    pub pixels: &'a [u8],
    /// Bytes between the starts of two rows.
    pub stride_bytes: usize,
}

/// A page that is being filled; give it back with [`MapStoreWriter::commit_page`] or
/// [`MapStoreWriter::abandon_page`], otherwise its buffer is lost to the store.
pub type PageDraft = PageEncoder<Box<[u8]>>;

/// Nothing was taken; what was handed over is unchanged.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum WriteRefusal {
    /// Everything is waiting for the disk ([`WhenBusy::Refuse`] only): keep it and come again, or leave it out.
    #[error("the map store is waiting for the disk")]
    Busy,
    /// Writing has failed: end the run, [`MapStoreWriter::finish`] says why.
    #[error("the map store cannot write any more")]
    Stopped,
    /// Larger than the buffers or not of the manifest's size: a defect of the caller or of the budget.
    #[error("what was handed to the map store does not fit its buffers")]
    TooLarge,
}

impl From<Unavailable> for WriteRefusal {
    fn from(unavailable: Unavailable) -> Self {
        match unavailable {
            Unavailable::Busy => Self::Busy,
            Unavailable::Stopped => Self::Stopped,
        }
    }
}

impl From<PageFull> for WriteRefusal {
    fn from(_: PageFull) -> Self {
        Self::TooLarge
    }
}

/// What a finished map holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StoreSummary {
    /// Contents.
    pub counts: MapCounts,
    /// Sizes.
    pub bytes: StoreBytes,
}

/// Writes a map through a thread of its own. Calls copy into preallocated buffers and allocate nothing; only
/// [`flush`](Self::flush) and [`finish`](Self::finish) touch the disk in the caller's thread.
///
/// A process that is killed leaves a store that opens with every page that was complete.
#[derive(Debug)]
pub struct MapStoreWriter {
    queue: Arc<Queue>,
    thread: Option<JoinHandle<()>>,
    folder: PathBuf,
    manifest: Manifest,
    when_busy: WhenBusy,
    row_bytes: usize,
}

impl MapStoreWriter {
    /// Begins a map in `folder`, replacing an older map there; the manifest's counts are ignored.
    ///
    /// # Errors
    /// [`StoreError`] when the folder holds something else or cannot be written, or when the settings do not fit.
    pub fn create(folder: &Path, manifest: &Manifest, settings: &StoreSettings) -> Result<Self, StoreError> {
        let row_bytes = check_settings(manifest, settings)?;
        layout::prepare(folder)?;
        let manifest = Manifest { counts: None, ..*manifest };
        let manifest_bytes = encode_manifest(&manifest);
        layout::replace_file(&folder.join(layout::MANIFEST), &manifest_bytes)?;
        let log_path = folder.join(layout::KEYFRAMES);
        let keyframe_log = File::create(&log_path).map_err(|e| StoreError::write("creating", &log_path, e))?;
        let parts = (folder.to_owned(), manifest, keyframe_log);
        Self::start(parts, settings, row_bytes, manifest_bytes.len() as u64)
    }

    /// Goes on writing `map`, also one whose writing was interrupted; what the manifest counts is counted again in the end.
    ///
    /// # Errors
    /// [`StoreError::OtherMap`] when the map is not of this camera and shape, else as [`create`](Self::create).
    pub fn resume(map: &MapStoreReader, manifest: &Manifest, settings: &StoreSettings) -> Result<Self, StoreError> {
        let row_bytes = check_settings(manifest, settings)?;
        let folder = map.folder();
        if let Some(what) = difference(map.manifest(), manifest) {
            return Err(StoreError::OtherMap { path: folder.to_owned(), what });
        }
        layout::mend(folder, KEYFRAME_RECORD_BYTES as u64)?;
        let manifest = Manifest { counts: None, ..*map.manifest() };
        layout::replace_file(&folder.join(layout::MANIFEST), &encode_manifest(&manifest))?;
        let log_path = folder.join(layout::KEYFRAMES);
        let keyframe_log = File::options().append(true).open(&log_path);
        let keyframe_log = keyframe_log.map_err(|e| StoreError::write("opening", &log_path, e))?;
        let store_bytes = scan::bytes(folder)?.store_bytes;
        Self::start((folder.to_owned(), manifest, keyframe_log), settings, row_bytes, store_bytes)
    }

    fn start(
        (folder, manifest, keyframe_log): (PathBuf, Manifest, File),
        settings: &StoreSettings,
        row_bytes: usize,
        store_bytes: u64,
    ) -> Result<Self, StoreError> {
        let image_bytes = row_bytes * manifest.camera.height as usize;
        let capacity = &settings.capacity;
        // Buffers bound pages and images; keyframes without an image share the room that is left.
        let views = capacity.image_buffers + capacity.image_buffers.max(1);
        let jobs = capacity.page_buffers + views + capacity.read_buffers;
        let [pages, reads] = [capacity.page_buffers, capacity.read_buffers].map(|n| (n, capacity.page_bytes));
        let queue = Arc::new(Queue::new(jobs, pages, (capacity.image_buffers, image_bytes), reads));
        queue.count_bytes(store_bytes, 0);
        let worker = Worker {
            folder: folder.clone(),
            keyframe_log,
            image_size: (manifest.camera.width, manifest.camera.height),
            pixel_format: manifest.pixel_format,
            jpeg_quality: settings.jpeg_quality,
            jpeg: Vec::with_capacity(image_bytes),
        };
        let thread_queue = Arc::clone(&queue);
        let thread = std::thread::Builder::new()
            .name("map-store".to_owned())
            .spawn(move || worker.run(&thread_queue))
            .map_err(|_| StoreError::Thread { what: "could not be started" })?;
        Ok(Self { queue, thread: Some(thread), folder, manifest, when_busy: settings.when_busy, row_bytes })
    }

    /// Bytes of all files of the store so far.
    pub fn bytes_on_disk(&self) -> u64 {
        self.queue.bytes_on_disk()
    }

    /// The most page buffers, image buffers and buffers of files that were ever in use at once.
    pub fn most_buffers(&self) -> [usize; 3] {
        [Pool::Pages, Pool::Images, Pool::Reads].map(|pool| self.queue.most_taken(pool))
    }

    /// An empty page to be filled with [`PageEncoder::push`]. A page that is full is committed and another one
    /// begun; several pages may cover the same keyframes. Writing an id again replaces that page.
    ///
    /// # Errors
    /// [`WriteRefusal`]; a page is never dropped, so the caller keeps its anchors until a later call succeeds.
    pub fn begin_page(&self, label: PageLabel) -> Result<PageDraft, WriteRefusal> {
        let memory = self.queue.take_buffer(Pool::Pages, self.waits())?;
        let label = PageLabel { gaussians_per_anchor: self.manifest.gaussians_per_anchor, ..label };
        PageEncoder::new(memory, label).map_err(WriteRefusal::from)
    }

    /// Hands a filled page to the writing thread.
    ///
    /// # Errors
    /// [`WriteRefusal::Stopped`]; a page that was begun is never refused as busy.
    pub fn commit_page(&self, draft: PageDraft) -> Result<(), WriteRefusal> {
        let page_id = draft.label().page_id;
        let (memory, n_bytes) = draft.finish()?;
        // Page buffers are fewer than places in the queue, so this waits for keyframes at most.
        self.push(Job::Page { page_id, memory, n_bytes }, true)
    }

    /// Gives a begun page back unwritten.
    pub fn abandon_page(&self, draft: PageDraft) {
        self.queue.return_buffer(Pool::Pages, draft.abandon());
    }

    /// Writes or replaces a chunk.
    ///
    /// # Errors
    /// [`WriteRefusal`]; a chunk is never dropped, the caller comes again.
    pub fn write_chunk(
        &self,
        label: &ChunkLabel,
        decoder: DecoderParams<'_>,
        background: ChunkBackground<'_>,
    ) -> Result<(), WriteRefusal> {
        let mut memory = self.queue.take_buffer(Pool::Pages, self.waits())?;
        let Some(n_bytes) = encode_chunk(label, decoder, background, &mut memory) else {
            self.queue.return_buffer(Pool::Pages, memory);
            return Err(WriteRefusal::TooLarge);
        };
        self.push(Job::Chunk { chunk_id: label.chunk_id, memory, n_bytes }, true)
    }

    /// Stores a new keyframe or held-out view with its image; length and checksum of the image are filled in.
    ///
    /// # Errors
    /// [`WriteRefusal`]; when busy, store it with [`place_keyframe`](Self::place_keyframe) and count the image.
    pub fn write_keyframe(&self, keyframe: &StoredKeyframe, image: StoreImage<'_>) -> Result<(), WriteRefusal> {
        let mut buffer = self.queue.take_buffer(Pool::Images, self.waits())?;
        if !copy_rows(image, self.row_bytes, &mut buffer) {
            self.queue.return_buffer(Pool::Images, buffer);
            return Err(WriteRefusal::TooLarge);
        }
        self.push(Job::Keyframe { keyframe: without_image(keyframe), pixels: Some(buffer) }, true)
    }

    /// Says where a keyframe or held-out view is (again); an image that was stored with it stays.
    ///
    /// # Errors
    /// [`WriteRefusal`]; when busy, come again.
    pub fn place_keyframe(&self, keyframe: &StoredKeyframe) -> Result<(), WriteRefusal> {
        self.push(Job::Keyframe { keyframe: without_image(keyframe), pixels: None }, self.waits())
    }

    /// Files that can be asked for now.
    pub fn n_free_reads(&self) -> usize {
        self.queue.n_free(Pool::Reads)
    }

    /// Asks for a file; it comes with [`next_read`](Self::next_read), after everything that was handed over before.
    ///
    /// # Errors
    /// [`WriteRefusal`]; busy means that as many files are on their way as there are buffers.
    pub fn request(&self, file: StoredFile) -> Result<(), WriteRefusal> {
        let memory = self.queue.take_buffer(Pool::Reads, false)?;
        self.push(Job::Read { file, memory }, true)
    }

    /// The next file, in the order of the requests; give it back with [`give_back`](Self::give_back).
    ///
    /// In lock-step a file comes when it `is_due`, never earlier and never later. Live it comes when it was read.
    pub fn next_read(&self, is_due: bool) -> Option<ReadFile> {
        if self.waits() && !is_due { None } else { self.queue.next_read(self.waits()) }
    }

    /// Gives the memory of a file back.
    pub fn give_back(&self, read: ReadFile) {
        self.queue.return_buffer(Pool::Reads, read.memory);
    }

    /// Waits until everything handed over is on disk.
    ///
    /// # Errors
    /// [`WriteRefusal::Stopped`].
    pub fn flush(&self) -> Result<(), WriteRefusal> {
        self.queue.wait_until_idle().map_err(WriteRefusal::from)
    }

    /// Writes what is left, then the manifest with the counts of what is really there.
    ///
    /// # Errors
    /// The [`StoreError`] that stopped writing, at any time since the beginning.
    pub fn finish(mut self) -> Result<StoreSummary, StoreError> {
        let panicked = self.end_thread();
        if let Some(failure) = self.queue.take_failure() {
            return Err(failure);
        }
        if panicked {
            return Err(StoreError::Thread { what: "ended unexpectedly" });
        }
        for name in [layout::KEYFRAMES, layout::PAGES, layout::CHUNKS, layout::IMAGES] {
            layout::sync_folder(&self.folder.join(name))?;
        }
        let found = scan::scan(&self.folder)?;
        let manifest = Manifest { counts: Some(found.counts()), ..self.manifest };
        layout::replace_file(&self.folder.join(layout::MANIFEST), &encode_manifest(&manifest))?;
        layout::sync_folder(&self.folder)?;
        Ok(StoreSummary { counts: found.counts(), bytes: scan::bytes(&self.folder)? })
    }

    fn waits(&self) -> bool {
        self.when_busy == WhenBusy::Wait
    }

    fn push(&self, job: Job, wait: bool) -> Result<(), WriteRefusal> {
        self.queue.push(job, wait).map_err(WriteRefusal::from)
    }

    /// Whether the thread panicked.
    fn end_thread(&mut self) -> bool {
        self.queue.close();
        self.thread.take().is_some_and(|thread| thread.join().is_err())
    }
}

impl Drop for MapStoreWriter {
    /// Completes what was handed over; the manifest stays without counts, as after a crash.
    fn drop(&mut self) {
        self.end_thread();
    }
}

/// Length and checksum of an image are known only to the writing thread.
fn without_image(keyframe: &StoredKeyframe) -> StoredKeyframe {
    StoredKeyframe { image_bytes: 0, image_crc: 0, ..*keyframe }
}

/// Bytes of one packed image row, once the settings are found to fit each other.
fn check_settings(manifest: &Manifest, settings: &StoreSettings) -> Result<usize, StoreError> {
    let refuse = |reason: String| Err(StoreError::Settings { reason });
    let Some(bytes_per_pixel) = jpeg::bytes_per_pixel(manifest.pixel_format) else {
        let format = manifest.pixel_format;
        return refuse(format!("images of format {format:?} cannot be stored; convert them to Rgb8 or Mono8 before"));
    };
    if !(1..=100).contains(&settings.jpeg_quality) {
        return refuse(format!("JPEG quality {} is not within 1 to 100", settings.jpeg_quality));
    }
    let StoreCapacity { page_bytes, page_buffers, image_buffers, .. } = settings.capacity;
    let needed = page_file_bytes(1, manifest.gaussians_per_anchor as usize, true);
    if page_bytes < needed {
        return refuse(format!("a page buffer of {page_bytes} bytes does not hold one anchor ({needed} bytes)"));
    }
    if page_buffers == 0 || image_buffers == 0 {
        return refuse("the budget leaves no page buffer or no image buffer; give at least 1 of each".to_owned());
    }
    Ok(manifest.camera.width as usize * bytes_per_pixel)
}

/// What keeps keyframes of one map from going on in another.
fn difference(map: &Manifest, run: &Manifest) -> Option<&'static str> {
    let rows = [
        (map.camera == run.camera, "camera"),
        (map.pixel_format == run.pixel_format, "pixel format"),
        (map.voxel_m == run.voxel_m && map.n_levels == run.n_levels, "voxel grid"),
        (map.gaussians_per_anchor == run.gaussians_per_anchor, "number of Gaussians per anchor"),
    ];
    rows.into_iter().find(|(is_same, _)| !is_same).map(|(_, what)| what)
}

/// Packs the rows; false when they are not what the buffer was made for.
fn copy_rows(image: StoreImage<'_>, row_bytes: usize, packed: &mut Buffer) -> bool {
    let mut rows = image.pixels.chunks(image.stride_bytes.max(1));
    packed.chunks_exact_mut(row_bytes).all(|packed_row| match rows.next().and_then(|row| row.get(..row_bytes)) {
        Some(row) => {
            packed_row.copy_from_slice(row);
            true
        }
        None => false,
    })
}
