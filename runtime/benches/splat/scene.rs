//! A map of a chosen number of Gaussians that fills a picture as a street does.

use kilogs::splat::cpu::decode::{AnchorLanes, N_PARAMS, decode};
use kilogs::splat::cpu::project::{CameraConstants, CameraFromKeyframe, project};
use kilogs::splat::{AnchorHeader, GaussianParams, SplatBackend, View};
use kilogs_core::camera::Pinhole;
use kilogs_core::conventions::Rigid;
use kilogs_core::map::decoder::fill_fresh_decoder;
use kilogs_core::map::{DecoderShape, lod};
use kilogs_core::math::Rng;

/// Gaussians per anchor, as in the shipped budget.
pub const GAUSSIANS_PER_ANCHOR: usize = 2;

/// Depths of a street, m: logarithmically uniform between these.
const DEPTHS_M: [f32; 2] = [4.0, 60.0];

/// Standard deviation of a splat relative to the spacing of the Gaussians on the picture. At 1 a pixel is covered
/// several times over and little of the background is left, which is what a trained map looks like.
const SIGMA_TO_SPACING: f32 = 1.0;

/// Spread of the logarithm of a standard deviation, half width.
const LOG_SIGMA_SPREAD: f32 = 0.5;

/// How much there is to compute.
#[derive(Clone, Copy)]
pub struct Size {
    /// Gaussians of the map, all in view.
    pub n_gaussians: usize,
    /// Width of the picture, px.
    pub width_px: u32,
    /// Height of the picture, px.
    pub height_px: u32,
}

/// The sizes of the table.
pub const SIZES: [Size; 4] = [
    Size { n_gaussians: 4_000, width_px: 160, height_px: 96 },
    Size { n_gaussians: 50_000, width_px: 620, height_px: 188 },
    Size { n_gaussians: 200_000, width_px: 620, height_px: 188 },
    Size { n_gaussians: 200_000, width_px: 1241, height_px: 376 },
];

impl Size {
    /// `50k/620x188`.
    pub fn name(&self) -> String {
        format!("{}k/{}x{}", self.n_gaussians / 1000, self.width_px, self.height_px)
    }

    /// Pixels of the picture.
    pub fn n_pixels(&self) -> usize {
        self.width_px as usize * self.height_px as usize
    }

    /// A camera at the origin that looks along z, with the field of view of a driving recorder.
    pub fn view(&self) -> View {
        let (width, height) = (f64::from(self.width_px), f64::from(self.height_px));
        let focal_px = 0.58 * width;
        let camera = Pinhole {
            width: self.width_px,
            height: self.height_px,
            fx: focal_px,
            fy: focal_px,
            cx: 0.5 * width,
            cy: 0.5 * height,
        };
        View { camera_from_map: Rigid::identity(), camera, chunk_row: 0 }
    }
}

/// Anchors with their Gaussians.
pub struct Scene {
    /// One per slot.
    pub headers: Vec<AnchorHeader>,
    /// [`GAUSSIANS_PER_ANCHOR`] per slot.
    pub params: Vec<GaussianParams>,
}

impl Scene {
    /// The same numbers for the same size and seed.
    pub fn new(size: &Size, seed: u64) -> Self {
        let camera = size.view().camera;
        let mut rng = Rng::new(seed, 0, 0);
        let mut around = |middle: f32, spread: f32| middle + spread * (2.0 * rng.unit_f32() - 1.0);
        let spacing_px = (size.n_pixels() as f32 / size.n_gaussians as f32).sqrt();
        let (mut headers, mut params) = (Vec::new(), Vec::new());
        for _ in 0..size.n_gaussians / GAUSSIANS_PER_ANCHOR {
            let log_depth = DEPTHS_M.map(f32::ln);
            let depth_m = around(0.5 * (log_depth[0] + log_depth[1]), 0.5 * (log_depth[1] - log_depth[0])).exp();
            let z1 = [(camera.width, camera.fx), (camera.height, camera.fy)]
                .map(|(side_px, focal_px)| around(0.0, 0.5 * side_px as f32) / focal_px as f32);
            let log_extent = (SIGMA_TO_SPACING * spacing_px * depth_m / camera.fx as f32).ln();
            let distance_m = depth_m * (1.0 + z1[0] * z1[0] + z1[1] * z1[1]).sqrt();
            headers.push(AnchorHeader {
                position_in_keyframe_m: [z1[0] * depth_m, z1[1] * depth_m, depth_m],
                keyframe_row: 0,
                log_extent: [log_extent; 3],
                level: lod::level_at(distance_m),
                n_gaussians: GAUSSIANS_PER_ANCHOR as u8,
                chunk_row: 0,
            });
            for _ in 0..GAUSSIANS_PER_ANCHOR {
                params.push(GaussianParams {
                    offset: [0; 3].map(|_| around(0.0, 1.5)),
                    log_scale: [0; 3].map(|_| around(0.0, LOG_SIGMA_SPREAD)),
                    quaternion_xyzw: [0; 4].map(|_| around(0.0, 1.0)),
                    opacity_logit: around(0.0, 2.0),
                    color_logit: [0; 3].map(|_| around(0.0, 2.0)),
                });
            }
        }
        Self { headers, params }
    }

    /// Puts the scene into a backend that has room for it.
    pub fn write_to(&self, backend: &mut dyn SplatBackend) {
        let slots: Vec<u32> = (0..self.headers.len() as u32).collect();
        let n_refused = backend.write_anchors(&slots, &self.headers, &self.params);
        assert_eq!(n_refused, 0, "the scene fits the capacities that were made for it");
        if backend.capacities().learned_decoder {
            let shape = DecoderShape::new(GAUSSIANS_PER_ANCHOR);
            let mut weights = vec![0.0; shape.len()];
            assert!(fill_fresh_decoder(shape, 0, 0, &mut weights) && backend.write_decoder(0, &weights));
        }
    }

    /// Sum over all Gaussians of the pixels in which their alpha reaches 1/255: the area of an ellipse,
    /// `2 pi ln(255 o) / sqrt(det conic)`. What a nearer splat hides, and what lies beyond the border, is counted too.
    pub fn n_contributions(&self, view: &View) -> f64 {
        let camera = CameraConstants::of(view);
        let straight =
            CameraFromKeyframe { linear: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], translation: [0.0; 3] };
        let area_px2 = |(i, params): (usize, &GaussianParams)| {
            let header = &self.headers[i / GAUSSIANS_PER_ANCHOR];
            let anchor = AnchorLanes {
                position: header.position_in_keyframe_m.map(f64::from),
                extent: header.log_extent.map(|v| f64::from(v.exp())),
            };
            let numbers: &[f32; N_PARAMS] = zerocopy::transmute_ref!(params);
            let decoded = decode(&anchor, &numbers.map(f64::from));
            let [xx, xy, yy] = project(&camera, &straight, &decoded).conic;
            let reach = (255.0 * decoded.opacity).max(1.0).ln();
            core::f64::consts::TAU * reach / (xx * yy - xy * xy).sqrt()
        };
        self.params.iter().enumerate().map(area_px2).sum()
    }
}
