//! Semi-global aggregation: depths that change little from pixel to pixel are likelier.

use super::sweep::N_LABELS;
use crate::map::insertion::MapImageSize;

/// Penalties of a change of depth between neighbours, in bits of census distance.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Penalties {
    /// For one label: surfaces slant.
    pub slant: u16,
    /// For any jump, across a plain neighbourhood.
    pub jump: u16,
    /// Brightness difference at which a jump costs half, grey levels.
    pub half_at_difference: u16,
}

/// The eight neighbours that a path may come from.
const DIRECTIONS: [(isize, isize); 8] = [(1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1)];

/// Elements that [`aggregate`] needs as scratch for one image width.
pub const fn scratch_len(width: usize) -> usize {
    2 * width * N_LABELS
}

/// Adds up the cheapest paths from eight directions into `total`, pixel by pixel; `scratch` holds two rows.
///
/// `L(p, d) = C(p, d) + min(L(q, d), L(q, d +- 1) + slant, min L(q) + jump) - min L(q)`.
///
/// # Source
/// Hirschmueller 2008, "Stereo processing by semiglobal matching and mutual information", eq. 13.
pub fn aggregate(
    cost: &[u8],
    luma: &[u8],
    size: MapImageSize,
    penalties: &Penalties,
    scratch: &mut [u16],
    total: &mut [u16],
) {
    total.fill(0);
    for direction in DIRECTIONS {
        follow(direction, cost, luma, size, penalties, scratch, total);
    }
}

/// One direction: rows and columns in the order in which the paths run.
fn follow(
    (dx, dy): (isize, isize),
    cost: &[u8],
    luma: &[u8],
    size: MapImageSize,
    penalties: &Penalties,
    scratch: &mut [u16],
    total: &mut [u16],
) {
    let MapImageSize { width, height } = size;
    let Some((mut previous_row, mut row)) = scratch.split_at_mut_checked(width * N_LABELS) else { return };
    for step_y in 0..height {
        let y = if dy < 0 { height - 1 - step_y } else { step_y };
        for step_x in 0..width {
            let x = if dx < 0 { width - 1 - step_x } else { step_x };
            let from_x = x.checked_add_signed(-dx).filter(|&x| x < width);
            let from_y = y.checked_add_signed(-dy).filter(|&y| y < height);
            let mut before = [0u16; N_LABELS];
            let mut jump = 0;
            if let (Some(from_x), Some(from_y)) = (from_x, from_y) {
                let source = if dy == 0 { &*row } else { &*previous_row };
                if let Some(path) = source.get(from_x * N_LABELS..(from_x + 1) * N_LABELS) {
                    before.copy_from_slice(path);
                }
                let at = |x: usize, y: usize| u16::from(luma.get(y * width + x).copied().unwrap_or(0));
                let difference = at(x, y).abs_diff(at(from_x, from_y));
                let half = penalties.half_at_difference.max(1);
                jump = (penalties.jump * half / (half + difference)).max(penalties.slant);
            }
            let pixel = (y * width + x) * N_LABELS;
            let (Some(cost), Some(total), Some(path)) = (
                cost.get(pixel..pixel + N_LABELS),
                total.get_mut(pixel..pixel + N_LABELS),
                row.get_mut(x * N_LABELS..(x + 1) * N_LABELS),
            ) else {
                return;
            };
            extend_path(&before, cost, penalties.slant, jump, path, total);
        }
        core::mem::swap(&mut previous_row, &mut row);
    }
}

/// Hirschmueller's recurrence for all labels of one pixel.
fn extend_path(before: &[u16; N_LABELS], cost: &[u8], slant: u16, jump: u16, path: &mut [u16], total: &mut [u16]) {
    let cheapest = before.iter().copied().fold(u16::MAX, u16::min);
    let mut padded = [u16::MAX / 2; N_LABELS + 2];
    for (slot, &value) in padded.iter_mut().skip(1).zip(before) {
        *slot = value;
    }
    for ((((window, &cost), path), total), _) in
        padded.windows(3).zip(cost).zip(path.iter_mut()).zip(total.iter_mut()).zip(0..N_LABELS)
    {
        let [nearer, same, farther] = [0, 1, 2].map(|i| window.get(i).copied().unwrap_or(u16::MAX / 2));
        let reached = same.min(nearer + slant).min(farther + slant).min(cheapest + jump);
        *path = u16::from(cost) + reached - cheapest;
        *total += *path;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::vec;

    const SIZE: MapImageSize = MapImageSize { width: 7, height: 5 };
    const PENALTIES: Penalties = Penalties { slant: 3, jump: 20, half_at_difference: 10 };

    /// Cheapest label of every pixel when only the pixels in `told` say one.
    fn labels(told: impl Fn(usize, usize) -> Option<usize>, luma: &[u8]) -> vec::Vec<usize> {
        let mut cost = vec![10u8; SIZE.n_pixels() * N_LABELS];
        for index in 0..SIZE.n_pixels() {
            if let Some(label) = told(index % SIZE.width, index / SIZE.width) {
                cost[index * N_LABELS..][..N_LABELS].fill(30);
                cost[index * N_LABELS + label] = 0;
            }
        }
        let mut scratch = vec![0; scratch_len(SIZE.width)];
        let mut total = vec![0; cost.len()];
        aggregate(&cost, luma, SIZE, &PENALTIES, &mut scratch, &mut total);
        let cheapest = |total: &[u16]| (0..N_LABELS).min_by_key(|&label| total[label]).unwrap_or(0);
        total.chunks_exact(N_LABELS).map(cheapest).collect()
    }

    #[test]
    fn pixels_that_cannot_tell_take_the_depth_of_those_that_can() {
        let found = labels(|x, y| ((x, y) == (3, 2)).then_some(40), &[7; 35]);
        let on_a_path = |x: usize, y: usize| x == 3 || y == 2 || x.abs_diff(3) == y.abs_diff(2);
        assert!((0..35).filter(|i| on_a_path(i % 7, i / 7)).all(|i| found[i] == 40), "{found:?}");
    }

    #[test]
    fn a_jump_of_depth_falls_on_the_edge_of_the_picture() {
        let luma: vec::Vec<u8> = (0..35).map(|i| if i % 7 < 4 { 20 } else { 220 }).collect();
        let told = |x: usize, _| match x {
            0 => Some(30),
            6 => Some(60),
            _ => None,
        };
        let found = labels(told, &luma);
        assert!(found.iter().enumerate().all(|(i, &label)| label == if i % 7 < 4 { 30 } else { 60 }), "{found:?}");
    }
}
