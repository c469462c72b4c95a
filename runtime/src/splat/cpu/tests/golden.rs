//! The backend against float64 references made with an independent public rasteriser (`../shared/golden`).
//!
//! `tests/golden/*.bin` hold the six smaller scenes: magic `KGLD`, n, width, height as u32, then little-endian f32 in
//! the order of [`Scene::read`]. More scenes in the same form are read from the folder `KILOGS_GOLDEN`; `tests/convert_golden.py`
//! writes them.

use super::compare::{compare_depths, compare_gradients, compare_pictures};
use crate::splat::cpu::decode::{N_PARAMS, group};
use crate::splat::cpu::{CpuBackend, SimdLevel};
use crate::splat::*;
use kilogs_core::camera::Pinhole;
use kilogs_core::conventions::Rigid;
use nalgebra::{Matrix3, Rotation3, Translation3, UnitQuaternion};
use std::path::Path;

/// A scene of Gaussians with the expected picture and gradients.
pub struct Scene {
    pub name: String,
    pub n: usize,
    pub view: View,
    means: Vec<f32>,
    quaternions_wxyz: Vec<f32>,
    scales: Vec<f32>,
    opacities: Vec<f32>,
    colors: Vec<f32>,
    image_rgbd: Vec<f32>,
    alpha: Vec<f32>,
    upstream_rgbd: Vec<f32>,
    upstream_alpha: Vec<f32>,
    grad_means: Vec<f32>,
    grad_quaternions_wxyz: Vec<f32>,
    grad_scales: Vec<f32>,
    grad_opacities: Vec<f32>,
    grad_colors: Vec<f32>,
}

impl Scene {
    fn read(path: &Path) -> Self {
        let bytes = std::fs::read(path).expect("golden file");
        assert_eq!(&bytes[..4], b"KGLD", "{}", path.display());
        let word = |i: usize| u32::from_le_bytes([bytes[i], bytes[i + 1], bytes[i + 2], bytes[i + 3]]);
        let (n, width, height) = (word(4) as usize, word(8), word(12));
        let mut numbers = (16..bytes.len()).step_by(4).map(|i| f32::from_bits(word(i)));
        let mut take = |count: usize| numbers.by_ref().take(count).collect::<Vec<f32>>();
        let pixels = (width * height) as usize;
        let camera = take(20);
        let m = |i: usize| f64::from(camera[i]);
        let rotation = Matrix3::new(m(0), m(1), m(2), m(4), m(5), m(6), m(8), m(9), m(10));
        let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix(&rotation));
        let camera_from_map = Rigid::from_parts(Translation3::new(m(3), m(7), m(11)), rotation);
        let camera = Pinhole { width, height, fx: m(16), fy: m(17), cx: m(18), cy: m(19) };
        let [means, quaternions_wxyz, scales, opacities, colors] = [3 * n, 4 * n, 3 * n, n, 3 * n].map(&mut take);
        // Radii, means, depths and conics of the splats: for people who debug.
        let _ = take(2 * n + 2 * n + n + 3 * n);
        let [image_rgbd, alpha, upstream_rgbd, upstream_alpha] =
            [4 * pixels, pixels, 4 * pixels, pixels].map(&mut take);
        let [grad_means, grad_quaternions_wxyz, grad_scales, grad_opacities, grad_colors] =
            [3 * n, 4 * n, 3 * n, n, 3 * n].map(&mut take);
        assert_eq!(grad_colors.len(), 3 * n, "{} is too short", path.display());
        let name = path.file_stem().expect("a name").to_string_lossy().into_owned();
        let view = View { camera_from_map, camera, chunk_row: 0 };
        Self {
            name,
            n,
            view,
            means,
            quaternions_wxyz,
            scales,
            opacities,
            colors,
            image_rgbd,
            alpha,
            upstream_rgbd,
            upstream_alpha,
            grad_means,
            grad_quaternions_wxyz,
            grad_scales,
            grad_opacities,
            grad_colors,
        }
    }

    /// All scenes of the repository and of the folder `KILOGS_GOLDEN`.
    pub fn all() -> Vec<Self> {
        let own = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden");
        let folders = [Some(own), std::env::var_os("KILOGS_GOLDEN").map(Into::into)];
        let mut paths: Vec<_> = folders
            .iter()
            .flatten()
            .flat_map(|folder| std::fs::read_dir(folder).expect("golden folder"))
            .map(|entry| entry.expect("golden file").path())
            .collect();
        paths.sort();
        assert!(paths.len() >= 6, "golden scenes are missing");
        paths.iter().map(|path| Self::read(path)).collect()
    }

    /// Trained numbers that decode to the scene, in one anchor per Gaussian at the origin with unit extent.
    pub fn params(&self) -> Vec<GaussianParams> {
        let three = |v: &[f32], i: usize| [v[3 * i], v[3 * i + 1], v[3 * i + 2]];
        (0..self.n)
            .map(|i| {
                let q = &self.quaternions_wxyz[4 * i..4 * i + 4];
                GaussianParams {
                    offset: three(&self.means, i),
                    // A standard deviation counts by its square; the references use both signs.
                    log_scale: three(&self.scales, i).map(|s| s.abs().ln()),
                    quaternion_xyzw: [q[1], q[2], q[3], q[0]],
                    opacity_logit: logit(self.opacities[i]),
                    color_logit: three(&self.colors, i).map(logit),
                }
            })
            .collect()
    }

    /// Room for the scene.
    pub fn capacities(&self) -> Capacities {
        let camera = &self.view.camera;
        let mut capacities = Capacities::for_map(self.n, 1, camera.width, camera.height);
        capacities.row_entries = self.n * 24;
        capacities.pairs = self.n * 120;
        capacities
    }

    /// Puts the scene before a black background into a backend.
    pub fn fill(&self, backend: &mut dyn SplatBackend) {
        let slots: Vec<u32> = (0..self.n as u32).collect();
        let header = AnchorHeader {
            position_in_keyframe_m: [0.0; 3],
            keyframe_row: 0,
            log_extent: [0.0; 3],
            level: 0,
            n_gaussians: 1,
            chunk_row: 0,
        };
        assert_eq!(backend.write_anchors(&slots, &vec![header; self.n], &self.params()), 0);
        assert!(backend.write_background(0, &[[0.0; 3]; BACKGROUND_TEXELS]));
    }

    fn backend(&self, threads: usize, level: SimdLevel) -> CpuBackend {
        let mut backend = CpuBackend::new(self.capacities(), threads, level, |_| ()).expect("backend");
        self.fill(&mut backend);
        backend
    }

    /// Gradients of the scalar with respect to red, green, blue, depth, transmittance.
    pub fn upstream(&self) -> [Vec<f32>; 5] {
        let channel = |c: usize| self.upstream_rgbd.iter().skip(c).step_by(4).copied().collect::<Vec<f32>>();
        [channel(0), channel(1), channel(2), channel(3), self.upstream_alpha.iter().map(|g| -g).collect()]
    }
}

fn logit(p: f32) -> f32 {
    (f64::from(p) / (1.0 - f64::from(p))).ln() as f32
}

fn levels() -> impl Iterator<Item = SimdLevel> {
    SimdLevel::ALL.into_iter().filter(|level| level.is_available())
}

/// Renders the scene and compares.
pub fn check_picture(scene: &Scene, backend: &mut dyn SplatBackend, who: &str) {
    let n_pixels = scene.view.n_pixels();
    let (mut rgb, mut depth_m, mut transmittance) =
        (vec![[9.0; 3]; n_pixels], vec![9.0; n_pixels], vec![9.0; n_pixels]);
    let target = RenderTarget { rgb: &mut rgb, depth_m: &mut depth_m, transmittance: &mut transmittance };
    let stats = backend.render(&scene.view, target);
    assert_eq!((stats.overflow, stats.refused), (Overflow::default(), false), "{}", scene.name);
    let expected_pixels = scene.image_rgbd.as_chunks::<4>().0;
    let expected_rgb: Vec<f32> = expected_pixels.iter().flat_map(|pixel| [pixel[0], pixel[1], pixel[2]]).collect();
    let expected_depth_m: Vec<f32> = expected_pixels.iter().map(|pixel| pixel[3]).collect();
    let alpha: Vec<f32> = transmittance.iter().map(|t| 1.0 - t).collect();
    for (what, result) in [
        ("rgb", compare_pictures(rgb.as_flattened(), &expected_rgb, 1e-4, 0.002)),
        ("depth", compare_depths(&depth_m, &expected_depth_m, 1e-4, 0.002)),
        ("alpha", compare_pictures(&alpha, &scene.alpha, 1e-4, 0.002)),
    ] {
        assert_eq!(result, Ok(()), "{what} of {} with {who}", scene.name);
    }
}

/// Compares gradients with respect to the scene's trained numbers.
pub fn check_gradients(scene: &Scene, grads: &[[f32; N_PARAMS]], who: &str) {
    let column = |i: usize| grads.iter().map(move |g| g[i]);
    let columns = |range: core::ops::Range<usize>| grads.iter().flat_map(|g| g[range.clone()].to_vec()).collect();
    let logistic = |value: &f32, grad: f32| grad / (value * (1.0 - value));
    let got_means: Vec<f32> = columns(group::OFFSET..group::LOG_SCALE);
    let got_scales: Vec<f32> =
        columns(group::LOG_SCALE..group::ROTATION).iter().zip(&scene.scales).map(|(g, s): (&f32, _)| g / s).collect();
    let quaternions: Vec<f32> = columns(group::ROTATION..group::OPACITY);
    let got_quaternions: Vec<f32> = quaternions.chunks(4).flat_map(|q| [q[3], q[0], q[1], q[2]]).collect();
    let got_opacities: Vec<f32> = column(group::OPACITY).zip(&scene.opacities).map(|(g, o)| logistic(o, g)).collect();
    let colors: Vec<f32> = columns(group::COLOR..N_PARAMS);
    let got_colors: Vec<f32> = colors.iter().zip(&scene.colors).map(|(g, c)| logistic(c, *g)).collect();
    let groups = [
        ("means", got_means, &scene.grad_means),
        ("quaternions", got_quaternions, &scene.grad_quaternions_wxyz),
        ("scales", got_scales, &scene.grad_scales),
        ("opacities", got_opacities, &scene.grad_opacities),
        ("colors", got_colors, &scene.grad_colors),
    ];
    for (what, got, expected) in groups {
        let result = compare_gradients(&got, expected, 1e-3);
        println!("{} {who} {what}: {result:?}", scene.name);
        assert!(result.is_ok(), "{what} of {} with {who}: {result:?}", scene.name);
    }
}

#[test]
fn pictures_match_golden() {
    for scene in Scene::all() {
        levels().for_each(|level| check_picture(&scene, &mut scene.backend(1, level), level.name()));
    }
}

#[test]
fn gradients_match_golden() {
    for scene in Scene::all() {
        for level in levels() {
            let mut grads = vec![[f32::NAN; N_PARAMS]; scene.n];
            let upstream = scene.upstream();
            let upstream = [&upstream[0], &upstream[1], &upstream[2], &upstream[3], &upstream[4]].map(Vec::as_slice);
            scene.backend(2, level).gradients(&scene.view, upstream, &mut grads).expect("fits");
            check_gradients(&scene, &grads, level.name());
        }
    }
}
