//! Results on standard output.

use std::io::{self, ErrorKind, Write};

/// Writes a result, whole. A reader that has seen enough, such as `head`, ends it without an error.
///
/// # Errors
/// What the system says when standard output does not take it, a full disk behind it for instance.
pub fn show(text: &str) -> io::Result<()> {
    show_on(&mut io::stdout().lock(), text)
}

fn show_on(out: &mut impl Write, text: &str) -> io::Result<()> {
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(()),
        shown => shown,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Takes nothing, for one reason.
    struct Shut(ErrorKind);

    impl Write for Shut {
        fn write(&mut self, _: &[u8]) -> io::Result<usize> {
            Err(self.0.into())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn only_a_reader_that_left_is_no_error() {
        let kind = |kind| show_on(&mut Shut(kind), "figures").map_err(|error| error.kind());
        assert_eq!(kind(ErrorKind::BrokenPipe), Ok(()));
        assert_eq!(kind(ErrorKind::StorageFull), Err(ErrorKind::StorageFull));
        let mut taken = Vec::new();
        assert!(show_on(&mut taken, "figures").is_ok() && taken == b"figures");
    }
}
