//! Comparers of pictures and gradients, which are themselves tested to fail.

/// Why two pictures or gradients are not the same.
#[derive(Debug, PartialEq)]
pub enum Difference {
    /// Nothing to compare, or different lengths.
    Shape { got: usize, expected: usize },
    /// More values beyond the tolerance than a discontinuity explains.
    Outliers { n: usize, allowed: usize, worst: f32, at: usize },
    /// Relative error in the L2 norm.
    Relative { error: f64, allowed: f64 },
}

/// Every color or coverage within `tolerance`, except for a share of `band` that lies at a discontinuity.
pub fn compare_pictures(got: &[f32], expected: &[f32], tolerance: f32, band: f64) -> Result<(), Difference> {
    compare(got, expected, |_| tolerance, band)
}

/// As [`compare_pictures`], for depths: `tolerance` is absolute up to a meter and relative beyond.
pub fn compare_depths(got: &[f32], expected: &[f32], tolerance: f32, band: f64) -> Result<(), Difference> {
    compare(got, expected, |expected_m| tolerance * expected_m.abs().max(1.0), band)
}

fn compare(got: &[f32], expected: &[f32], tolerance: impl Fn(f32) -> f32, band: f64) -> Result<(), Difference> {
    if got.len() != expected.len() || got.is_empty() {
        return Err(Difference::Shape { got: got.len(), expected: expected.len() });
    }
    let allowed = (band * got.len() as f64) as usize;
    let (mut n, mut worst, mut at) = (0, 0.0, 0);
    for (i, (&g, &e)) in got.iter().zip(expected).enumerate() {
        let error = (g - e).abs();
        // A NaN on either side is not `same`.
        let same = error <= tolerance(e);
        if !same {
            n += 1;
            if error > worst || error.is_nan() {
                (worst, at) = (error, i);
            }
        }
    }
    if n > allowed { Err(Difference::Outliers { n, allowed, worst, at }) } else { Ok(()) }
}

/// `|got - expected| <= allowed * |expected|` in the L2 norm.
pub fn compare_gradients(got: &[f32], expected: &[f32], allowed: f64) -> Result<f64, Difference> {
    if got.len() != expected.len() || got.is_empty() {
        return Err(Difference::Shape { got: got.len(), expected: expected.len() });
    }
    let difference: f64 = got.iter().zip(expected).map(|(g, e)| (f64::from(*g) - f64::from(*e)).powi(2)).sum();
    let norm: f64 = expected.iter().map(|e| f64::from(*e).powi(2)).sum();
    let error = (difference / norm.max(f64::MIN_POSITIVE)).sqrt();
    if error <= allowed { Ok(error) } else { Err(Difference::Relative { error, allowed }) }
}

#[test]
fn the_picture_comparer_can_fail() {
    let expected: Vec<f32> = (0..1000).map(|i| (i as f32 * 0.37).sin()).collect();
    let changed = |change: &dyn Fn(&mut Vec<f32>)| {
        let mut got = expected.clone();
        change(&mut got);
        compare_pictures(&got, &expected, 1e-4, 0.0)
    };
    assert_eq!(changed(&|_| ()), Ok(()));
    assert!(changed(&|g| g[500] += 1e-3).is_err(), "one wrong element");
    assert!(changed(&|g| g.swap(3, 4)).is_err(), "a swapped pair");
    assert!(changed(&|g| g[7] = f32::NAN).is_err(), "not a number");
    assert!(changed(&|g| g.truncate(999)).is_err(), "a missing element");
    assert!(compare_pictures(&[], &[], 1.0, 1.0).is_err(), "empty");
    assert!(compare_pictures(&[f32::NAN], &[f32::NAN], 1.0, 0.0).is_err(), "not a number on both sides");
    let mut two_wrong = expected.clone();
    two_wrong[1] = 9.0;
    two_wrong[2] = 9.0;
    assert_eq!(compare_pictures(&two_wrong, &expected, 1e-4, 0.002), Ok(()), "two of a thousand are a band");
    two_wrong[3] = 9.0;
    assert!(compare_pictures(&two_wrong, &expected, 1e-4, 0.002).is_err(), "three are not");
}

#[test]
fn only_depths_may_be_off_in_proportion() {
    let (got, expected) = ([100.009], [100.0]);
    assert!(compare_pictures(&got, &expected, 1e-4, 0.0).is_err());
    assert_eq!(compare_depths(&got, &expected, 1e-4, 0.0), Ok(()));
    assert!(compare_depths(&[100.011], &expected, 1e-4, 0.0).is_err());
    assert!(compare_depths(&[0.00011], &[0.0], 1e-4, 0.0).is_err());
    assert!(compare_pictures(&[0.99985], &[1.0], 1e-4, 0.0).is_err(), "a bright color is no excuse");
}

#[test]
fn the_gradient_comparer_can_fail() {
    let expected = [1.0, -2.0, 3.0, 0.5];
    assert!(compare_gradients(&expected, &expected, 1e-9).is_ok());
    assert!(compare_gradients(&[-2.0, 1.0, 3.0, 0.5], &expected, 1e-3).is_err(), "a swapped pair");
    assert!(compare_gradients(&[1.0, -2.0, 3.0, -0.5], &expected, 1e-3).is_err(), "a flipped sign");
    assert!(compare_gradients(&[f32::NAN; 4], &[f32::NAN; 4], 1.0).is_err(), "not a number on both sides");
    assert!(compare_gradients(&[], &[], 1.0).is_err(), "empty");
    assert!(compare_gradients(&expected[..3], &expected, 1.0).is_err(), "a missing element");
}
