//! Which Gaussians may be in view: a test that is cheap and never wrong in the negative.

use super::anchors::FixedNumbers;
use super::project::{CameraConstants, NEAR_PLANE_M, SCREEN_DILATION_PX2};
use super::splats::{Lists, MAX_JOBS, piece_len, take_front};
use crate::pool::Pool;
use crate::splat::kernel_constants::MAX_SIGMAS;
use crate::splat::{AnchorHeader, GaussianParams, KeyframePlacement, View};
use kilogs_core::map::{lod, side};
use nalgebra::{Matrix3, Vector3};

/// `camera_from_keyframe` of a keyframe row: scale times rotation row by row, then the translation.
pub type KeyframeNumbers = [f32; 12];

/// Camera from every keyframe row, composed in f64 so that the length of the route costs no digits.
pub fn place_keyframes(view: &View, placements: &[KeyframePlacement], out: &mut [KeyframeNumbers]) {
    let rotation_cm = view.camera_from_map.rotation.to_rotation_matrix();
    for (placement, numbers) in placements.iter().zip(out) {
        let linear: Matrix3<f64> =
            (rotation_cm * placement.rotation.to_rotation_matrix()).into_inner() * placement.scale;
        let translation: Vector3<f64> =
            view.camera_from_map.rotation * placement.translation_m + view.camera_from_map.translation.vector;
        for row in 0..3 {
            for column in 0..3 {
                numbers[row * 3 + column] = linear[(row, column)] as f32;
            }
            numbers[9 + row] = translation[row] as f32;
        }
    }
}

/// The Gaussians as they are drawn.
#[derive(Clone, Copy)]
pub struct ShownGaussians<'a> {
    /// What their anchors contribute.
    pub fixed: FixedNumbers<'a>,
    /// `k` per slot.
    pub params: &'a [GaussianParams],
    /// Slots below this number may be in use.
    pub slots_end: usize,
    /// Only slots whose word in [`Lists::visible_bits`] is not 0 have numbers.
    pub only_marked: bool,
}

/// Lists the candidates in ascending order; returns how many there are and how many did not fit.
pub fn cull(
    pool: &Pool,
    gaussians: &ShownGaussians<'_>,
    keyframes: &[KeyframeNumbers],
    frustum: &Frustum,
    lists: &mut Lists,
) -> (usize, usize) {
    let len = piece_len(gaussians.slots_end);
    let mut jobs = heapless::Vec::<CullJob<'_>, MAX_JOBS>::new();
    for (i, bits) in lists.visible_bits[..gaussians.slots_end].chunks_mut(len).enumerate() {
        let job = CullJob { first_slot: i * len, bits, n_visible: 0, out: &mut [] };
        if jobs.push(job).is_err() {
            unreachable!("piece_len makes at most MAX_JOBS pieces");
        }
    }
    pool.for_each(&mut jobs, |_, job| job.test(gaussians, keyframes, frustum));
    let needed: usize = jobs.iter().map(|job| job.n_visible).sum();
    let kept = needed.min(lists.candidates.len());
    let mut rest = &mut lists.candidates[..kept];
    for job in &mut jobs {
        job.out = take_front(&mut rest, job.n_visible);
    }
    pool.for_each(&mut jobs, |_, job| job.list(gaussians.fixed.k));
    (kept, needed - kept)
}

/// The view's pyramid, widened by what a splat may reach.
#[derive(Clone, Copy, Debug)]
pub struct Frustum {
    focal_px: [f32; 2],
    center_px: [f32; 2],
    size_px: [f32; 2],
    /// Largest length of a row of the projection's Jacobian at z = 1, px.
    pub stretch_px: [f32; 2],
}

impl Frustum {
    /// Pyramid of a view.
    pub fn of(view: &View) -> Self {
        let constants = CameraConstants::of(view);
        let stretch = |i: usize| {
            let z1 = constants.max_z1[i].abs().max(constants.min_z1[i].abs());
            (constants.focal_px[i] * (1.0 + z1 * z1).sqrt()) as f32
        };
        Self {
            focal_px: constants.focal_px.map(|v| v as f32),
            center_px: constants.center_px.map(|v| v as f32),
            size_px: [view.camera.width as f32, view.camera.height as f32],
            stretch_px: [stretch(0), stretch(1)],
        }
    }

    /// Whether anything within `radius_m()` of a point may meet the picture.
    #[inline(always)]
    pub fn may_reach(&self, in_camera: [f32; 3], radius_m: impl FnOnce() -> f32) -> bool {
        let [x, y, z] = in_camera;
        if !(x + y + z).is_finite() {
            return false;
        }
        let beyond = [0, 1].map(|i| {
            let pixel = self.focal_px[i] * [x, y][i] / z + self.center_px[i];
            (-pixel).max(pixel - self.size_px[i])
        });
        if z >= NEAR_PLANE_M && beyond[0] < 0.0 && beyond[1] < 0.0 {
            return true;
        }
        let radius_m = radius_m();
        if z <= radius_m {
            return z + radius_m >= NEAR_PLANE_M;
        }
        let dilation_px = MAX_SIGMAS * SCREEN_DILATION_PX2.sqrt() as f32;
        [0, 1].into_iter().all(|i| beyond[i] <= self.stretch_px[i] * radius_m / z + dilation_px + 1.0)
    }

    /// Whether the splat of a Gaussian with standard deviations of at most `max_sigma_m()` may meet the picture.
    #[inline(always)]
    fn may_see(&self, mean_in_camera: [f32; 3], max_sigma_m: impl FnOnce() -> f32) -> bool {
        let [x, y, z] = mean_in_camera;
        if z < NEAR_PLANE_M || !(x + y + z).is_finite() {
            return false;
        }
        let beyond = [0, 1].map(|i| {
            let pixel = self.focal_px[i] * [x, y][i] / z + self.center_px[i];
            (-pixel).max(pixel - self.size_px[i])
        });
        if beyond[0] < 0.0 && beyond[1] < 0.0 {
            return true;
        }
        let sigma_m = max_sigma_m();
        [0, 1].into_iter().all(|i| {
            let sigma_px = (self.stretch_px[i] * sigma_m / z).hypot(SCREEN_DILATION_PX2.sqrt() as f32);
            beyond[i] <= MAX_SIGMAS * sigma_px + 1.0
        })
    }
}

struct CullJob<'a> {
    first_slot: usize,
    bits: &'a mut [u32],
    n_visible: usize,
    out: &'a mut [u32],
}

impl CullJob<'_> {
    fn test(&mut self, gaussians: &ShownGaussians<'_>, keyframes: &[KeyframeNumbers], frustum: &Frustum) {
        let mut n_visible = 0;
        for (i, bits) in self.bits.iter_mut().enumerate() {
            if *bits != 0 || !gaussians.only_marked {
                *bits = slot_bits(gaussians, self.first_slot + i, keyframes, frustum);
            }
            n_visible += bits.count_ones() as usize;
        }
        self.n_visible = n_visible;
    }

    fn list(&mut self, k: usize) {
        let mut out = self.out.iter_mut();
        for (i, slot_bits) in self.bits.iter_mut().enumerate() {
            let mut bits = *slot_bits;
            while bits != 0 {
                let Some(candidate) = out.next() else {
                    // What did not fit is not visible.
                    *slot_bits &= !bits;
                    break;
                };
                *candidate = ((self.first_slot + i) * k) as u32 + bits.trailing_zeros();
                bits &= bits - 1;
            }
        }
    }
}

fn slot_bits(gaussians: &ShownGaussians<'_>, slot: usize, keyframes: &[KeyframeNumbers], frustum: &Frustum) -> u32 {
    let anchors = &gaussians.fixed;
    let header = &anchors.headers[slot];
    let n_gaussians = usize::from(header.n_gaussians);
    if n_gaussians == 0 {
        return 0;
    }
    let extent_m = &anchors.extents_m[slot];
    let m = &keyframes[header.keyframe_row as usize];
    let largest_extent_m = extent_m[0].max(extent_m[1]).max(extent_m[2]);
    // Scale of camera_from_keyframe: the length of a row of its linear part.
    let scale = || (m[0] * m[0] + m[1] * m[1] + m[2] * m[2]).sqrt();
    if visibility_of(header, m) <= 0.0 {
        return 0;
    }
    let mut bits = 0;
    for (i, gaussian) in gaussians.params[slot * anchors.k..].iter().take(n_gaussians).enumerate() {
        let mean = [0, 1, 2].map(|a| header.position_in_keyframe_m[a] + gaussian.offset[a] * extent_m[a]);
        let in_camera =
            [0, 1, 2].map(|r| m[r * 3] * mean[0] + m[r * 3 + 1] * mean[1] + m[r * 3 + 2] * mean[2] + m[9 + r]);
        let visible = frustum.may_see(in_camera, || scale() * largest_extent_m * largest_scale(gaussian));
        bits |= u32::from(visible) << i;
    }
    bits
}

/// Share of its opacity that an anchor keeps at its distance from the camera (see [`lod`]) and on its side (see [`side`]).
#[inline(always)]
pub fn visibility_of(header: &AnchorHeader, camera_from_keyframe: &KeyframeNumbers) -> f32 {
    let seen = SeenAnchor::of(header, camera_from_keyframe);
    match lod::band_opacity(header.level, seen.distance_m) {
        0.0 => 0.0,
        band => band * side::side_opacity(seen.cosine()),
    }
}

/// Change of the natural logarithm of [`visibility_of`] per metre that the anchor moves in the camera's frame.
pub fn fade_of(header: &AnchorHeader, camera_from_keyframe: &KeyframeNumbers) -> [f32; 3] {
    let seen = SeenAnchor::of(header, camera_from_keyframe);
    let cosine = seen.cosine();
    let share = |slope: f32, opacity: f32| if slope == 0.0 { 0.0 } else { slope / opacity };
    let by_distance =
        share(lod::band_opacity_slope(header.level, seen.distance_m), lod::band_opacity(header.level, seen.distance_m));
    let by_cosine = share(side::side_opacity_slope(cosine), side::side_opacity(cosine));
    [0, 1, 2].map(|i| {
        let ray = seen.in_camera_m[i] / seen.distance_m;
        let turn = (seen.from_keyframe_m[i] / seen.depth_m - cosine * ray) / seen.distance_m;
        by_distance * ray + if by_cosine == 0.0 { 0.0 } else { by_cosine * turn }
    })
}

/// An anchor as the camera sees it, in the camera's axes.
struct SeenAnchor {
    in_camera_m: [f32; 3],
    distance_m: f32,
    /// The way to it from its keyframe.
    from_keyframe_m: [f32; 3],
    /// Length of that way.
    depth_m: f32,
}

impl SeenAnchor {
    #[inline(always)]
    fn of(header: &AnchorHeader, camera_from_keyframe: &KeyframeNumbers) -> Self {
        let m = camera_from_keyframe;
        let [x, y, z] = header.position_in_keyframe_m;
        let from_keyframe_m = [0, 1, 2].map(|r| m[r * 3] * x + m[r * 3 + 1] * y + m[r * 3 + 2] * z);
        let in_camera_m = [0, 1, 2].map(|r| from_keyframe_m[r] + m[9 + r]);
        Self { in_camera_m, distance_m: norm(in_camera_m), from_keyframe_m, depth_m: norm(from_keyframe_m) }
    }

    /// Of the angle between the rays to it from its keyframe and from the camera.
    #[inline(always)]
    fn cosine(&self) -> f32 {
        let ([ax, ay, az], [bx, by, bz]) = (self.in_camera_m, self.from_keyframe_m);
        let cosine = (ax * bx + ay * by + az * bz) / (self.distance_m * self.depth_m);
        // What is where one of the two is has no sides.
        if cosine.is_nan() { 1.0 } else { cosine }
    }
}

#[inline(always)]
fn norm([x, y, z]: [f32; 3]) -> f32 {
    (x * x + y * y + z * z).sqrt()
}

/// Largest of its scales, in units of the anchor's extent.
#[inline(always)]
pub fn largest_scale(gaussian: &GaussianParams) -> f32 {
    let [x, y, z] = gaussian.log_scale;
    x.max(y).max(z).exp()
}
