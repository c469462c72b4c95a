//! The thread that owns the disk.

use super::queue::{Job, Pool, Queue};
use super::{ReadFile, StoreError, jpeg, layout, read_back};
use kilogs_core::frame::PixelFormat;
use kilogs_core::store::{StoredKeyframe, encode_keyframe};
use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};

/// What the writing thread owns.
pub(super) struct Worker {
    pub(super) folder: PathBuf,
    pub(super) keyframe_log: File,
    pub(super) image_size: (u32, u32),
    pub(super) pixel_format: PixelFormat,
    pub(super) jpeg_quality: u8,
    /// Encoded image; keeps its memory from one to the next.
    pub(super) jpeg: Vec<u8>,
}

impl Worker {
    /// Writes until the queue is closed or something cannot be written.
    pub(super) fn run(mut self, queue: &Queue) {
        // Whatever ends this thread, nobody may wait for it any longer.
        let _stop = StopWhenDropped(queue);
        while let Some(job) = queue.next_job() {
            if let Err(failure) = self.write(job, queue) {
                queue.stop(Some(failure));
                return;
            }
        }
    }

    fn write(&mut self, job: Job, queue: &Queue) -> Result<(), StoreError> {
        match job {
            Job::Page { page_id, memory, n_bytes } => {
                // A page without its keyframes is of no use: they reach the disk first.
                self.sync_log()?;
                let path = layout::page_path(&self.folder, page_id);
                let written = replace_counted(&path, memory.get(..n_bytes).unwrap_or_default(), queue);
                queue.return_buffer(Pool::Pages, memory);
                written
            }
            Job::Chunk { chunk_id, memory, n_bytes } => {
                let path = layout::chunk_path(&self.folder, chunk_id);
                let written = replace_counted(&path, memory.get(..n_bytes).unwrap_or_default(), queue);
                queue.return_buffer(Pool::Pages, memory);
                written
            }
            Job::Read { file, mut memory } => {
                // What cannot be read is missing where it was asked for, and the run goes on.
                let n_bytes = read_back::read_verified(&self.folder, file, &mut memory).unwrap_or_else(|problem| {
                    log::warn!("{problem}; the drive goes on without it");
                    0
                });
                queue.deliver(ReadFile { file, memory, n_bytes });
                Ok(())
            }
            Job::Keyframe { mut keyframe, pixels } => {
                if let Some(mut pixels) = pixels {
                    let written = self.write_image(&mut keyframe, &mut pixels, queue);
                    queue.return_buffer(Pool::Images, pixels);
                    written?;
                }
                let record = encode_keyframe(&keyframe);
                let path = self.folder.join(layout::KEYFRAMES);
                self.keyframe_log.write_all(&record).map_err(|e| StoreError::write("appending to", &path, e))?;
                queue.count_bytes(record.len() as u64, 0);
                Ok(())
            }
        }
    }

    /// The image is written before the record that names its checksum, so a torn one is noticed.
    fn write_image(
        &mut self,
        keyframe: &mut StoredKeyframe,
        pixels: &mut [u8],
        queue: &Queue,
    ) -> Result<(), StoreError> {
        let path = layout::image_path(&self.folder, keyframe.frame_index);
        jpeg::encode(pixels, self.image_size, self.pixel_format, self.jpeg_quality, &mut self.jpeg).map_err(|e| {
            StoreError::Write {
                action: "encoding",
                path: path.clone(),
                hint: "no JPEG can hold this camera's pixels: check their size and format",
                source: std::io::Error::other(e),
            }
        })?;
        let old_bytes = file_bytes(&path);
        std::fs::write(&path, &self.jpeg).map_err(|e| StoreError::write("writing", &path, e))?;
        queue.count_bytes(self.jpeg.len() as u64, old_bytes);
        keyframe.image_bytes = u32::try_from(self.jpeg.len()).unwrap_or(u32::MAX);
        keyframe.image_crc = crc32fast::hash(&self.jpeg);
        Ok(())
    }

    fn sync_log(&self) -> Result<(), StoreError> {
        let path = self.folder.join(layout::KEYFRAMES);
        self.keyframe_log.sync_data().map_err(|e| StoreError::write("syncing", &path, e))
    }
}

/// Replaces a file and counts what the store gains or loses by it.
fn replace_counted(path: &Path, bytes: &[u8], queue: &Queue) -> Result<(), StoreError> {
    let old_bytes = file_bytes(path);
    layout::replace_file(path, bytes)?;
    queue.count_bytes(bytes.len() as u64, old_bytes);
    Ok(())
}

/// Size of a file that may not be there.
fn file_bytes(path: &Path) -> u64 {
    std::fs::metadata(path).map_or(0, |found| found.len())
}

struct StopWhenDropped<'a>(&'a Queue);

impl Drop for StopWhenDropped<'_> {
    fn drop(&mut self) {
        self.0.stop(None);
    }
}
