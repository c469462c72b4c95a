//! The global allocator: the system's, with a count.
//!
//! This is the one place outside SIMD and drivers that needs `unsafe`: a global allocator is an unsafe trait, and
//! only the global allocator sees every allocation of every thread.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering::Relaxed};

/// Counts what it hands on to [`System`]. Install it in a binary with
/// `#[global_allocator] static ALLOCATOR: CountingAllocator = CountingAllocator;`
#[derive(Debug, Clone, Copy)]
pub struct CountingAllocator;

pub(super) static LIVE_BYTES: AtomicUsize = AtomicUsize::new(0);
pub(super) static PEAK_BYTES: AtomicUsize = AtomicUsize::new(0);
pub(super) static SEALED_ALLOCATIONS: AtomicU64 = AtomicU64::new(0);
pub(super) static SEALED_FREES: AtomicU64 = AtomicU64::new(0);
pub(super) static SEALED_BYTES: AtomicU64 = AtomicU64::new(0);
pub(super) static PREFAULT: AtomicBool = AtomicBool::new(false);
pub(super) static TRACE_NEXT: AtomicBool = AtomicBool::new(false);

/// What one thread may do and has done. Constant and without a destructor, so that reading it never allocates.
pub(super) struct ThreadTag {
    pub(super) is_sealed: Cell<bool>,
    pub(super) allocations: Cell<u64>,
    pub(super) frees: Cell<u64>,
    /// Bytes that the thread took and did not give back; below 0 where it gave back what others took.
    pub(super) live_bytes: Cell<isize>,
    pub(super) peak_bytes: Cell<isize>,
}

thread_local! {
    pub(super) static TAG: ThreadTag = const {
        ThreadTag {
            is_sealed: Cell::new(false),
            allocations: Cell::new(0),
            frees: Cell::new(0),
            live_bytes: Cell::new(0),
            peak_bytes: Cell::new(0),
        }
    };
}

// SAFETY: every method hands its arguments on to `System` unchanged and returns what `System` returns; the counting
// around it touches only atomics and constant thread-local cells, so it neither allocates nor unwinds.
unsafe impl GlobalAlloc for CountingAllocator {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count_allocation(layout.size());
        // SAFETY: the caller keeps `GlobalAlloc::alloc`'s contract, which is also `System`'s; the block has
        // `layout.size()` bytes, and nothing is stored in it yet.
        unsafe { touched(System.alloc(layout), 0, layout.size()) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        count_allocation(layout.size());
        // SAFETY: as in `alloc`; what is written into the block are the zeroes that it is full of.
        unsafe { touched(System.alloc_zeroed(layout), 0, layout.size()) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, new_size: usize) -> *mut u8 {
        count_free(layout.size());
        count_allocation(new_size);
        // SAFETY: the caller keeps `GlobalAlloc::realloc`'s contract, which is also `System`'s; only bytes that the
        // old block did not have are written.
        unsafe { touched(System.realloc(pointer, layout, new_size), layout.size(), new_size) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        count_free(layout.size());
        // SAFETY: the caller keeps `GlobalAlloc::dealloc`'s contract, which is also `System`'s.
        unsafe { System.dealloc(pointer, layout) }
    }
}

/// Smaller blocks come from pages that are in use already.
const SMALLEST_POOL_BYTES: usize = 64 << 10;

/// Smallest page of any machine this runs on.
const PAGE_BYTES: usize = 4096;

/// Writes a zero into every page of the new bytes of a large block, when pools are to be resident from the start.
///
/// # Safety
/// `block` is null or has `n_bytes` bytes, of which those from `first_new` on hold nothing or zeroes.
unsafe fn touched(block: *mut u8, first_new: usize, n_bytes: usize) -> *mut u8 {
    let is_pool = n_bytes.saturating_sub(first_new) >= SMALLEST_POOL_BYTES;
    if is_pool && !block.is_null() && PREFAULT.load(Relaxed) {
        for offset in (first_new..n_bytes).step_by(PAGE_BYTES) {
            // SAFETY: `first_new <= offset < n_bytes`. Volatile, because nobody reads the byte.
            unsafe { block.add(offset).write_volatile(0) };
        }
    }
    block
}

fn count_allocation(bytes: usize) {
    let live = LIVE_BYTES.fetch_add(bytes, Relaxed).wrapping_add(bytes);
    PEAK_BYTES.fetch_max(live, Relaxed);
    on_this_thread(|tag| {
        let live = tag.live_bytes.get().saturating_add_unsigned(bytes);
        tag.live_bytes.set(live);
        tag.peak_bytes.set(tag.peak_bytes.get().max(live));
        if !tag.is_sealed.get() {
            return;
        }
        tag.allocations.set(tag.allocations.get() + 1);
        SEALED_ALLOCATIONS.fetch_add(1, Relaxed);
        SEALED_BYTES.fetch_add(bytes as u64, Relaxed);
        if TRACE_NEXT.swap(false, Relaxed) {
            trace(tag, bytes);
        }
    });
}

fn count_free(bytes: usize) {
    LIVE_BYTES.fetch_sub(bytes, Relaxed);
    on_this_thread(|tag| {
        tag.live_bytes.set(tag.live_bytes.get().saturating_sub_unsigned(bytes));
        if tag.is_sealed.get() {
            tag.frees.set(tag.frees.get() + 1);
            SEALED_FREES.fetch_add(1, Relaxed);
        }
    });
}

fn on_this_thread(count: impl FnOnce(&ThreadTag)) {
    // A thread that is being torn down has no tag any more, and no seal either.
    let _ = TAG.try_with(count);
}

/// Prints where a sealed thread allocated; printing allocates too, so the seal is lifted meanwhile.
#[cold]
fn trace(tag: &ThreadTag, bytes: usize) {
    tag.is_sealed.set(false);
    eprintln!("sealed thread allocated {bytes} bytes here:\n{}", std::backtrace::Backtrace::force_capture());
    tag.is_sealed.set(true);
}
