//! A bounded queue between two threads that takes all its memory at the start.

use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// Makes a queue that never holds more than `capacity` elements.
pub fn queue<T>(capacity: usize) -> (Sender<T>, Receiver<T>) {
    let shared = Arc::new(Shared {
        state: Mutex::new(State { waiting: VecDeque::with_capacity(capacity), most_waiting: 0, is_closed: false }),
        changed: Condvar::new(),
        capacity,
    });
    (Sender { shared: Arc::clone(&shared) }, Receiver { shared })
}

/// The end that elements are put into; the queue is closed when it is dropped.
pub struct Sender<T> {
    shared: Arc<Shared<T>>,
}

/// The end that elements are taken from; the queue is closed when it is dropped.
pub struct Receiver<T> {
    shared: Arc<Shared<T>>,
}

/// What a receiver that does not wait for ever finds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Received<T> {
    /// The oldest element.
    Element(T),
    /// Nothing came in time.
    Empty,
    /// The sender is gone and everything was taken.
    Closed,
}

struct Shared<T> {
    state: Mutex<State<T>>,
    changed: Condvar,
    capacity: usize,
}

struct State<T> {
    waiting: VecDeque<T>,
    most_waiting: usize,
    is_closed: bool,
}

impl<T> Shared<T> {
    fn lock(&self) -> MutexGuard<'_, State<T>> {
        // A thread that panicked left the queue as it was between two operations: it stays usable.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn close(&self) {
        self.lock().is_closed = true;
        self.changed.notify_all();
    }
}

impl<T> Sender<T> {
    /// Waits until there is room. Gives the element back when the receiver is gone.
    ///
    /// # Errors
    /// The element itself, when nobody will ever take it.
    pub fn push(&self, element: T) -> Result<(), T> {
        let mut state = self.shared.lock();
        while state.waiting.len() >= self.shared.capacity && !state.is_closed {
            state = self.shared.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
        self.put(state, element)
    }

    /// Puts the element in if there is room.
    ///
    /// # Errors
    /// The element itself, when the queue is full or nobody will ever take it.
    pub fn try_push(&self, element: T) -> Result<(), T> {
        let state = self.shared.lock();
        self.put(state, element)
    }

    fn put(&self, mut state: MutexGuard<'_, State<T>>, element: T) -> Result<(), T> {
        if state.is_closed || state.waiting.len() >= self.shared.capacity {
            return Err(element);
        }
        state.waiting.push_back(element);
        state.most_waiting = state.most_waiting.max(state.waiting.len());
        drop(state);
        self.shared.changed.notify_all();
        Ok(())
    }
}

impl<T> Receiver<T> {
    /// Takes the oldest element, waiting for it at most `patience`.
    pub fn pop_within(&self, patience: Duration) -> Received<T> {
        let state = self.shared.lock();
        let nothing_yet = |state: &mut State<T>| state.waiting.is_empty() && !state.is_closed;
        let waited = self.shared.changed.wait_timeout_while(state, patience, nothing_yet);
        let (mut state, _) = waited.unwrap_or_else(PoisonError::into_inner);
        let taken = state.waiting.pop_front();
        let is_closed = state.is_closed;
        drop(state);
        match taken {
            Some(element) => {
                self.shared.changed.notify_all();
                Received::Element(element)
            }
            None if is_closed => Received::Closed,
            None => Received::Empty,
        }
    }

    /// Elements that wait now.
    pub fn n_waiting(&self) -> usize {
        self.shared.lock().waiting.len()
    }

    /// The most elements that ever waited.
    pub fn most_waiting(&self) -> usize {
        self.shared.lock().most_waiting
    }

    /// Takes the oldest element, waiting for it as long as the sender lives.
    pub fn pop(&self) -> Option<T> {
        loop {
            match self.pop_within(Duration::from_secs(3600)) {
                Received::Element(element) => return Some(element),
                Received::Empty => {}
                Received::Closed => return None,
            }
        }
    }
}

impl<T> Drop for Sender<T> {
    fn drop(&mut self) {
        self.shared.close();
    }
}

impl<T> Drop for Receiver<T> {
    fn drop(&mut self) {
        self.shared.close();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SOON: Duration = Duration::from_millis(5);

    #[test]
    fn a_full_queue_gives_the_element_back_and_order_is_kept() {
        let (sender, receiver) = queue(2);
        assert_eq!([1, 2, 3].map(|n| sender.try_push(n)), [Ok(()), Ok(()), Err(3)]);
        assert_eq!(receiver.pop_within(SOON), Received::Element(1));
        assert_eq!((receiver.n_waiting(), receiver.most_waiting()), (1, 2));
        assert_eq!(sender.try_push(4), Ok(()));
        drop(sender);
        assert_eq!(
            [(); 3].map(|()| receiver.pop_within(SOON)),
            [Received::Element(2), Received::Element(4), Received::Closed]
        );
    }

    #[test]
    fn nobody_waits_for_an_end_that_is_gone() {
        let (sender, receiver) = queue(1);
        assert_eq!(receiver.pop_within(SOON), Received::Empty);
        drop(receiver);
        assert_eq!(sender.push(1), Err(1));
    }

    #[test]
    fn a_waiting_sender_goes_on_when_there_is_room() {
        let (sender, receiver) = queue(1);
        let thread = std::thread::spawn(move || (0..100).filter(|n| sender.push(*n).is_ok()).count());
        let taken: Vec<i32> = std::iter::from_fn(|| receiver.pop()).collect();
        assert_eq!(taken, (0..100).collect::<Vec<_>>());
        assert_eq!(thread.join().ok(), Some(100));
    }
}
