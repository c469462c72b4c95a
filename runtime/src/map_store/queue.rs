//! The bounded queue between those who map and the one who writes. Allocates nothing after construction.

use super::StoreError;
use kilogs_core::store::StoredKeyframe;
use std::collections::VecDeque;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};

/// Memory that travels to the writing thread and back.
pub(super) type Buffer = Box<[u8]>;

/// Something to write.
#[derive(Debug)]
pub(super) enum Job {
    Page {
        page_id: u32,
        memory: Buffer,
        n_bytes: usize,
    },
    Chunk {
        chunk_id: u32,
        memory: Buffer,
        n_bytes: usize,
    },
    /// A keyframe with its packed image, or without one.
    Keyframe {
        keyframe: StoredKeyframe,
        pixels: Option<Buffer>,
    },
}

/// Which of the two pools of buffers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Pool {
    Pages,
    Images,
}

/// Why nothing could be taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Unavailable {
    Busy,
    Stopped,
}

/// Buffers of one pool.
#[derive(Debug)]
struct Buffers {
    free: Vec<Buffer>,
    count: usize,
    most_taken: usize,
}

impl Buffers {
    fn new((count, bytes): (usize, usize)) -> Self {
        Self { free: (0..count).map(|_| vec![0; bytes].into_boxed_slice()).collect(), count, most_taken: 0 }
    }

    fn take(&mut self) -> Option<Buffer> {
        let taken = self.free.pop()?;
        self.most_taken = self.most_taken.max(self.count - self.free.len());
        Some(taken)
    }
}

#[derive(Debug)]
struct State {
    jobs: VecDeque<Job>,
    pages: Buffers,
    images: Buffers,
    job_running: bool,
    closing: bool,
    failure: Option<StoreError>,
    stopped: bool,
}

impl State {
    fn pool(&mut self, pool: Pool) -> &mut Buffers {
        match pool {
            Pool::Pages => &mut self.pages,
            Pool::Images => &mut self.images,
        }
    }
}

#[derive(Debug)]
pub(super) struct Queue {
    state: Mutex<State>,
    capacity: usize,
    work_arrived: Condvar,
    room_arrived: Condvar,
    bytes_on_disk: AtomicU64,
}

impl Queue {
    /// A queue for `capacity` jobs with pools of so many buffers of so many bytes.
    pub(super) fn new(capacity: usize, pages: (usize, usize), images: (usize, usize)) -> Self {
        let state = State {
            jobs: VecDeque::with_capacity(capacity),
            pages: Buffers::new(pages),
            images: Buffers::new(images),
            job_running: false,
            closing: false,
            failure: None,
            stopped: false,
        };
        Self {
            state: Mutex::new(state),
            capacity,
            work_arrived: Condvar::new(),
            room_arrived: Condvar::new(),
            bytes_on_disk: AtomicU64::new(0),
        }
    }

    // A panic in the other thread leaves the queue as consistent as any moment between two calls.
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes an empty buffer, waiting for one when `wait` says so.
    pub(super) fn take_buffer(&self, pool: Pool, wait: bool) -> Result<Buffer, Unavailable> {
        let mut state = self.lock();
        loop {
            if state.stopped {
                return Err(Unavailable::Stopped);
            }
            if let Some(buffer) = state.pool(pool).take() {
                return Ok(buffer);
            }
            if !wait {
                return Err(Unavailable::Busy);
            }
            state = self.room_arrived.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }

    pub(super) fn return_buffer(&self, pool: Pool, buffer: Buffer) {
        self.lock().pool(pool).free.push(buffer);
        self.room_arrived.notify_all();
    }

    /// The most buffers that were ever taken at once.
    pub(super) fn most_taken(&self, pool: Pool) -> usize {
        self.lock().pool(pool).most_taken
    }

    /// Notes that files grew by `new` bytes and lost `old` bytes.
    pub(super) fn count_bytes(&self, new: u64, old: u64) {
        // What was counted before comes off, so the sum does not wrap in the end.
        self.bytes_on_disk.fetch_add(new.wrapping_sub(old), Ordering::Relaxed);
    }

    /// Bytes of the store's files so far.
    pub(super) fn bytes_on_disk(&self) -> u64 {
        self.bytes_on_disk.load(Ordering::Relaxed)
    }

    /// Hands a job over; refused when there is no room and `wait` is false, or when writing stopped.
    pub(super) fn push(&self, job: Job, wait: bool) -> Result<(), Unavailable> {
        let mut state = self.lock();
        while state.jobs.len() >= self.capacity && wait && !state.stopped {
            state = self.room_arrived.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
        if state.stopped {
            return Err(Unavailable::Stopped);
        }
        if state.jobs.len() >= self.capacity {
            return Err(Unavailable::Busy);
        }
        state.jobs.push_back(job);
        drop(state);
        self.work_arrived.notify_one();
        Ok(())
    }

    /// Next job for the writing thread; `None` when it is to end.
    pub(super) fn next_job(&self) -> Option<Job> {
        let mut state = self.lock();
        state.job_running = false;
        self.room_arrived.notify_all();
        loop {
            if let Some(job) = state.jobs.pop_front() {
                state.job_running = true;
                return Some(job);
            }
            if state.closing || state.stopped {
                return None;
            }
            state = self.work_arrived.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Gives up writing: everybody who waits goes on without.
    pub(super) fn stop(&self, failure: Option<StoreError>) {
        let mut state = self.lock();
        state.stopped = true;
        state.failure = state.failure.take().or(failure);
        state.jobs.clear();
        state.job_running = false;
        drop(state);
        self.room_arrived.notify_all();
        self.work_arrived.notify_all();
    }

    /// Waits until everything handed over is on disk or writing stopped.
    pub(super) fn wait_until_idle(&self) -> Result<(), Unavailable> {
        let mut state = self.lock();
        while !state.stopped && (state.job_running || !state.jobs.is_empty()) {
            state = self.room_arrived.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
        if state.stopped { Err(Unavailable::Stopped) } else { Ok(()) }
    }

    /// Lets the writing thread end after the last job.
    pub(super) fn close(&self) {
        self.lock().closing = true;
        self.work_arrived.notify_all();
    }

    pub(super) fn take_failure(&self) -> Option<StoreError> {
        self.lock().failure.take()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Arc;
    use std::time::Duration;

    fn page(page_id: u32, memory: Buffer) -> Job {
        Job::Page { page_id, memory, n_bytes: 0 }
    }

    #[test]
    fn who_may_not_wait_is_refused() {
        let queue = Queue::new(1, (2, 8), (0, 0));
        let first = queue.take_buffer(Pool::Pages, false).expect("two buffers");
        let second = queue.take_buffer(Pool::Pages, false).expect("two buffers");
        assert_eq!(queue.take_buffer(Pool::Pages, false), Err(Unavailable::Busy));
        assert_eq!((queue.most_taken(Pool::Pages), queue.most_taken(Pool::Images)), (2, 0));
        assert!(queue.push(page(1, first), false).is_ok());
        assert_eq!(queue.push(page(2, second), false), Err(Unavailable::Busy));
    }

    #[test]
    fn who_waits_goes_on_when_a_buffer_returns_and_when_writing_stops() {
        let queue = Arc::new(Queue::new(4, (1, 8), (0, 0)));
        let only = queue.take_buffer(Pool::Pages, true).expect("one buffer");
        let waiting = std::thread::spawn({
            let queue = Arc::clone(&queue);
            move || (queue.take_buffer(Pool::Pages, true).is_ok(), queue.take_buffer(Pool::Pages, true))
        });
        std::thread::sleep(Duration::from_millis(20));
        queue.return_buffer(Pool::Pages, only);
        std::thread::sleep(Duration::from_millis(20));
        queue.stop(None);
        assert_eq!(waiting.join().expect("no panic"), (true, Err(Unavailable::Stopped)));
    }
}
