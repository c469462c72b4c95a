//! Uploading from pages that the device reads itself, and from pages that it cannot.

use super::copies::executor;
use crate::splat::device::Executor;
use crate::splat::program::Buffer;
use crate::splat::vulkan::PageSource;
use crate::splat::vulkan::testing::device;
use std::ffi::{c_int, c_void};
use std::io::Write as _;
use std::os::fd::AsRawFd as _;

unsafe extern "C" {
    fn mmap(at: *mut c_void, len: usize, protection: c_int, flags: c_int, file: c_int, offset: i64) -> *mut c_void;
    fn munmap(at: *mut c_void, len: usize) -> c_int;
}

const PROT_READ: c_int = 1;
const MAP_SHARED: c_int = 1;
const PAGE: usize = 4096;

/// A file mapped read-only and shared, as the camera's frames are.
struct SharedPages {
    at: *mut c_void,
    len: usize,
}

impl SharedPages {
    fn new(bytes: &[u8]) -> Self {
        let mut file = tempfile::tempfile().expect("a file");
        file.write_all(bytes).expect("room");
        // SAFETY: a new mapping of a file that has `bytes.len()` bytes.
        let at = unsafe { mmap(std::ptr::null_mut(), bytes.len(), PROT_READ, MAP_SHARED, file.as_raw_fd(), 0) };
        assert_ne!(at.addr(), usize::MAX, "a mapping");
        Self { at, len: bytes.len() }
    }

    fn bytes(&self) -> &[u8] {
        // SAFETY: the mapping has `len` bytes, nobody writes there, and it lives as long as `self`.
        unsafe { std::slice::from_raw_parts(self.at.cast(), self.len) }
    }
}

impl Drop for SharedPages {
    fn drop(&mut self) {
        // SAFETY: the mapping is this object's own.
        unsafe { munmap(self.at, self.len) };
    }
}

#[test]
fn pages_arrive_whether_they_are_imported_or_copied() {
    let (Some(device), Some(mut executor)) = (device(), executor()) else { return };
    let content: Vec<u8> = (0..3 * PAGE).map(|i| (i * 31 + i / 256) as u8).collect();
    let shared = SharedPages::new(&content);
    let aligned = PageSource::new(&device, shared.bytes());
    let askew = PageSource::new(&device, &shared.bytes()[4..PAGE]);
    let mut check = |pages: &PageSource<'_>, from: usize, len: usize, expected: &[u8]| {
        let mut read = vec![0; len];
        executor.clear(Buffer::Params, 0, 4 * PAGE).expect("a clear");
        let how = executor.upload_pages(Buffer::Params, 16, pages, from, len).expect("an upload");
        executor.download(Buffer::Params, 16, &mut read).expect("a download");
        assert!(read == expected, "{how}");
        how
    };
    let how = check(&aligned, 0, 3 * PAGE, &content);
    eprintln!("read-only shared pages on {}: {how}", device.info().name);
    check(&aligned, 100, 2000, &content[100..2100]);
    assert_eq!(check(&askew, 0, 64, &content[4..68]), "copied: the range is not whole pages");
}

#[test]
fn the_software_device_reads_shared_pages_itself() {
    let Some(device) = device().filter(|device| device.info().name.starts_with("llvmpipe")) else { return };
    let shared = SharedPages::new(&[7; PAGE]);
    assert_eq!(PageSource::new(&device, shared.bytes()).describe(), "zero-copy import");
}
