//! Depth from several sightings of a point by cameras whose poses are known.

use crate::conventions::Rigid;
use nalgebra::{Vector2, Vector3};

/// One more camera that saw the point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sighting {
    /// That camera from the host camera.
    pub camera_from_host: Rigid,
    /// Where it saw the point, on its plane z = 1.
    pub seen_z1: Vector2<f64>,
}

/// Inverse depth along the host's ray, with its uncertainty.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct InverseDepth {
    /// One over the distance along the host's optical axis, 1/m. Zero or below: not distinguishable from infinity.
    pub value: f64,
    /// Standard deviation, 1/m.
    pub sigma: f64,
    /// Root mean square reprojection error, on the plane z = 1.
    pub rms_z1: f64,
}

const MAX_STEPS: usize = 6;
/// A relative change of inverse depth below this is negligible.
const NEGLIGIBLE_RATIO: f64 = 1e-6;

/// Residual of one sighting and its derivative by the inverse depth; `None` behind the camera.
fn residual(sighting: &Sighting, ray: &Vector3<f64>, inverse_depth: f64) -> Option<(Vector2<f64>, Vector2<f64>)> {
    let t = sighting.camera_from_host.translation.vector;
    let q = sighting.camera_from_host.rotation * ray + t * inverse_depth;
    if q.z <= 0.0 {
        return None;
    }
    let predicted = q.xy() / q.z;
    Some((predicted - sighting.seen_z1, (t.xy() - predicted * t.z) / q.z))
}

/// Triangulates a point in inverse depth along the host's ray by Gauss-Newton over all sightings.
///
/// # Inputs
/// * `host_z1`: the ray, on the host's plane z = 1; taken as exact.
/// * `sightings`: other cameras that saw it; an iterator that can be walked several times.
/// * `start`: inverse depth to start from, 1/m; 0 (infinity) is a safe start for forward motion.
/// * `noise_z1`: standard deviation of a sighting, per axis.
///
/// # Output
/// `None` without a usable sighting or without any baseline.
///
/// # Cost
/// O(sightings * 6); no stack to speak of.
///
/// # Source
/// Civera, Davison & Montiel 2008, sec. II (inverse depth); the iteration is plain Gauss-Newton. Own
/// implementation.
pub fn triangulate_inverse_depth<'s>(
    host_z1: &Vector2<f64>,
    sightings: impl Iterator<Item = &'s Sighting> + Clone,
    start: f64,
    noise_z1: f64,
) -> Option<InverseDepth> {
    let ray = Vector3::new(host_z1.x, host_z1.y, 1.0);
    let mut value = start;
    let mut information = 0.0;
    for _ in 0..MAX_STEPS {
        let mut gradient = 0.0;
        information = 0.0;
        for sighting in sightings.clone() {
            if let Some((r, jacobian)) = residual(sighting, &ray, value) {
                information += jacobian.norm_squared();
                gradient += jacobian.dot(&r);
            }
        }
        if information.is_nan() || information <= 0.0 {
            return None;
        }
        let step = gradient / information;
        value -= step;
        if step.abs() < NEGLIGIBLE_RATIO * value.abs() {
            break;
        }
    }
    let (mut sum2, mut n) = (0.0, 0usize);
    for sighting in sightings {
        let (r, _) = residual(sighting, &ray, value)?;
        sum2 += r.norm_squared();
        n += 2;
    }
    let rms_z1 = libm::sqrt(sum2 / n as f64);
    value.is_finite().then_some(InverseDepth { value, sigma: noise_z1 / libm::sqrt(information), rms_z1 })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::se3;
    use nalgebra::{Point3, Vector6};

    fn sighting(tangent: [f64; 6], point_in_host: Vector3<f64>) -> Sighting {
        let camera_from_host = se3::exp(&Vector6::from(tangent));
        let q = camera_from_host * Point3::from(point_in_host);
        Sighting { camera_from_host, seen_z1: (q.coords / q.z).xy() }
    }

    fn check(point_in_host: Vector3<f64>, n: usize) {
        let all = [
            sighting([0.0, 0.02, 0.0, 0.0, 0.0, -1.0], point_in_host),
            sighting([0.01, -0.05, 0.0, 0.1, 0.0, -2.0], point_in_host),
        ];
        let host_z1 = (point_in_host / point_in_host.z).xy();
        let found = triangulate_inverse_depth(&host_z1, all[..n].iter(), 0.0, 1e-3).expect("a baseline");
        assert!((found.value - 1.0 / point_in_host.z).abs() < 1e-7, "{found:?}");
        assert!(found.rms_z1 < 1e-6);
    }

    #[test]
    fn near_and_far_points_come_out_exactly() {
        for n in [1, 2] {
            check(Vector3::new(2.0, 1.0, 5.0), n);
            check(Vector3::new(-8.0, 2.0, 40.0), n);
            check(Vector3::new(500.0, -90.0, 5000.0), n);
        }
    }

    #[test]
    fn more_baseline_means_less_uncertainty_and_none_means_no_answer() {
        let point = Vector3::new(2.0, 1.0, 10.0);
        let host_z1 = (point / point.z).xy();
        let sigma = |forward: f64| {
            let one = [sighting([0.0, 0.0, 0.0, 0.0, 0.0, -forward], point)];
            triangulate_inverse_depth(&host_z1, one.iter(), 0.05, 1e-3).map(|d| d.sigma)
        };
        assert!(sigma(2.0) < sigma(1.0));
        assert_eq!(sigma(0.0), None);
        assert_eq!(triangulate_inverse_depth(&host_z1, [].iter(), 0.0, 1e-3), None);
    }
}
