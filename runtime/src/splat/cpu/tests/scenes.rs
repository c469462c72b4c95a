//! Small scenes of random Gaussians in front of a camera.

use crate::splat::cpu::{CpuBackend, SimdLevel};
use crate::splat::*;
use kilogs_core::camera::Pinhole;
use kilogs_core::conventions::Rigid;
use kilogs_core::math::rng::Rng;

/// Gaussians per anchor of these scenes: not a divisor of a vector's lanes.
pub const K: usize = 3;

/// A camera at the origin that looks along z.
pub fn view(width: u32, height: u32) -> View {
    let focal_px = f64::from(width);
    let camera = Pinhole {
        width,
        height,
        fx: focal_px,
        fy: focal_px,
        cx: 0.51 * f64::from(width),
        cy: 0.47 * f64::from(height),
    };
    View { camera_from_map: Rigid::identity(), camera, chunk_row: 0 }
}

/// Anchors in front of [`view`], every third of the last anchor's Gaussians unused.
pub fn anchors(n: usize, seed: u64) -> (Vec<AnchorHeader>, Vec<GaussianParams>) {
    let mut rng = Rng::new(seed, 0, 0);
    let mut around = |middle: f32, spread: f32| middle + spread * (2.0 * rng.unit_f32() - 1.0);
    let mut headers = Vec::new();
    let mut params = Vec::new();
    for i in 0..n {
        let depth_m = around(4.0, 2.0);
        headers.push(AnchorHeader {
            position_in_keyframe_m: [around(0.0, 0.4) * depth_m, around(0.0, 0.25) * depth_m, depth_m],
            keyframe_row: 0,
            log_extent: [around(-1.4, 0.3), around(-1.4, 0.3), around(-1.4, 0.3)],
            level: 0,
            n_gaussians: if i + 1 == n { K as u8 - 1 } else { K as u8 },
            chunk_row: 0,
        });
        for _ in 0..K {
            params.push(GaussianParams {
                offset: [0; 3].map(|_| around(0.0, 1.0)),
                log_scale: [0; 3].map(|_| around(-0.3, 0.6)),
                quaternion_xyzw: [0; 4].map(|_| around(0.0, 1.0)),
                opacity_logit: around(0.3, 1.5),
                color_logit: [0; 3].map(|_| around(0.0, 2.0)),
            });
        }
    }
    (headers, params)
}

/// A backend with room for exactly these anchors.
pub fn backend(view: &View, headers: &[AnchorHeader], params: &[GaussianParams], threads: usize) -> CpuBackend {
    let mut capacities = Capacities::for_map(headers.len(), K, view.camera.width, view.camera.height);
    capacities.pairs *= 8;
    capacities.row_entries *= 4;
    filled(capacities, headers, params, threads)
}

/// A backend of these capacities, filled slot by slot.
pub fn filled(
    capacities: Capacities,
    headers: &[AnchorHeader],
    params: &[GaussianParams],
    threads: usize,
) -> CpuBackend {
    let mut backend = CpuBackend::new(capacities, threads, SimdLevel::best(), |_| ()).expect("backend");
    let slots: Vec<u32> = (0..headers.len() as u32).collect();
    assert_eq!(backend.write_anchors(&slots, headers, params), 0);
    backend
}

/// A picture with everything that belongs to it.
#[derive(Clone, Debug, PartialEq)]
pub struct Picture {
    pub rgb: Vec<[f32; 3]>,
    pub depth_m: Vec<f32>,
    pub transmittance: Vec<f32>,
    pub stats: RenderStats,
}

/// Renders into fresh memory, with sentinels on both sides that must survive.
pub fn render(backend: &mut dyn SplatBackend, view: &View) -> Picture {
    const SENTINEL: f32 = -77.0;
    const GUARD: usize = 32;
    let n = view.n_pixels();
    let mut rgb = vec![[SENTINEL; 3]; n + 2 * GUARD];
    let mut depth_m = vec![SENTINEL; n + 2 * GUARD];
    let mut transmittance = vec![SENTINEL; n + 2 * GUARD];
    let inside = GUARD..GUARD + n;
    let stats = backend.render(
        view,
        RenderTarget {
            rgb: &mut rgb[inside.clone()],
            depth_m: &mut depth_m[inside.clone()],
            transmittance: &mut transmittance[inside.clone()],
        },
    );
    for i in (0..GUARD).chain(GUARD + n..n + 2 * GUARD) {
        assert_eq!((rgb[i], depth_m[i], transmittance[i]), ([SENTINEL; 3], SENTINEL, SENTINEL), "sentinel {i}");
    }
    Picture {
        rgb: rgb[inside.clone()].to_vec(),
        depth_m: depth_m[inside.clone()].to_vec(),
        transmittance: transmittance[inside].to_vec(),
        stats,
    }
}

/// All trained numbers.
pub fn read(backend: &CpuBackend) -> Vec<GaussianParams> {
    let n = backend.capacities().anchors;
    let slots: Vec<u32> = (0..n as u32).collect();
    let (mut headers, mut params) = anchors(n, 0);
    assert_eq!(backend.read_anchors(&slots, &mut headers, &mut params), 0);
    params
}
