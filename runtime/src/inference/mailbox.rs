//! Questions of a sealed thread to the inference thread, and the answers, in memory that was taken at the start.

use super::picture::Picture;
use kilogs_core::correspondence::PixelMatch;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// What is asked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Question {
    /// Matches of keypoints.
    Sparse,
    /// Matches of whole images.
    Dense,
    /// Depths of pixels.
    Depth,
}

/// Question and answer. Its vectors have room for the largest ones.
#[derive(Debug)]
pub(super) struct Sheet {
    pub question: Question,
    pub keyframe_ordinal: u32,
    pub keyframe: Picture,
    pub current: Picture,
    pub matches: Vec<PixelMatch>,
    pub pixels: Vec<[f32; 2]>,
    pub depths_m: Vec<f32>,
}

/// Why there is no answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum NoAnswer {
    /// It did not come in time; it will be thrown away.
    Late,
    /// The inference thread has ended.
    Gone,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Phase {
    /// Nobody asks.
    Free,
    /// Somebody waits for an answer.
    Asked,
    /// As before, and the inference thread has the sheet.
    Working,
    /// Nobody waits any more for the answer that is being worked on.
    Abandoned,
    /// The answer is on the sheet.
    Answered,
    /// One side has gone.
    Closed,
}

#[derive(Debug)]
struct State {
    phase: Phase,
    /// Gone only while the inference thread works on it.
    sheet: Option<Box<Sheet>>,
}

/// One question at a time.
#[derive(Debug)]
pub(super) struct Mailbox {
    state: Mutex<State>,
    changed: Condvar,
}

impl Mailbox {
    pub(super) fn new(sheet: Sheet) -> Self {
        let state = State { phase: Phase::Free, sheet: Some(Box::new(sheet)) };
        Self { state: Mutex::new(state), changed: Condvar::new() }
    }

    /// Lets `write` put a question on the sheet and `read` take the answer from it. Waits for its turn and for the answer
    /// together no longer than `patience`; for ever without one.
    pub(super) fn ask<T>(
        &self,
        patience: Option<Duration>,
        write: impl FnOnce(&mut Sheet),
        read: impl FnOnce(&Sheet) -> T,
    ) -> Result<T, NoAnswer> {
        let deadline = patience.map(|patience| Instant::now() + patience);
        let mut state = self.wait_for(Phase::Free, deadline)?;
        if let Some(sheet) = &mut state.sheet {
            write(sheet);
        }
        self.enter(&mut state, Phase::Asked);
        drop(state);
        let mut state = match self.wait_for(Phase::Answered, deadline) {
            Ok(state) => state,
            Err(reason) => {
                self.abandon();
                return Err(reason);
            }
        };
        let answer = state.sheet.as_deref().map(read);
        self.enter(&mut state, Phase::Free);
        answer.ok_or(NoAnswer::Gone)
    }

    /// Nobody waits any more for what was asked.
    fn abandon(&self) {
        let mut state = self.lock();
        let next = match state.phase {
            Phase::Asked | Phase::Answered => Phase::Free,
            Phase::Working => Phase::Abandoned,
            other => other,
        };
        self.enter(&mut state, next);
    }

    /// The inference thread's side: answers questions until the mailbox is closed.
    pub(super) fn serve(&self, mut answer: impl FnMut(&mut Sheet)) {
        while let Ok(mut state) = self.wait_for(Phase::Asked, None) {
            let Some(mut sheet) = state.sheet.take() else { break };
            self.enter(&mut state, Phase::Working);
            drop(state);
            answer(&mut sheet);
            let mut state = self.lock();
            state.sheet = Some(sheet);
            let next = match state.phase {
                Phase::Working => Phase::Answered,
                Phase::Abandoned => Phase::Free,
                other => other,
            };
            self.enter(&mut state, next);
        }
    }

    /// Ends the other side's waiting, for ever.
    pub(super) fn close(&self) {
        self.enter(&mut self.lock(), Phase::Closed);
    }

    fn enter(&self, state: &mut State, phase: Phase) {
        state.phase = phase;
        self.changed.notify_all();
    }

    fn wait_for(&self, phase: Phase, deadline: Option<Instant>) -> Result<MutexGuard<'_, State>, NoAnswer> {
        let mut state = self.lock();
        loop {
            match (state.phase == phase, state.phase) {
                (true, _) => return Ok(state),
                (false, Phase::Closed) => return Err(NoAnswer::Gone),
                (false, _) => {}
            }
            state = match deadline {
                None => self.changed.wait(state).unwrap_or_else(PoisonError::into_inner),
                Some(deadline) => {
                    let left = deadline.saturating_duration_since(Instant::now());
                    if left.is_zero() {
                        return Err(NoAnswer::Late);
                    }
                    self.changed.wait_timeout(state, left).unwrap_or_else(PoisonError::into_inner).0
                }
            };
        }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::mpsc;

    fn mailbox() -> Mailbox {
        Mailbox::new(Sheet {
            question: Question::Sparse,
            keyframe_ordinal: 0,
            keyframe: Picture::default(),
            current: Picture::default(),
            matches: Vec::new(),
            pixels: Vec::new(),
            depths_m: Vec::new(),
        })
    }

    /// Asks for twice `n`.
    fn ask(mailbox: &Mailbox, n: u32, patience: Option<Duration>) -> Result<u32, NoAnswer> {
        mailbox.ask(patience, |sheet| sheet.keyframe_ordinal = n, |sheet| sheet.keyframe_ordinal)
    }

    #[test]
    fn questions_are_answered_one_after_the_other_until_it_closes() {
        let mailbox = mailbox();
        std::thread::scope(|scope| {
            scope.spawn(|| mailbox.serve(|sheet| sheet.keyframe_ordinal *= 2));
            let askers = [1_u32, 1000].map(|first| {
                let mailbox = &mailbox;
                scope.spawn(move || (first..first + 50).all(|n| ask(mailbox, n, None) == Ok(2 * n)))
            });
            assert!(askers.into_iter().all(|asker| asker.join().expect("no panic")), "everyone got the own answer");
            mailbox.close();
        });
        assert_eq!(ask(&mailbox, 1, None), Err(NoAnswer::Gone));
    }

    #[test]
    fn an_answer_that_came_too_late_is_not_taken_for_the_next() {
        let mailbox = mailbox();
        let (go, wait) = mpsc::channel::<()>();
        std::thread::scope(|scope| {
            let mailbox = &mailbox;
            scope.spawn(move || {
                mailbox.serve(|sheet| {
                    let _ = wait.recv();
                    sheet.keyframe_ordinal *= 2;
                });
            });
            let short = Some(Duration::from_millis(20));
            assert_eq!(ask(mailbox, 1, short), Err(NoAnswer::Late));
            assert_eq!(ask(mailbox, 2, short), Err(NoAnswer::Late), "still busy with the first");
            go.send(()).expect("it waits");
            go.send(()).expect("it waits");
            assert_eq!(ask(mailbox, 3, None), Ok(6));
            mailbox.close();
        });
    }
}
