//! The camera process of a replay: this program again, as a child.

use std::ffi::OsString;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use super::InputError;

/// A camera process that ends with its owner.
pub struct CameraChild {
    child: Child,
    rss_peak_bytes: u64,
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
        Ok(Self { child, rss_peak_bytes: 0, status: None })
    }

    /// Process number.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// The most resident memory it was seen with; call it now and then, because nothing can be read of an ended one.
    pub fn rss_peak_bytes(&mut self) -> u64 {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id())).unwrap_or_default();
        self.rss_peak_bytes = self.rss_peak_bytes.max(peak_rss_bytes(&status).unwrap_or(0));
        self.rss_peak_bytes
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

/// `VmHWM` out of a `/proc/<pid>/status`.
fn peak_rss_bytes(status: &str) -> Option<u64> {
    const BYTES_PER_KIB: u64 = 1024;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    Some(line.trim().strip_suffix(" kB")?.parse::<u64>().ok()? * BYTES_PER_KIB)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_peak_is_read_from_the_status() {
        assert_eq!(peak_rss_bytes("Name:\tx\nVmPeak:\t 9 kB\nVmHWM:\t   1234 kB\n"), Some(1234 * 1024));
        assert_eq!(peak_rss_bytes("Name:\tx\n"), None);
    }
}
