//! Solves the normal equations of a part of the chain: interiors of the chain first, then the junctions.
//!
//! # Source
//! Block Cholesky: Golub & Van Loan 2013, sec. 4.2.9; Davis 2006, "Direct methods for sparse linear systems", ch. 4.

use super::block::{backward_solve, cholesky, forward_solve, right_solve, subtract_product};
use super::storage::{Column, FactorBlock, Junction, NONE, SolverStorage};
use crate::math::sim3::Matrix7;
use core::ops::RangeInclusive;

/// Adds to the coupling of two nodes that loops touch: `block` has the rows of the first.
pub(super) fn add_coupling(work: &mut SolverStorage<'_>, rows: usize, columns: usize, block: &Matrix7) {
    let place = |node: usize| work.junctions[work.columns[node].junction as usize].place;
    let (row, column) = (place(rows), place(columns));
    if row > column {
        *block_at(work.junctions, work.blocks, row, column) += block;
    } else {
        *block_at(work.junctions, work.blocks, column, row) += block.transpose();
    }
}

fn block_at<'b>(junctions: &[Junction], blocks: &'b mut [FactorBlock], row: u32, column: u32) -> &'b mut Matrix7 {
    let [start, end] = junctions[column as usize].blocks;
    let blocks = &mut blocks[start as usize..end as usize];
    let found = blocks.partition_point(|b| b.row < row);
    &mut blocks[found].block
}

/// Replaces the gradient by the solution of `H x = gradient`; false when the equations are not positive definite.
pub(super) fn solve(part: &RangeInclusive<usize>, n_junctions: usize, work: &mut SolverStorage<'_>) -> bool {
    if !eliminate_interiors(part, work) || !factor_junctions(n_junctions, work) {
        return false;
    }
    substitute_junctions(n_junctions, work);
    substitute_interiors(part, work);
    true
}

/// Eliminates the nodes between junctions, one after the other: each couples with the next one and with the junction
/// before it only.
fn eliminate_interiors(part: &RangeInclusive<usize>, work: &mut SolverStorage<'_>) -> bool {
    let mut left = NONE;
    for k in part.start() + 1..=*part.end() {
        // Rows of the junction on the left, columns of the next node.
        let coupling;
        if work.columns[k].junction != NONE {
            left = k as u32;
            coupling = work.columns[k].to_next.transpose();
        } else {
            let Some(passed_on) = eliminate_one(work.columns, k, left) else { return false };
            coupling = passed_on;
        }
        if k == *part.end() || left == NONE {
            continue;
        }
        if work.columns[k + 1].junction == NONE {
            work.columns[k + 1].to_left = coupling;
        } else {
            add_coupling(work, left as usize, k + 1, &coupling);
        }
    }
    true
}

/// Eliminates an interior node; what it passes on couples the junction on its left with the next node.
fn eliminate_one(columns: &mut [Column], k: usize, left: u32) -> Option<Matrix7> {
    let this = &mut columns[k];
    this.left = left;
    if !cholesky(&mut this.diagonal) {
        return None;
    }
    this.gradient = forward_solve(&this.diagonal, &this.gradient);
    this.to_next = right_solve(&this.to_next, &this.diagonal);
    let (to_next, gradient) = (this.to_next, this.gradient);
    let mut coupling = Matrix7::zeros();
    if left != NONE {
        this.to_left = right_solve(&this.to_left, &this.diagonal);
        let to_left = this.to_left;
        subtract_product(&mut coupling, &to_left, &to_next);
        let junction = &mut columns[left as usize];
        subtract_product(&mut junction.diagonal, &to_left, &to_left);
        junction.gradient -= to_left * gradient;
    }
    let next = &mut columns[k + 1];
    subtract_product(&mut next.diagonal, &to_next, &to_next);
    next.gradient -= to_next * gradient;
    Some(coupling)
}

/// Right-looking Cholesky over the junctions in their order.
fn factor_junctions(n: usize, work: &mut SolverStorage<'_>) -> bool {
    for place in 0..n {
        let [start, end] = work.junctions[place].blocks.map(|b| b as usize);
        let node = node_at(work.junctions, place as u32);
        let this = &mut work.columns[node];
        if !cholesky(&mut this.diagonal) {
            return false;
        }
        this.gradient = forward_solve(&this.diagonal, &this.gradient);
        let (diagonal, gradient) = (this.diagonal, this.gradient);
        for b in start..end {
            let solved = right_solve(&work.blocks[b].block, &diagonal);
            work.blocks[b].block = solved;
            let other = &mut work.columns[node_at(work.junctions, work.blocks[b].row)];
            subtract_product(&mut other.diagonal, &solved, &solved);
            other.gradient -= solved * gradient;
        }
        for b in start..end {
            update_column(start..end, b, work);
        }
    }
    true
}

/// Subtracts what a column of the factor says about the column of its block `b`, whose rows include all that follow.
fn update_column(column: core::ops::Range<usize>, b: usize, work: &mut SolverStorage<'_>) {
    let FactorBlock { row: target, block: right } = work.blocks[b];
    let [mut place, end] = work.junctions[target as usize].blocks.map(|b| b as usize);
    for below in b + 1..column.end {
        let FactorBlock { row, block } = work.blocks[below];
        while place < end && work.blocks[place].row < row {
            place += 1;
        }
        if place < end {
            subtract_product(&mut work.blocks[place].block, &block, &right);
        }
    }
}

fn substitute_junctions(n: usize, work: &mut SolverStorage<'_>) {
    for place in (0..n).rev() {
        let [start, end] = work.junctions[place].blocks.map(|b| b as usize);
        let node = node_at(work.junctions, place as u32);
        let mut rest = work.columns[node].gradient;
        for b in &work.blocks[start..end] {
            rest -= b.block.tr_mul(&work.columns[node_at(work.junctions, b.row)].gradient);
        }
        work.columns[node].gradient = backward_solve(&work.columns[node].diagonal, &rest);
    }
}

fn substitute_interiors(part: &RangeInclusive<usize>, work: &mut SolverStorage<'_>) {
    for k in (part.start() + 1..*part.end()).rev() {
        let this = work.columns[k];
        if this.junction != NONE {
            continue;
        }
        let mut rest = this.gradient - this.to_next.tr_mul(&work.columns[k + 1].gradient);
        if this.left != NONE {
            rest -= this.to_left.tr_mul(&work.columns[this.left as usize].gradient);
        }
        work.columns[k].gradient = backward_solve(&this.diagonal, &rest);
    }
}

fn node_at(junctions: &[Junction], place: u32) -> usize {
    let id = junctions[place as usize].at;
    junctions[id as usize].node as usize
}
