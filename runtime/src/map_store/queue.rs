//! The bounded queue between those who map and the one who writes. Allocates nothing after construction.

use super::{ReadFile, StoreError, StoredFile};
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
    /// A file to be read back.
    Read {
        file: StoredFile,
        memory: Buffer,
    },
}

/// Which of the pools of buffers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Pool {
    Pages,
    Images,
    Reads,
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
    reads: Buffers,
    /// Files that were read, in the order in which they were asked for.
    came: VecDeque<ReadFile>,
    /// Files that were asked for and are not read yet.
    n_coming: usize,
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
            Pool::Reads => &mut self.reads,
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
    pub(super) fn new(capacity: usize, pages: (usize, usize), images: (usize, usize), reads: (usize, usize)) -> Self {
        let state = State {
            jobs: VecDeque::with_capacity(capacity),
            pages: Buffers::new(pages),
            images: Buffers::new(images),
            reads: Buffers::new(reads),
            came: VecDeque::with_capacity(reads.0),
            n_coming: 0,
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

    /// Buffers that are free.
    pub(super) fn n_free(&self, pool: Pool) -> usize {
        self.lock().pool(pool).free.len()
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
        state.n_coming += usize::from(matches!(job, Job::Read { .. }));
        state.jobs.push_back(job);
        drop(state);
        self.work_arrived.notify_one();
        Ok(())
    }

    /// Hands over a file that was read.
    pub(super) fn deliver(&self, file: ReadFile) {
        let mut state = self.lock();
        state.n_coming = state.n_coming.saturating_sub(1);
        state.came.push_back(file);
        drop(state);
        self.room_arrived.notify_all();
    }

    /// The oldest file that was read; with `wait` the thread waits for one that is still coming.
    pub(super) fn next_read(&self, wait: bool) -> Option<ReadFile> {
        let mut state = self.lock();
        while wait && state.came.is_empty() && state.n_coming > 0 && !state.stopped {
            state = self.room_arrived.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
        state.came.pop_front()
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
        let queue = Queue::new(1, (2, 8), (0, 0), (0, 0));
        let first = queue.take_buffer(Pool::Pages, false).expect("two buffers");
        let second = queue.take_buffer(Pool::Pages, false).expect("two buffers");
        assert_eq!(queue.take_buffer(Pool::Pages, false), Err(Unavailable::Busy));
        assert_eq!((queue.most_taken(Pool::Pages), queue.most_taken(Pool::Images)), (2, 0));
        assert!(queue.push(page(1, first), false).is_ok());
        assert_eq!(queue.push(page(2, second), false), Err(Unavailable::Busy));
    }

    #[test]
    fn who_waits_goes_on_when_a_buffer_returns_and_when_writing_stops() {
        let queue = Arc::new(Queue::new(4, (1, 8), (0, 0), (0, 0)));
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

    #[test]
    fn who_waits_for_a_file_goes_on_when_it_was_read_when_none_is_coming_and_when_writing_stops() {
        let queue = Arc::new(Queue::new(2, (0, 0), (0, 0), (2, 8)));
        assert!(queue.next_read(true).is_none(), "nothing was asked for");
        let ask = |id: u32| {
            let memory = queue.take_buffer(Pool::Reads, false).expect("two buffers");
            queue.push(Job::Read { file: StoredFile::Page(id), memory }, false)
        };
        assert_eq!([ask(4), ask(5)], [Ok(()), Ok(())]);
        let reader = std::thread::spawn({
            let queue = Arc::clone(&queue);
            move || {
                std::thread::sleep(Duration::from_millis(20));
                if let Some(Job::Read { file, memory }) = queue.next_job() {
                    queue.deliver(ReadFile { file, memory, n_bytes: 0 });
                }
                std::thread::sleep(Duration::from_millis(20));
                queue.stop(None);
            }
        });
        assert_eq!(queue.next_read(true).map(|read| read.file), Some(StoredFile::Page(4)));
        assert!(queue.next_read(true).is_none(), "writing stopped");
        assert!(reader.join().is_ok());
    }
}
