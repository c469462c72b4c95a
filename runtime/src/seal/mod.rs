//! After start-up the tracking and mapping threads take no more memory from the heap, and this proves it.
//!
//! A sealed thread that allocates or frees is *counted*, never stopped: a refused allocation would abort the
//! process. Tests demand a count of zero, a run reports it. The counts cover Rust's allocator; what a C driver
//! takes is seen by [`telemetry`](crate::telemetry) in the resident size.

mod allocator;

pub use allocator::CountingAllocator;

use allocator::{LIVE_BYTES, PEAK_BYTES, PREFAULT, SEALED_ALLOCATIONS, SEALED_BYTES, SEALED_FREES, TAG, TRACE_NEXT};
use std::marker::PhantomData;
use std::sync::atomic::Ordering::Relaxed;

/// What sealed threads took and gave back although they should not, and how much is alive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SealReport {
    /// Allocations on sealed threads; a reallocation counts as a free and an allocation.
    pub sealed_allocations: u64,
    /// Frees on sealed threads.
    pub sealed_frees: u64,
    /// Bytes that sealed threads asked for.
    pub sealed_bytes: u64,
    /// Bytes of the whole process's heap that are in use now.
    pub live_bytes: u64,
    /// The most that was ever in use.
    pub peak_bytes: u64,
}

/// Counts of the whole process so far. All zero unless the binary installs [`CountingAllocator`].
pub fn report() -> SealReport {
    SealReport {
        sealed_allocations: SEALED_ALLOCATIONS.load(Relaxed),
        sealed_frees: SEALED_FREES.load(Relaxed),
        sealed_bytes: SEALED_BYTES.load(Relaxed),
        live_bytes: LIVE_BYTES.load(Relaxed) as u64,
        peak_bytes: PEAK_BYTES.load(Relaxed) as u64,
    }
}

/// What the calling thread has taken from the heap and not given back.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ThreadHeap {
    /// Bytes in use now. A thread that frees what another took counts that as given back.
    pub live_bytes: u64,
    /// The most that was in use since the thread began, or since [`restart_thread_peak`].
    pub peak_bytes: u64,
}

/// The calling thread's heap: the domain of a thread that keeps what it takes to itself. All zero unless the binary
/// installs [`CountingAllocator`].
pub fn thread_heap() -> ThreadHeap {
    let bytes = |count: isize| u64::try_from(count).unwrap_or(0);
    TAG.with(|tag| ThreadHeap { live_bytes: bytes(tag.live_bytes.get()), peak_bytes: bytes(tag.peak_bytes.get()) })
}

/// Forgets the calling thread's peak: it is what is in use now.
pub fn restart_thread_peak() {
    TAG.with(|tag| tag.peak_bytes.set(tag.live_bytes.get()));
}

/// From now on, large blocks are resident as soon as they are allocated: a pool that is touched bit by bit while the
/// vehicle drives would look like a leak, and might find no memory when it is needed.
pub fn prefault_pools() {
    PREFAULT.store(true, Relaxed);
}

/// The next allocation on a sealed thread prints where it happened, on stderr. For finding one; costs nothing else.
pub fn trace_next_violation() {
    TRACE_NEXT.store(true, Relaxed);
}

/// Seals the calling thread until the guard is dropped. Guards nest: the innermost decides.
#[must_use = "the thread is sealed only as long as the guard lives"]
pub fn enter() -> Sealed {
    switch(true)
}

/// Lifts the seal of the calling thread until the guard is dropped: for work that is known to allocate and is
/// outside the steady state, such as shutting down. Say why at the call.
#[must_use = "the seal is lifted only as long as the guard lives"]
pub fn lift() -> Sealed {
    switch(false)
}

fn switch(to_sealed: bool) -> Sealed {
    TAG.with(|tag| Sealed {
        was_sealed: tag.is_sealed.replace(to_sealed),
        allocations_before: tag.allocations.get(),
        frees_before: tag.frees.get(),
        stays_on_this_thread: PhantomData,
    })
}

/// A stretch of a thread's life; what the thread was before comes back when this is dropped.
#[derive(Debug)]
pub struct Sealed {
    was_sealed: bool,
    allocations_before: u64,
    frees_before: u64,
    stays_on_this_thread: PhantomData<*const ()>,
}

impl Sealed {
    /// Allocations and frees of this thread, while sealed, since the guard was made.
    pub fn violations(&self) -> (u64, u64) {
        TAG.with(|tag| (tag.allocations.get() - self.allocations_before, tag.frees.get() - self.frees_before))
    }
}

impl Drop for Sealed {
    fn drop(&mut self) {
        TAG.with(|tag| tag.is_sealed.set(self.was_sealed));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::hint::black_box;

    fn violations_of(work: impl FnOnce()) -> (u64, u64) {
        let sealed = enter();
        work();
        sealed.violations()
    }

    #[test]
    fn a_sealed_thread_is_counted_and_never_refused() {
        let mut kept: Vec<u8> = Vec::with_capacity(8);
        let owned = Box::new(7);
        let check = |work: Box<dyn FnOnce() + '_>, expected: (u64, u64), what: &str| {
            // The closure itself is freed inside the seal: one more free when it captured something.
            let capture_free = u64::from(size_of_val(&*work) > 0);
            let (allocations, frees) = violations_of(work);
            assert_eq!((allocations, frees - capture_free), expected, "{what}");
        };
        check(Box::new(|| ()), (0, 0), "nothing");
        check(Box::new(|| drop(black_box(Box::new(1)))), (1, 1), "a box made and dropped");
        check(Box::new(|| drop(black_box(vec![0_u8; 100]))), (1, 1), "zeroed memory");
        check(Box::new(|| kept.extend_from_slice(black_box(&[0; 100]))), (1, 1), "a vector that grows");
        check(Box::new(move || drop(black_box(owned))), (0, 1), "a box made before");
        assert_eq!(kept.len(), 100, "the memory was handed out all the same");
    }

    #[test]
    fn other_threads_are_not_sealed_with_this_one() {
        let sealed = enter();
        let thread = {
            let _starting_a_thread_allocates = lift();
            std::thread::spawn(|| drop(black_box(vec![1_u8; 64])))
        };
        let joined = {
            let _so_does_joining = lift();
            thread.join()
        };
        assert!(joined.is_ok());
        assert_eq!(sealed.violations(), (0, 0));
    }

    #[test]
    fn seals_nest_and_end() {
        let outer = enter();
        drop(enter());
        drop(black_box(Box::new(1)));
        assert_eq!(outer.violations(), (1, 1), "the inner seal's end leaves the outer one in force");
        drop(outer);
        let probe = switch(false);
        drop(black_box(Box::new(1)));
        assert_eq!(probe.violations(), (0, 0), "no seal is left on this thread");
    }

    #[test]
    fn a_pool_is_resident_once_it_is_prefaulted() {
        const BLOCK: usize = 256 << 20;
        let resident_bytes = || crate::telemetry::process_memory(None).expect("a /proc").rss_bytes;
        let grown_by = |make: fn() -> Vec<u8>| {
            let before = resident_bytes();
            let block = black_box(make());
            let grown = resident_bytes().saturating_sub(before);
            assert_eq!(block.first().copied().unwrap_or(0), 0);
            grown
        };
        // Other tests run beside this one; they take far less than the block.
        assert!(grown_by(|| vec![0; BLOCK]) < BLOCK as u64 / 2, "zeroed memory is lazy");
        prefault_pools();
        assert!(grown_by(|| vec![0; BLOCK]) > BLOCK as u64 / 2, "a zeroed pool");
        assert!(grown_by(|| Vec::with_capacity(BLOCK)) > BLOCK as u64 / 2, "an empty pool");
        let grown_pool = || {
            let mut pool = Vec::with_capacity(1);
            pool.reserve_exact(BLOCK);
            pool
        };
        assert!(grown_by(grown_pool) > BLOCK as u64 / 2, "a pool that was reserved later");
        PREFAULT.store(false, Relaxed);
    }

    #[test]
    fn a_thread_knows_its_own_heap() {
        let of_thread = || {
            let others = std::thread::spawn(|| black_box(vec![1_u8; 1 << 20]).len());
            let before = thread_heap();
            let block = black_box(vec![1_u8; 3 << 20]);
            let during = thread_heap();
            drop(block);
            let after = thread_heap();
            restart_thread_peak();
            assert!(others.join().is_ok());
            (during.live_bytes - before.live_bytes, after, thread_heap().peak_bytes)
        };
        let (taken, after, peak_again) = std::thread::spawn(of_thread).join().expect("no panic");
        assert_eq!(taken, 3 << 20);
        assert!(after.peak_bytes >= 3 << 20 && after.live_bytes < 1 << 20, "{after:?}");
        assert!(peak_again < 1 << 20, "{peak_again}");
    }

    #[test]
    fn live_and_peak_bytes_follow_a_large_block() {
        const BLOCK: u64 = 64 << 20;
        let before = report();
        let block = black_box(vec![1_u8; BLOCK as usize]);
        let during = report();
        drop(block);
        let after = report();
        // Other tests run beside this one; they move the counts by far less than the block.
        assert!(during.live_bytes >= before.live_bytes + BLOCK / 2, "{before:?} {during:?}");
        assert!(during.peak_bytes >= BLOCK && after.peak_bytes >= during.peak_bytes, "{during:?} {after:?}");
        assert!(after.live_bytes + BLOCK / 2 <= during.live_bytes, "{during:?} {after:?}");
    }
}
