//! Who waits when there are not enough processor cores.

use rustix::process::{getpriority_process, setpriority_process};

/// Steps of niceness that mapping stands behind tracking: of a core that both want, the kernel gives it a tenth.
const STEPS_BEHIND: i32 = 10;

/// Puts this thread, and every thread that it starts from now on, behind the others of the process.
///
/// On Linux each thread has its own niceness and hands it on. A system that refuses leaves everything as it was.
pub fn step_behind() {
    let lowered = getpriority_process(None).and_then(|own| setpriority_process(None, own + STEPS_BEHIND));
    if let Err(refused) = lowered {
        log::warn!("mapping runs with the priority of tracking, because the system refused a lower one: {refused}");
    }
}

/// Calls `set_up` on a thread that stands behind the others, so that all threads that it starts do.
///
/// # Errors
/// What the operating system said when it refused the thread.
pub fn behind<T: Send>(set_up: impl FnOnce() -> T + Send) -> std::io::Result<T> {
    std::thread::scope(|scope| {
        let thread = std::thread::Builder::new().name("set-up".to_owned()).spawn_scoped(scope, || {
            step_behind();
            set_up()
        })?;
        Ok(thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn threads_of_a_thread_behind_are_behind_and_the_caller_is_not() {
        let niceness = || getpriority_process(None).expect("a niceness");
        let own = niceness();
        let theirs = behind(|| [niceness(), std::thread::spawn(niceness).join().expect("a thread")]).expect("a thread");
        assert_eq!(theirs, [(own + STEPS_BEHIND).min(19); 2]);
        assert_eq!(niceness(), own);
    }
}
