//! Which junctions are eliminated first, and which blocks that fills.

use super::LoopEdge;
use super::storage::{FactorBlock, Junction, NONE, SolverFull, SolverSlice, SolverStorage};
use core::ops::RangeInclusive;

const WORD: usize = u64::BITS as usize;

/// Numbers the nodes of a part of the chain that loops touch, orders them, and lists the blocks of their factor.
///
/// The first node of the part is held and takes no part. Exact minimum degree: the junction with the fewest neighbors
/// goes first, and its neighbors become neighbors of each other; of equals the earliest in the chain.
///
/// # Source
/// Rose 1970; George & Liu 1989, "The evolution of the minimum degree ordering algorithm", sec. 2. Own implementation.
pub(super) fn order_junctions(
    part: &RangeInclusive<usize>,
    loops: &[LoopEdge],
    work: &mut SolverStorage<'_>,
) -> Result<usize, SolverFull> {
    let n = number_junctions(part, loops, work)?;
    let words = n.div_ceil(WORD);
    SolverFull::unless(n * words <= work.neighbors.len(), SolverSlice::Neighbors, n * words)?;
    connect(part, loops, n, words, work);
    for place in 0..n {
        let alive = (0..n).filter(|&id| work.junctions[id].place == NONE);
        let Some(next) = alive.min_by_key(|&id| work.junctions[id].degree) else { break };
        work.junctions[next].place = place as u32;
        work.junctions[place].at = next as u32;
        eliminate(next, n, words, work);
    }
    list_blocks(n, words, work)?;
    Ok(n)
}

fn number_junctions(
    part: &RangeInclusive<usize>,
    loops: &[LoopEdge],
    work: &mut SolverStorage<'_>,
) -> Result<usize, SolverFull> {
    SolverFull::unless(*part.end() < work.columns.len(), SolverSlice::Columns, part.end() + 1)?;
    for column in &mut work.columns[part.clone()] {
        column.junction = NONE;
    }
    for end in loops.iter().flat_map(|l| l.ends).filter(|end| end != part.start()) {
        work.columns[end].junction = 0;
    }
    let mut n = 0;
    for node in part.clone() {
        if work.columns[node].junction == NONE {
            continue;
        }
        SolverFull::unless(n < work.junctions.len(), SolverSlice::Junctions, n + 1)?;
        work.columns[node].junction = n as u32;
        work.junctions[n] = Junction { node: node as u32, place: NONE, ..Junction::default() };
        n += 1;
    }
    Ok(n)
}

/// Neighbors: along the chain, and across loops.
fn connect(part: &RangeInclusive<usize>, loops: &[LoopEdge], n: usize, words: usize, work: &mut SolverStorage<'_>) {
    work.neighbors[..n * words].fill(0);
    let mut join = |a: usize, b: usize| {
        for (row, column) in [(a, b), (b, a)] {
            work.neighbors[row * words + column / WORD] |= 1 << (column % WORD);
        }
    };
    for a in 1..n {
        join(a - 1, a);
    }
    for [i, j] in loops.iter().map(|l| l.ends).filter(|ends| !ends.contains(part.start())) {
        let (a, b) = (work.columns[i].junction, work.columns[j].junction);
        if a != b {
            join(a as usize, b as usize);
        }
    }
    for id in 0..n {
        work.junctions[id].degree = degree(&work.neighbors[id * words..(id + 1) * words]);
    }
}

fn degree(row: &[u64]) -> u32 {
    row.iter().map(|word| word.count_ones()).sum()
}

fn has(row: &[u64], id: usize) -> bool {
    row[id / WORD] >> (id % WORD) & 1 == 1
}

/// Makes the neighbors of a junction neighbors of each other. Its own row stays: it is the column of the factor.
fn eliminate(id: usize, n: usize, words: usize, work: &mut SolverStorage<'_>) {
    for other in 0..n {
        if !has(&work.neighbors[id * words..(id + 1) * words], other) {
            continue;
        }
        for word in 0..words {
            work.neighbors[other * words + word] |= work.neighbors[id * words + word];
        }
        let row = &mut work.neighbors[other * words..(other + 1) * words];
        for gone in [id, other] {
            row[gone / WORD] &= !(1 << (gone % WORD));
        }
        work.junctions[other].degree = degree(row);
    }
}

/// Gives each column of the factor its blocks, rows ascending.
fn list_blocks(n: usize, words: usize, work: &mut SolverStorage<'_>) -> Result<(), SolverFull> {
    let needed = work.junctions[..n].iter().map(|j| j.degree as usize).sum();
    SolverFull::unless(needed <= work.blocks.len(), SolverSlice::Blocks, needed)?;
    let mut end = 0;
    for place in 0..n {
        let start = end;
        let id = work.junctions[place].at as usize;
        for other in (0..n).filter(|&other| has(&work.neighbors[id * words..(id + 1) * words], other)) {
            work.blocks[end] = FactorBlock { row: work.junctions[other].place, ..FactorBlock::default() };
            end += 1;
        }
        work.blocks[start..end].sort_unstable_by_key(|b| b.row);
        work.junctions[place].blocks = [start as u32, end as u32];
    }
    Ok(())
}
