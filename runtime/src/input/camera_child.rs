//! The camera process of a replay: this program again, as a child.

use std::ffi::OsString;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use super::InputError;

/// A camera process that ends with its owner.
pub struct CameraChild {
    child: Child,
    status: Option<ExitStatus>,
}

impl CameraChild {
    /// Starts the own executable with `arguments` (the hidden subcommand first). Its messages go to our stderr.
    ///
    /// # Errors
    /// [`InputError::Start`] when the program cannot be started.
    pub fn start<Argument: Into<OsString>>(arguments: impl IntoIterator<Item = Argument>) -> Result<Self, InputError> {
        let failed = |program: String| move |source| InputError::Start { program, source };
        let program = std::env::current_exe().map_err(failed("(own executable)".to_owned()))?;
        let child = Command::new(&program)
            .args(arguments.into_iter().map(Into::into))
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .spawn()
            .map_err(failed(program.display().to_string()))?;
        Ok(Self { child, status: None })
    }

    /// Process number.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// How it ended, `None` while it runs.
    pub fn exit_status(&mut self) -> Option<ExitStatus> {
        if self.status.is_none() {
            self.status = self.child.try_wait().ok().flatten();
        }
        self.status
    }

    /// Waits for its end, at most `timeout`.
    pub fn wait(&mut self, timeout: Duration) -> Option<ExitStatus> {
        const LOOK_INTERVAL: Duration = Duration::from_millis(5);
        let started = Instant::now();
        while self.exit_status().is_none() && started.elapsed() < timeout {
            std::thread::sleep(LOOK_INTERVAL);
        }
        self.status
    }
}

impl Drop for CameraChild {
    fn drop(&mut self) {
        if self.exit_status().is_none() && (self.child.kill().is_err() || self.child.wait().is_err()) {
            log::warn!("the camera process {} could not be ended", self.child.id());
        }
    }
}
