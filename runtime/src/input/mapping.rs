//! Shows that a pointer lies in memory shared between processes.

use std::fs::File;
use std::io::{BufRead, BufReader};

/// A range of this process's memory that is mapped from shared memory.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SharedMapping {
    /// First address.
    pub start: usize,
    /// One past the last address.
    pub end: usize,
    /// Whether this process can write there.
    pub is_writable: bool,
    /// The shared memory object, for example `/dev/shm/iox2_...`.
    pub path: String,
}

impl SharedMapping {
    /// The shared mapping that holds all of `bytes`, `None` when they lie in private memory.
    pub fn holding(bytes: &[u8]) -> Option<Self> {
        let range = bytes.as_ptr_range();
        let (start, end) = (range.start.addr(), range.end.addr());
        let lines = BufReader::new(File::open("/proc/self/maps").ok()?).lines();
        lines
            .map_while(Result::ok)
            .filter_map(|line| parse(&line))
            .find(|mapping| mapping.start <= start && end <= mapping.end)
    }
}

/// Reads a line of `/proc/self/maps` such as `7f00-7f10 r--s 00000000 00:1a 12   /dev/shm/name`.
fn parse(line: &str) -> Option<SharedMapping> {
    let mut words = line.split_whitespace();
    let (start, end) = words.next()?.split_once('-')?;
    let permissions = words.next()?;
    let path = words.nth(3)?;
    let mapping = SharedMapping {
        start: usize::from_str_radix(start, 16).ok()?,
        end: usize::from_str_radix(end, 16).ok()?,
        is_writable: permissions.contains('w'),
        path: path.to_owned(),
    };
    (permissions.ends_with('s') && path.starts_with("/dev/shm/")).then_some(mapping)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_shared_memory_objects_count() {
        let check = |line: &str, expected: Option<(usize, usize, bool)>| {
            assert_eq!(parse(line).map(|m| (m.start, m.end, m.is_writable)), expected, "{line}");
        };
        check("7f00-7f10 r--s 00000000 00:1a 12   /dev/shm/name", Some((0x7f00, 0x7f10, false)));
        check("7f00-7f10 rw-s 00000000 00:1a 12   /dev/shm/name", Some((0x7f00, 0x7f10, true)));
        check("7f00-7f10 rw-p 00000000 00:1a 12   /dev/shm/name", None);
        check("7f00-7f10 rw-s 00000000 00:1a 12   /tmp/name", None);
        check("7f00-7f10 rw-p 00000000 00:00 0", None);
        check("", None);
    }

    #[test]
    fn the_heap_is_not_shared() {
        assert_eq!(SharedMapping::holding(&vec![1; 100_000]), None);
    }
}
