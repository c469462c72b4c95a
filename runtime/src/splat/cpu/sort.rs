//! Splats by depth, nearest first.

use super::splats::{Lists, MAX_JOBS, Splat, piece_len};
use super::splatting::NOT_VISIBLE;
use crate::pool::Pool;

/// Bits per pass; three passes cover the 32 bits of a depth.
const RADIX_BITS: u32 = 11;
const RADIX: usize = 1 << RADIX_BITS;
const PASSES: usize = 3;
/// The low half of a key is the candidate's number.
const DEPTH_SHIFT: u32 = 32;

/// Sorts the visible candidates and copies their splats into depth order; equal depths keep their order.
/// Returns how many there are.
///
/// # Source
/// Least-significant-digit radix sort on the bit pattern of positive floats; own implementation.
pub fn sort(pool: &Pool, n_candidates: usize, lists: &mut Lists) -> usize {
    let mut counts = [[0u32; RADIX]; PASSES];
    let mut n = 0;
    lists.ranks[..n_candidates].fill(u32::MAX);
    for i in 0..n_candidates {
        let key = lists.keys[i];
        if key != NOT_VISIBLE {
            lists.keys[n] = key;
            n += 1;
            for (pass, counts) in counts.iter_mut().enumerate() {
                counts[digit(key, pass)] += 1;
            }
        }
    }
    let (mut from, mut to) = (&mut lists.keys[..n], &mut lists.keys_scratch[..n]);
    for (pass, counts) in counts.iter_mut().enumerate() {
        let mut start = 0;
        for count in counts.iter_mut() {
            start += core::mem::replace(count, start);
        }
        for &key in from.iter() {
            let position = &mut counts[digit(key, pass)];
            to[*position as usize] = key;
            *position += 1;
        }
        core::mem::swap(&mut from, &mut to);
    }
    for (rank, &key) in from.iter().enumerate() {
        lists.ranks[key as u32 as usize] = rank as u32;
    }
    copy_in_order(pool, from, &lists.splats, &mut lists.sorted[..n]);
    n
}

fn copy_in_order(pool: &Pool, order: &[u64], splats: &[Splat], sorted: &mut [Splat]) {
    let len = piece_len(order.len());
    let mut jobs = heapless::Vec::<_, MAX_JOBS>::new();
    for job in order.chunks(len).zip(sorted.chunks_mut(len)) {
        if jobs.push(job).is_err() {
            unreachable!("piece_len makes at most MAX_JOBS pieces");
        }
    }
    pool.for_each(&mut jobs, |_, (order, sorted)| {
        for (key, splat) in order.iter().zip(sorted.iter_mut()) {
            *splat = splats[*key as u32 as usize];
        }
    });
}

#[inline(always)]
fn digit(key: u64, pass: usize) -> usize {
    (key >> (DEPTH_SHIFT + RADIX_BITS * pass as u32)) as usize % RADIX
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::splat::Capacities;
    use kilogs_core::math::rng::Rng;

    fn sorted_depths(depths_m: &[Option<f32>]) -> (Vec<f32>, Vec<u32>) {
        let mut lists = Lists::new(&Capacities::for_map(depths_m.len().max(1), 1, 16, 16));
        for (i, depth) in depths_m.iter().enumerate() {
            lists.splats[i].depth_m = depth.unwrap_or(f32::NAN);
            lists.keys[i] = depth.map_or(NOT_VISIBLE, |d| (u64::from(d.to_bits()) << DEPTH_SHIFT) | i as u64);
        }
        let pool = Pool::new(2, |_| ()).expect("threads");
        let n = sort(&pool, depths_m.len(), &mut lists);
        (lists.sorted[..n].iter().map(|s| s.depth_m).collect(), lists.ranks[..depths_m.len()].to_vec())
    }

    #[test]
    fn small_cases_by_hand() {
        let hidden = u32::MAX;
        assert_eq!(sorted_depths(&[]), (vec![], vec![]));
        assert_eq!(sorted_depths(&[None]), (vec![], vec![hidden]));
        assert_eq!(
            sorted_depths(&[Some(3.0), None, Some(0.5), Some(700.0)]),
            (vec![0.5, 3.0, 700.0], vec![1, hidden, 0, 2])
        );
    }

    #[test]
    fn equal_depths_keep_their_order() {
        assert_eq!(sorted_depths(&[Some(2.0), Some(1.0), Some(2.0), Some(1.0)]).1, vec![2, 0, 3, 1]);
    }

    #[test]
    fn many_depths_agree_with_the_library_sort() {
        let mut rng = Rng::new(1, 2, 3);
        let depths: Vec<f32> = (0..5000).map(|_| (rng.unit_f32() * 12.0 - 4.0).exp()).collect();
        let mut expected = depths.clone();
        expected.sort_by(f32::total_cmp);
        assert_eq!(sorted_depths(&depths.iter().map(|&d| Some(d)).collect::<Vec<_>>()).0, expected);
    }
}
