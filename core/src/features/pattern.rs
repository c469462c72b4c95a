//! Which pairs of pixels a descriptor compares, turned into every direction.

use crate::math::Rng;

/// Directions that a patch is told to point in.
pub(super) const DIRECTIONS: usize = 32;

/// Comparisons of a descriptor.
pub(super) const PAIRS: usize = 256;

/// Side of the patch that the comparisons look at, px.
pub(super) const PATCH: usize = 32;

/// Farthest pixel from the centre of the patch, at `PATCH / 2`, px.
pub(super) const RADIUS: i32 = 13;

/// Positions in the patch, row by row: the first and the second pixel of each pair, in each direction.
pub(super) static PATTERN: [[[u16; 2]; PAIRS]; DIRECTIONS] = pattern();

/// Cosine and sine of each direction.
pub(super) const TURNS: [[f32; 2]; DIRECTIONS] = {
    // Of a turn's thirty-second part.
    const STEP: [f64; 2] = [0.980_785_280_403_230_4, 0.195_090_322_016_128_27];
    let mut turns = [[0.0; 2]; DIRECTIONS];
    let (mut cos, mut sin) = (1.0, 0.0);
    let mut k = 0;
    while k < DIRECTIONS {
        turns[k] = [cos as f32, sin as f32];
        (cos, sin) = (cos * STEP[0] - sin * STEP[1], sin * STEP[0] + cos * STEP[1]);
        k += 1;
    }
    turns
};

/// Draws points that are dense in the middle, as the best of the patterns that Calonder et al. 2010 compare, and turns them.
const fn pattern() -> [[[u16; 2]; PAIRS]; DIRECTIONS] {
    let mut rng = Rng::new(0, 0, 0x4252_4945);
    let mut pattern = [[[0; 2]; PAIRS]; DIRECTIONS];
    let mut pair = 0;
    while pair < PAIRS {
        let (a, b) = (point(&mut rng), point(&mut rng));
        let (dx, dy) = (a[0] - b[0], a[1] - b[1]);
        // Smoothed pixels next to each other are nearly the same.
        if dx * dx + dy * dy < 16 {
            continue;
        }
        let mut k = 0;
        while k < DIRECTIONS {
            pattern[k][pair] = [position(a, TURNS[k]), position(b, TURNS[k])];
            k += 1;
        }
        pair += 1;
    }
    pattern
}

const fn point(rng: &mut Rng) -> [i32; 2] {
    loop {
        let [x, y] = [coordinate(rng), coordinate(rng)];
        if x * x + y * y <= RADIUS * RADIUS {
            return [x, y];
        }
    }
}

/// Three dice with ten faces: nearly normal, with a standard deviation of 5 px.
const fn coordinate(rng: &mut Rng) -> i32 {
    (rng.below(10) + rng.below(10) + rng.below(10)) as i32 - 13
}

const fn position([x, y]: [i32; 2], [cos, sin]: [f32; 2]) -> u16 {
    let (x, y) = (x as f32, y as f32);
    // The center is added before the cast, which rounds towards zero.
    let center = (PATCH / 2) as f32 + 0.5;
    let (column, row) = ((center + cos * x - sin * y) as usize, (center + sin * x + cos * y) as usize);
    (row * PATCH + column) as u16
}
