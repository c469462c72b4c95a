//! Gradients of a splat are the sum over the rows of tiles it meets, always added from the top row down.

use super::grid::Grid;
use super::splats::{Lists, MAX_JOBS, N_SPLAT_GRADS, piece_len};
use crate::pool::Pool;

/// Sums the entries' gradients into `splat_grads`.
pub fn reduce(pool: &Pool, grid: &Grid, n_splats: usize, lists: &mut Lists) {
    let Lists { entries, entry_grads, entry_starts, splat_grads, .. } = lists;
    let len = piece_len(n_splats);
    let mut jobs = heapless::Vec::<_, MAX_JOBS>::new();
    for (i, out) in splat_grads[..n_splats].chunks_mut(len).enumerate() {
        if jobs.push((i * len, out)).is_err() {
            unreachable!("piece_len makes at most MAX_JOBS pieces");
        }
    }
    pool.for_each(&mut jobs, |_, (first, out)| {
        out.fill([0.0; N_SPLAT_GRADS]);
        for row in entry_starts[..=grid.rows].windows(2) {
            let (entries, grads) = (&entries[row[0]..row[1]], &entry_grads[row[0]..row[1]]);
            let start = entries.partition_point(|entry| (entry.splat as usize) < *first);
            for (entry, grad) in entries.iter().zip(grads).skip(start) {
                let Some(total) = out.get_mut(entry.splat as usize - *first) else { break };
                for (total, part) in total.iter_mut().zip(grad) {
                    *total += part;
                }
            }
        }
    });
}
