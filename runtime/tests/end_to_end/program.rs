//! One run of the binary, under a deadline.

use std::ffi::OsStr;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant, SystemTime};
use tempfile::NamedTempFile;

/// Longer than anything here takes on a busy machine; a run that is still there then hangs.
pub const DEADLINE: Duration = Duration::from_secs(240);

const LOOK_INTERVAL: Duration = Duration::from_millis(10);

/// A running program that does not outlive its test.
pub struct Program {
    child: Child,
    stderr: NamedTempFile,
    line: String,
}

/// How a program ended.
#[derive(Debug)]
pub struct Ended {
    /// Its exit code, `None` after a signal.
    pub code: Option<i32>,
    /// What it said.
    pub stderr: String,
}

/// Runs `kilogs` to its end.
pub fn kilogs<Word: AsRef<OsStr>>(words: impl IntoIterator<Item = Word>) -> Ended {
    Program::start(words).wait()
}

/// Runs `kilogs` to its end, which must be a success.
pub fn kilogs_succeeds<Word: AsRef<OsStr>>(words: impl IntoIterator<Item = Word>) -> Ended {
    let program = Program::start(words);
    let line = program.line.clone();
    let ended = program.wait();
    assert_eq!(ended.code, Some(0), "{line}\n{}", ended.stderr);
    ended
}

impl Program {
    /// Starts `kilogs`.
    pub fn start<Word: AsRef<OsStr>>(words: impl IntoIterator<Item = Word>) -> Self {
        Self::start_with(words, None)
    }

    /// Starts `kilogs` with variables of its own in its environment.
    pub fn start_with<Word: AsRef<OsStr>>(
        words: impl IntoIterator<Item = Word>,
        variables: impl IntoIterator<Item = (&'static str, String)>,
    ) -> Self {
        let stderr = NamedTempFile::new().expect("a temporary file");
        let mut command = Command::new(env!("CARGO_BIN_EXE_kilogs"));
        command.args(words).env_remove("RUST_LOG").env_remove("KILOGS_SEAL_TRACE").envs(variables);
        let line = format!("{command:?}");
        let to_file = stderr.reopen().expect("the temporary file");
        let child = command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(to_file).spawn();
        Self { child: child.expect("the program starts"), stderr, line }
    }

    /// Waits for its end.
    pub fn wait(mut self) -> Ended {
        let started = Instant::now();
        loop {
            if let Some(status) = self.child.try_wait().expect("a child") {
                return Ended { code: status.code(), stderr: self.said() };
            }
            assert!(started.elapsed() < DEADLINE, "hangs: {}\n{}", self.line, self.said());
            std::thread::sleep(LOOK_INTERVAL);
        }
    }

    /// Waits until it has said `text` for the `n`-th time; returns how long that took.
    pub fn wait_for(&mut self, text: &str, n: usize) -> Duration {
        let started = Instant::now();
        while self.said().matches(text).count() < n {
            let ended = self.child.try_wait().expect("a child");
            let is_over = ended.is_some() || started.elapsed() >= DEADLINE;
            assert!(!is_over, "not said: \"{text}\", ended: {ended:?}: {}\n{}", self.line, self.said());
            std::thread::sleep(LOOK_INTERVAL);
        }
        started.elapsed()
    }

    /// How long after `moment` it said `text` for the last time, by its own clock: lines begin with
    /// `[2026-01-31T23:59:59.123Z `.
    pub fn said_after(&self, moment: SystemTime, text: &str) -> Duration {
        const DAY_MS: i64 = 86_400_000;
        let said = self.said();
        let line = said.lines().rfind(|line| line.contains(text)).expect("it was said");
        let clock = line.split(['T', 'Z']).nth(1).expect("a time");
        let parts: Vec<i64> = clock.split([':', '.']).map(|part| part.parse().expect("a time")).collect();
        let &[hours, minutes, seconds, milliseconds] = parts.as_slice() else { panic!("no time: {line}") };
        let said_ms = ((hours * 60 + minutes) * 60 + seconds) * 1000 + milliseconds;
        let moment_ms = moment.duration_since(SystemTime::UNIX_EPOCH).expect("after 1970").as_millis() as i64;
        Duration::from_millis((said_ms - moment_ms).rem_euclid(DAY_MS).unsigned_abs())
    }

    /// What it has said so far.
    pub fn said(&self) -> String {
        std::fs::read_to_string(self.stderr.path()).expect("what was said")
    }

    /// Ends it as Ctrl-C does.
    pub fn interrupt(&self) {
        signal("INT", self.child.id());
    }

    /// Lets it stand still as it is.
    pub fn stop(&self) {
        signal("STOP", self.child.id());
    }

    /// Ends it without a word.
    pub fn kill(mut self) {
        self.child.kill().expect("SIGKILL");
        self.child.wait().expect("its end");
    }

    /// Ends the process that it started, without a word, as soon as there is one.
    pub fn kill_child(&self) {
        let path = format!("/proc/{0}/task/{0}/children", self.child.id());
        let started = Instant::now();
        loop {
            let children = std::fs::read_to_string(&path).expect("the kernel lists children");
            match children.split_whitespace().next() {
                Some(id) => return signal("KILL", id.parse().expect("a process number")),
                None => assert!(started.elapsed() < DEADLINE, "{} starts no process", self.line),
            }
            std::thread::sleep(LOOK_INTERVAL);
        }
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        // It has ended, or its test failed.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn signal(name: &str, process: u32) {
    let sent = Command::new("sh").args(["-c", &format!("kill -{name} {process}")]).status();
    assert!(sent.expect("a shell").success(), "{process} takes no SIG{name}");
}

/// A path as a word of the command line.
pub fn word(path: &Path) -> String {
    path.to_str().expect("temporary folders have plain names").to_owned()
}
