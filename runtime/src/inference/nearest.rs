//! Which rows of numbers are most alike: descriptors of unit length, compared by their product.

use tract_onnx::prelude::tract_ndarray::{Array2, ArrayView2, linalg::general_mat_mul};

/// Numbers of the table of likeness that are in memory at once: 8 MiB.
const TABLE_NUMBERS: usize = 1 << 21;

/// Pairs of rows of `first` and `second` that are most alike from both sides.
pub(super) fn mutual(first: &[f32], second: &[f32], n_channels: usize) -> Vec<(usize, usize)> {
    let mut best_first = vec![(usize::MAX, f32::NEG_INFINITY); second.len() / n_channels];
    let mut best_second = Vec::with_capacity(first.len() / n_channels);
    each_row(first, second, n_channels, |i, likeness| {
        let mut best = (usize::MAX, f32::NEG_INFINITY);
        for (j, (&likeness, of_second)) in likeness.iter().zip(&mut best_first).enumerate() {
            if likeness > best.1 {
                best = (j, likeness);
            }
            if likeness > of_second.1 {
                *of_second = (i, likeness);
            }
        }
        best_second.push(best.0);
    });
    let is_mutual = |&(i, j): &(usize, usize)| best_first.get(j).is_some_and(|(first, _)| *first == i);
    best_second.into_iter().enumerate().filter(is_mutual).collect()
}

/// For each row of `first`, the row of `second` that is most like it, and how alike they are.
pub(super) fn best(first: &[f32], second: &[f32], n_channels: usize) -> Vec<(usize, f32)> {
    let mut found = Vec::with_capacity(first.len() / n_channels);
    each_row(first, second, n_channels, |_, likeness| {
        let better =
            |best: (usize, f32), (j, &likeness): (usize, &f32)| if likeness > best.1 { (j, likeness) } else { best };
        found.push(likeness.iter().enumerate().fold((usize::MAX, f32::NEG_INFINITY), better));
    });
    found
}

/// Shows how alike each row of `first` is to all of `second`, in blocks that bound the memory.
fn each_row(first: &[f32], second: &[f32], n_channels: usize, mut see: impl FnMut(usize, &[f32])) {
    let n_second = second.len() / n_channels;
    let Ok(second) = ArrayView2::from_shape((n_second, n_channels), second) else { return };
    let n_at_once = (TABLE_NUMBERS / n_second.max(1)).max(1);
    let mut table = Array2::zeros((0, 0));
    for (block, rows) in first.chunks(n_at_once * n_channels).enumerate() {
        let Ok(rows) = ArrayView2::from_shape((rows.len() / n_channels, n_channels), rows) else { return };
        if table.nrows() != rows.nrows() {
            table = Array2::zeros((rows.nrows(), n_second));
        }
        general_mat_mul(1.0, &rows, &second.t(), 0.0, &mut table);
        for (row, likeness) in table.rows().into_iter().enumerate() {
            see(block * n_at_once + row, likeness.as_slice().unwrap_or_default());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const N_CHANNELS: usize = 64;

    fn unit(at: usize, size: f32) -> Vec<f32> {
        let mut row = vec![0.0; N_CHANNELS];
        row[at % N_CHANNELS] = size;
        row
    }

    /// Weak copies of channel 7, more than one block of rows beside a second that is as long.
    fn many(n: usize) -> Vec<f32> {
        (0..n).flat_map(|_| unit(7, 0.1)).collect()
    }

    #[test]
    fn neighbours_are_found_across_blocks_of_rows() {
        let n = 2000;
        let mut first = many(n);
        first.splice(1950 * N_CHANNELS..1951 * N_CHANNELS, unit(7, 1.0));
        first.splice(3 * N_CHANNELS..4 * N_CHANNELS, unit(9, 1.0));
        let mut second = many(n);
        second.splice(0..2 * N_CHANNELS, [unit(9, 1.0), unit(7, 1.0)].concat());
        assert!(n * n > TABLE_NUMBERS, "a block is not enough");
        assert_eq!(mutual(&first, &second, N_CHANNELS), [(3, 0), (1950, 1)]);
        assert_eq!(mutual(&first, &[], N_CHANNELS), []);
        let found = best(&first, &second, N_CHANNELS);
        assert_eq!((found[3], found[1950], found[10].0, found.len()), ((0, 1.0), (1, 1.0), 1, n));
    }
}
