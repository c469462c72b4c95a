//! Several runs at once.

use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Does `work` on every item, at most `jobs` at once; the results are in the order of the items.
pub(super) fn run_all<Item: Sync, Found: Send>(
    jobs: usize,
    items: &[Item],
    work: impl Fn(&Item) -> Found + Sync,
) -> Vec<Found> {
    let next = AtomicUsize::new(0);
    let found = Mutex::new(Vec::new());
    std::thread::scope(|scope| {
        for _ in 0..jobs.min(items.len()) {
            scope.spawn(|| {
                while let Some((i, item)) = items.iter().enumerate().nth(next.fetch_add(1, Ordering::Relaxed)) {
                    let result = work(item);
                    found.lock().unwrap_or_else(std::sync::PoisonError::into_inner).push((i, result));
                }
            });
        }
    });
    let mut found = found.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner);
    found.sort_by_key(|(i, _)| *i);
    found.into_iter().map(|(_, result)| result).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_item_is_worked_on_once_and_order_is_kept() {
        for jobs in [1, 3, 50] {
            assert_eq!(run_all(jobs, &[3, 1, 2, 9, 4], |n| n * 10), [30, 10, 20, 90, 40]);
        }
        assert!(run_all(2, &[] as &[u8], |n| *n).is_empty());
    }
}
