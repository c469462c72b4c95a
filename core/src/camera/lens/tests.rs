use super::*;
use crate::math::Rng;

const CAMERA: Pinhole = Pinhole { width: 1241, height: 376, fx: 718.856, fy: 718.856, cx: 607.19, cy: 185.22 };
const BROWN: Lens = Lens::RadialTangential([-0.37, 0.2, 0.0011, 0.0002, -0.069]);
const BARREL: Lens = Lens::RadialTangential([-0.28, 0.07, 0.0002, -0.0005, 0.0]);
const PINCUSHION: Lens = Lens::RadialTangential([0.15, 0.02, -0.0004, 0.0003, 0.0]);
const FISHEYE: Lens = Lens::KannalaBrandt([0.012, -0.004, 0.0007, -0.0003]);

/// OpenCV 5.0 `projectPoints` and `fisheye.projectPoints` with the identity as camera matrix.
const RAYS: [[f64; 2]; 5] = [[0.0, 0.0], [0.3, -0.2], [-0.7, 0.25], [0.05, 0.4], [-0.85, -0.45]];

#[test]
fn rays_land_where_opencv_puts_them() {
    let check = |lens: Lens, expected: [[f64; 2]; 5]| {
        for (ray, expected) in RAYS.iter().zip(expected) {
            let error = (lens.distort(&Vector2::from(*ray)) - Vector2::from(expected)).norm();
            assert!(error < 1e-14, "{lens:?} {ray:?}: off by {error}");
        }
    };
    check(
        BARREL,
        [
            [0.0, 0.0],
            [0.28925589999999995, -0.19285460000000004],
            [-0.6075038062499999, 0.216977484375],
            [0.047741671875, 0.382615875],
            [-0.6817916875, -0.3605186875],
        ],
    );
    check(
        BROWN,
        [
            [0.0, 0.0],
            [0.28646852209999996, -0.1908186814],
            [-0.5915708830265625, 0.21192252965234376],
            [0.047320508496093754, 0.37848281796875005],
            [-0.6568095242187499, -0.34680313046875],
        ],
    );
    check(
        FISHEYE,
        [
            [0.0, 0.0],
            [0.28832601173022887, -0.19221734115348593],
            [-0.6045359956120848, 0.21590571271860173],
            [0.04760824444918637, 0.38086595559349096],
            [-0.6808092908958652, -0.3604284481213404],
        ],
    );
}

#[test]
fn there_and_back_is_the_same_pixel() {
    const FARTHEST_PX: f64 = 1e-9;
    let mut rng = Rng::new(3, 1, 4);
    for lens in [Lens::Pinhole, BROWN, BARREL, PINCUSHION, FISHEYE] {
        for _ in 0..1000 {
            let ideal_px = Vector2::new(rng.unit_f64() * 1241.0, rng.unit_f64() * 376.0);
            let ideal = CAMERA.unproject_z1(&ideal_px);
            let back = lens.undistort(&lens.distort(&ideal)).expect("within the image");
            let error_px = (back - ideal).norm() * CAMERA.fx;
            assert!(error_px < FARTHEST_PX, "{lens:?} {ideal_px}: off by {error_px} px");
        }
    }
}

#[test]
fn derivatives_agree_with_differences() {
    const STEP: f64 = 1e-6;
    for lens in [BROWN, BARREL, PINCUSHION, FISHEYE, Lens::KannalaBrandt([0.0; 4])] {
        for ray in RAYS {
            let ray = Vector2::from(ray);
            let (_, derivative) = lens.distort_with_derivative(&ray);
            for k in 0..2 {
                let mut step = Vector2::zeros();
                step[k] = STEP;
                let difference = (lens.distort(&(ray + step)) - lens.distort(&(ray - step))) / (2.0 * STEP);
                let error = (difference - derivative.column(k)).norm();
                assert!(error < 1e-8, "{lens:?} {ray} by {k}: {error}");
            }
        }
    }
}

#[test]
fn a_lens_that_folds_is_found_out() {
    let check = |lens: Lens, is_good: bool| {
        assert_eq!(lens.check_within(&CAMERA).is_ok(), is_good, "{lens:?}");
    };
    check(Lens::Pinhole, true);
    check(BROWN, true);
    check(BARREL, true);
    check(PINCUSHION, true);
    check(FISHEYE, true);
    check(Lens::KannalaBrandt([0.0; 4]), true);
    // Shrinks faster than the radius grows: r (1 - 0.6 r^2) turns back at 0.75, the corner lies at 0.9.
    check(Lens::RadialTangential([-0.6, 0.0, 0.0, 0.0, 0.0]), false);
    check(Lens::RadialTangential([0.0, 0.0, 0.9, 0.0, 0.0]), false);
    check(Lens::KannalaBrandt([-0.7, 0.0, 0.0, 0.0]), false);
    check(Lens::KannalaBrandt([f64::NAN, 0.0, 0.0, 0.0]), false);
}

#[test]
fn beyond_the_fold_there_is_no_ray() {
    // The largest radius that r (1 - 0.3 r^2) reaches is 0.703.
    let lens = Lens::RadialTangential([-0.3, 0.0, 0.0, 0.0, 0.0]);
    assert!(lens.undistort(&Vector2::new(0.70, 0.0)).is_some_and(|ray| ray.x < 1.06));
    assert_eq!(lens.undistort(&Vector2::new(0.71, 0.0)), None);
    assert_eq!(lens.undistort(&Vector2::new(f64::NAN, 0.0)), None);
    // A fisheye shows 90 degrees at pi / 2.
    let fisheye = Lens::KannalaBrandt([0.0; 4]);
    assert!(fisheye.undistort(&Vector2::new(0.0, 1.5)).is_some());
    assert_eq!(fisheye.undistort(&Vector2::new(0.0, 1.6)), None);
}
