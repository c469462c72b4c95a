//! A worker pool that allocates only at its start.
//!
//! One set of items at a time: the caller works too, each item is taken by exactly one thread, and
//! [`Pool::for_each`] returns when all are done. What an item computes must not depend on who computes it;
//! then results do not depend on the number of threads.

use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;

/// Rounds a thread looks for work before it sleeps: some 10 us, less than it takes to be woken up.
const SPIN_ROUNDS: u32 = 400;

type Task<'a> = dyn Fn(usize) + Sync + 'a;

/// Threads that share out the items of one slice at a time.
pub struct Pool {
    shared: Arc<Shared>,
    workers: Vec<JoinHandle<()>>,
    submit: Mutex<()>,
}

struct Shared {
    state: Mutex<State>,
    wake: Condvar,
    idle: Condvar,
    /// Grows by one with every batch; read without the lock while spinning.
    epoch: AtomicU64,
    next_item: AtomicUsize,
    panicked: AtomicBool,
}

struct State {
    batch: Option<Batch>,
    /// Workers inside the current batch.
    active: usize,
    stop: bool,
}

#[derive(Clone, Copy)]
struct Batch {
    task: *const Task<'static>,
    n_items: usize,
}

// SAFETY: the pointer is to a `Sync` closure, so any thread may call it; that it is alive whenever a worker
// dereferences it is what `Pool::run` guarantees by not returning before `active` is zero and `batch` is gone.
unsafe impl Send for Batch {}

impl Pool {
    /// Starts `threads - 1` workers (the caller is the last one); `on_start` runs first on each, with its number.
    ///
    /// # Errors
    /// What the operating system said when it refused a thread.
    pub fn new(threads: usize, on_start: impl Fn(usize) + Send + Sync + 'static) -> io::Result<Self> {
        let shared = Arc::new(Shared {
            state: Mutex::new(State { batch: None, active: 0, stop: false }),
            wake: Condvar::new(),
            idle: Condvar::new(),
            epoch: AtomicU64::new(0),
            next_item: AtomicUsize::new(0),
            panicked: AtomicBool::new(false),
        });
        let on_start = Arc::new(on_start);
        let mut pool = Self { shared, workers: Vec::with_capacity(threads.saturating_sub(1)), submit: Mutex::new(()) };
        for number in 1..threads.max(1) {
            let (shared, on_start) = (Arc::clone(&pool.shared), Arc::clone(&on_start));
            let worker = std::thread::Builder::new().name(format!("splat-{number}")).spawn(move || {
                on_start(number);
                shared.work();
            })?;
            pool.workers.push(worker);
        }
        Ok(pool)
    }

    /// Threads that work, the caller included.
    pub fn threads(&self) -> usize {
        self.workers.len() + 1
    }

    /// Calls `task` once for every item, in any order and on any thread.
    ///
    /// # Panics
    /// When `task` panicked on any thread; all items have been left by then.
    pub fn for_each<T: Send>(&self, items: &mut [T], task: impl Fn(usize, &mut T) + Sync) {
        let base = Items(items.as_mut_ptr());
        let n_items = items.len();
        self.run(n_items, &|i| {
            debug_assert!(i < n_items);
            // SAFETY: `run` hands out every index below `n_items` once, so this is the only reference to
            // element `i`, and `items` is borrowed until `run` returns.
            let item = unsafe { &mut *base.at(i) };
            task(i, item);
        });
    }

    /// Calls `task` once for every index below `n_items`.
    fn run(&self, n_items: usize, task: &Task<'_>) {
        if self.workers.is_empty() || n_items < 2 {
            (0..n_items).for_each(task);
            return;
        }
        let _one_batch_at_a_time = self.submit.lock().unwrap_or_else(PoisonError::into_inner);
        // SAFETY: only the lifetime changes. No worker can hold the pointer after this function: it is removed
        // and `active` awaited below, and nothing between here and there unwinds.
        let task_pointer: *const Task<'static> =
            unsafe { std::mem::transmute::<*const Task<'_>, *const Task<'static>>(task) };
        let batch = Batch { task: task_pointer, n_items };
        {
            let mut state = self.shared.lock();
            self.shared.next_item.store(0, Ordering::Relaxed);
            self.shared.panicked.store(false, Ordering::Relaxed);
            state.batch = Some(batch);
            self.shared.epoch.fetch_add(1, Ordering::Release);
        }
        self.shared.wake.notify_all();
        self.shared.take_items(batch);
        self.shared.close_batch();
        assert!(!self.shared.panicked.load(Ordering::Relaxed), "a task of the worker pool panicked");
    }
}

impl Drop for Pool {
    fn drop(&mut self) {
        self.shared.lock().stop = true;
        self.shared.epoch.fetch_add(1, Ordering::Release);
        self.shared.wake.notify_all();
        for worker in self.workers.drain(..) {
            // A worker that panicked has already said so.
            let _ = worker.join();
        }
    }
}

struct Items<T>(*mut T);

// SAFETY: only `Pool::for_each` makes one; it gives each element to one thread, and `T: Send` there.
unsafe impl<T: Send> Sync for Items<T> {}

impl<T> Items<T> {
    /// Pointer to element `i`, which the caller knows to exist.
    fn at(&self, i: usize) -> *mut T {
        self.0.wrapping_add(i)
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Body of a worker thread.
    fn work(&self) {
        let mut seen_epoch = 0;
        loop {
            self.spin_until(|| self.epoch.load(Ordering::Acquire) != seen_epoch);
            let mut state = self.lock();
            while !state.stop && self.epoch.load(Ordering::Acquire) == seen_epoch {
                state = self.wake.wait(state).unwrap_or_else(PoisonError::into_inner);
            }
            if state.stop {
                return;
            }
            seen_epoch = self.epoch.load(Ordering::Acquire);
            // The batch may be over before this thread woke up.
            let Some(batch) = state.batch else { continue };
            state.active += 1;
            drop(state);
            self.take_items(batch);
            let mut state = self.lock();
            state.active -= 1;
            if state.active == 0 {
                self.idle.notify_one();
            }
        }
    }

    /// Takes items until there are none left; a panic is kept for the caller.
    fn take_items(&self, batch: Batch) {
        let result = catch_unwind(AssertUnwindSafe(|| {
            // SAFETY: `Pool::run` keeps the closure alive until this thread has left the batch.
            let task = unsafe { &*batch.task };
            loop {
                let i = self.next_item.fetch_add(1, Ordering::Relaxed);
                if i >= batch.n_items {
                    return;
                }
                task(i);
            }
        }));
        if result.is_err() {
            self.panicked.store(true, Ordering::Relaxed);
        }
    }

    /// Lets no more workers in and waits for those inside.
    fn close_batch(&self) {
        let mut state = self.lock();
        state.batch = None;
        while state.active > 0 {
            state = self.idle.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }

    fn spin_until(&self, ready: impl Fn() -> bool) {
        for _ in 0..SPIN_ROUNDS {
            if ready() {
                return;
            }
            std::hint::spin_loop();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check_every_item_once(threads: usize, n_items: usize) {
        let pool = Pool::new(threads, |_| ()).expect("threads");
        for round in 0..200 {
            let mut items = vec![0usize; n_items];
            pool.for_each(&mut items, |i, item| *item += i + round);
            let expected: Vec<usize> = (0..n_items).map(|i| i + round).collect();
            assert_eq!(items, expected, "{threads} threads, round {round}");
        }
    }

    #[test]
    fn every_item_is_done_once() {
        for threads in [1, 2, 4] {
            for n_items in [0, 1, 2, 37] {
                check_every_item_once(threads, n_items);
            }
        }
    }

    #[test]
    fn a_panic_reaches_the_caller_and_the_pool_works_on() {
        let pool = Pool::new(3, |_| ()).expect("threads");
        let mut items = [0u32; 64];
        let result = catch_unwind(AssertUnwindSafe(|| {
            pool.for_each(&mut items, |i, _| assert!(i != 40, "item 40"));
        }));
        assert!(result.is_err());
        pool.for_each(&mut items, |_, item| *item = 7);
        assert_eq!(items, [7; 64]);
    }

    #[test]
    fn the_start_hook_runs_on_every_worker() {
        static STARTED: AtomicUsize = AtomicUsize::new(0);
        let count = |number| {
            STARTED.fetch_add(number, Ordering::Relaxed);
        };
        drop(Pool::new(4, count).expect("threads"));
        assert_eq!(STARTED.load(Ordering::Relaxed), 1 + 2 + 3);
    }
}
