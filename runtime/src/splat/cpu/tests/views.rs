//! A view as its equations say, in f64, Gaussian by Gaussian and pixel by pixel: no tiles, no lists, no fused passes.

use super::reference::ssim;
use crate::splat::cpu::decode::{AnchorLanes, N_PARAMS, decode, group};
use crate::splat::cpu::project::{CameraConstants, CameraFromKeyframe, Projected, project};
use crate::splat::cpu::sky::Rays;
use crate::splat::cpu::splats::{MAX_ALPHA, MIN_TRANSMITTANCE};
use crate::splat::cpu::update::anisotropy;
use crate::splat::*;
use kilogs_core::map::decoder::{FEATURE_LEN, HIDDEN, INPUTS, decode_residual};
use kilogs_core::map::lod::{BAND_OVERLAP_RATIO, BAND_STARTS_M};
use kilogs_core::map::side::{SIDE_BORDER_COSINE, SIDE_FADE_COSINE};
use nalgebra::{Matrix3, Vector3};
use zerocopy::IntoBytes;

/// Everything that a view shows.
pub struct Map {
    pub k: usize,
    pub headers: Vec<AnchorHeader>,
    pub params: Vec<GaussianParams>,
    pub placements: Vec<KeyframePlacement>,
    /// Of chunk row 0.
    pub texels: Vec<[f32; 3]>,
    /// Features, and one decoder for all chunk rows.
    pub decoder: Option<(Vec<AnchorFeature>, Vec<f32>)>,
}

/// A picture, and who contributed to each pixel.
pub struct Picture {
    pub rgb: Vec<[f64; 3]>,
    pub depth_m: Vec<f64>,
    /// Gaussian (`slot * k + i`) and `T alpha`, front to back.
    pub contributions: Vec<Vec<(usize, f64)>>,
    /// Mean anisotropy of what met the picture.
    pub isotropy: f64,
    /// Gaussians that met it, and half the longer side of the box around each, px.
    pub radii_px: Vec<(usize, f64)>,
}

struct Splat {
    id: usize,
    projected: Projected<f64>,
    opacity: f64,
    color: [f64; 3],
}

impl Map {
    /// Draws the map.
    pub fn draw(&self, view: &View) -> Picture {
        let constants = CameraConstants::of(view);
        let (mut splats, mut isotropy) = (Vec::new(), 0.0);
        for (slot, header) in self.headers.iter().enumerate() {
            let placement = self.camera_from_keyframe(header, view);
            let numbers = self.drawn_numbers(slot, view);
            let position = header.position_in_keyframe_m.map(f64::from);
            let anchor = AnchorLanes { position, extent: header.log_extent.map(|v| f64::from(v).exp()) };
            let distance_m = (placement.0 * Vector3::from(position) + placement.1).norm();
            let visibility = band_opacity(header.level, distance_m) * self.side_opacity(header, view);
            for (i, numbers) in numbers.iter().take(usize::from(header.n_gaussians)).enumerate() {
                let gaussian = decode(&anchor, numbers);
                let projected = project(&constants, &lanes(&placement), &gaussian);
                let opacity = gaussian.opacity * visibility;
                let splat = Splat { id: slot * self.k + i, projected, opacity, color: gaussian.color };
                if splat.meets(view) {
                    isotropy += anisotropy(&[0, 1, 2].map(|i| numbers[group::LOG_SCALE + i])).0;
                    splats.push(splat);
                }
            }
        }
        splats.sort_by(|a, b| a.projected.depth_m.total_cmp(&b.projected.depth_m));
        let isotropy = isotropy / splats.len().max(1) as f64;
        let radii_px = splats.iter().map(|splat| (splat.id, splat.extent_px(0).max(splat.extent_px(1)))).collect();
        let mut picture = Picture { rgb: vec![], depth_m: vec![], contributions: vec![], isotropy, radii_px };
        let rays = Rays::of(view);
        for at in 0..view.n_pixels() {
            let width = view.camera.width as usize;
            let pixel = [(at % width) as f64 + 0.5, (at / width) as f64 + 0.5];
            self.draw_pixel(&splats, &rays, pixel, &mut picture);
        }
        picture
    }

    /// [`kilogs_core::map::side::side_opacity`] in f64.
    pub fn side_opacity(&self, header: &AnchorHeader, view: &View) -> f64 {
        let (linear, translation) = self.camera_from_keyframe(header, view);
        let from_keyframe = linear * Vector3::from(header.position_in_keyframe_m.map(f64::from));
        let cosine = from_keyframe.normalize().dot(&(from_keyframe + translation).normalize());
        (0.5 + 0.5 * (cosine - f64::from(SIDE_BORDER_COSINE)) / f64::from(SIDE_FADE_COSINE)).clamp(0.0, 1.0)
    }

    fn draw_pixel(&self, splats: &[Splat], rays: &Rays, pixel: [f64; 2], picture: &mut Picture) {
        let (mut transmittance, mut rgb, mut depth_m) = (1.0, [0.0; 3], 0.0);
        let mut contributions = Vec::new();
        for splat in splats {
            let alpha = splat.alpha(pixel);
            if alpha < 1.0 / 255.0 {
                continue;
            }
            let after = transmittance * (1.0 - alpha);
            if after <= f64::from(MIN_TRANSMITTANCE) {
                break;
            }
            let weight = transmittance * alpha;
            rgb = [0, 1, 2].map(|i| rgb[i] + weight * splat.color[i]);
            depth_m += weight * splat.projected.depth_m;
            contributions.push((splat.id, weight));
            transmittance = after;
        }
        let sky = self.sky(rays.texel(pixel[0], pixel[1]));
        picture.rgb.push([0, 1, 2].map(|i| rgb[i] + transmittance * sky[i]));
        picture.depth_m.push(depth_m);
        picture.contributions.push(contributions);
    }

    /// Numbers of an anchor's Gaussians with what the decoder adds.
    fn drawn_numbers(&self, slot: usize, view: &View) -> Vec<[f64; N_PARAMS]> {
        let stored = &self.params[slot * self.k..(slot + 1) * self.k];
        let number = |bytes: &[u8]| f64::from(f32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]));
        let mut numbers: Vec<f64> = stored.as_bytes().chunks_exact(4).map(number).collect();
        if let Some((features, weights)) = &self.decoder {
            let weights: Vec<f64> = weights.iter().map(|&w| f64::from(w)).collect();
            let mut residual = vec![0.0; numbers.len()];
            let mut inputs = [0.0; INPUTS];
            inputs[..FEATURE_LEN].copy_from_slice(&features[slot].map(f64::from));
            inputs[FEATURE_LEN..].copy_from_slice(&self.view_input(&self.headers[slot], view));
            decode_residual(DecoderShape::new(self.k), &weights, &inputs, &mut [0.0; HIDDEN], &mut residual);
            numbers.iter_mut().zip(residual).for_each(|(number, residual)| *number += residual);
        }
        numbers.chunks_exact(N_PARAMS).map(|n| core::array::from_fn(|i| n[i])).collect()
    }

    /// Direction and logarithm of the distance in keyframe axes: 16 m is 0, a factor of 8 is 1.
    fn view_input(&self, header: &AnchorHeader, view: &View) -> [f64; 4] {
        let placement = &self.placements[header.keyframe_row as usize];
        let camera_in_map_m = view.camera_from_map.inverse().translation.vector;
        let camera_m = placement.rotation.inverse() * (camera_in_map_m - placement.translation_m) / placement.scale;
        let from_camera_m = Vector3::from(header.position_in_keyframe_m.map(f64::from)) - camera_m;
        let unit = from_camera_m.normalize();
        [unit.x, unit.y, unit.z, (from_camera_m.norm() / 16.0).log2() / 3.0]
    }

    fn camera_from_keyframe(&self, header: &AnchorHeader, view: &View) -> (Matrix3<f64>, Vector3<f64>) {
        let placement = &self.placements[header.keyframe_row as usize];
        let rotation = (view.camera_from_map.rotation * placement.rotation).to_rotation_matrix().into_inner();
        (rotation * placement.scale, (view.camera_from_map * nalgebra::Point3::from(placement.translation_m)).coords)
    }

    fn sky(&self, [column, row]: [f64; 2]) -> [f64; 3] {
        let (left, top) = (column.floor(), row.floor());
        let (fx, fy) = (column - left, row - top);
        let texel = |dx: usize, dy: usize| {
            let column = (left as usize + dx + BACKGROUND_COLUMNS - 1) % BACKGROUND_COLUMNS;
            let row = (top as usize + dy).min(BACKGROUND_ROWS - 1);
            self.texels[row * BACKGROUND_COLUMNS + column].map(f64::from)
        };
        let [a, b, c, d] = [texel(0, 0), texel(1, 0), texel(0, 1), texel(1, 1)];
        [0, 1, 2].map(|i| (1.0 - fy) * ((1.0 - fx) * a[i] + fx * b[i]) + fy * ((1.0 - fx) * c[i] + fx * d[i]))
    }
}

fn lanes((linear, translation): &(Matrix3<f64>, Vector3<f64>)) -> CameraFromKeyframe<f64> {
    CameraFromKeyframe {
        linear: [0, 1, 2].map(|r| [0, 1, 2].map(|c| linear[(r, c)])),
        translation: (*translation).into(),
    }
}

/// [`kilogs_core::map::lod::band_opacity`] in f64.
fn band_opacity(level: u8, distance_m: f64) -> f64 {
    let beyond = |level: usize| match BAND_STARTS_M.get(level).map(|&start_m| f64::from(start_m)) {
        None => 0.0,
        Some(0.0) => 1.0,
        Some(start_m) => {
            (0.5 + 0.5 * (distance_m - start_m) / (start_m * f64::from(BAND_OVERLAP_RATIO))).clamp(0.0, 1.0)
        }
    };
    beyond(usize::from(level)) * (1.0 - beyond(usize::from(level) + 1))
}

impl Splat {
    fn alpha(&self, pixel: [f64; 2]) -> f64 {
        let [xx, xy, yy] = self.projected.conic;
        let [dx, dy] = [0, 1].map(|i| pixel[i] - self.projected.mean_px[i]);
        let q = 0.5 * xx * dx * dx + xy * dx * dy + 0.5 * yy * dy * dy;
        (self.opacity * (-q).exp()).min(f64::from(MAX_ALPHA))
    }

    /// Half a side of the box around the border where alpha is 1/255.
    fn extent_px(&self, i: usize) -> f64 {
        (2.0 * (255.0 * self.opacity).ln() * self.projected.covariance_px2[2 * i]).sqrt()
    }

    /// Whether the box around the border where alpha is 1/255 holds the centre of a pixel.
    fn meets(&self, view: &View) -> bool {
        let size = [view.camera.width, view.camera.height].map(f64::from);
        self.projected.depth_m > 0.01
            && self.opacity > 1.0 / 255.0
            && [0, 1].into_iter().all(|i| {
                let extent_px = self.extent_px(i);
                let [low, high] = [-1.0, 1.0].map(|side| self.projected.mean_px[i] + side * extent_px - 0.5);
                low.ceil().max(0.0) <= high.floor().min(size[i] - 1.0)
            })
    }
}

/// The whole loss of a training view whose target is [`TargetImage::RgbF32`].
pub fn loss(picture: &Picture, training: &TrainingView<'_>, exposure: Exposure, weights: &LossWeights) -> f64 {
    let TargetImage::RgbF32(target) = training.target else { panic!("only RgbF32") };
    let n = picture.rgb.len() as f64;
    let mut loss = f64::from(weights.isotropy) * picture.isotropy;
    for channel in 0..3 {
        let (gain, bias) = (f64::from(exposure.gain[channel]), f64::from(exposure.bias[channel]));
        let x: Vec<f64> = picture.rgb.iter().map(|rgb| gain * rgb[channel] + bias).collect();
        let y: Vec<f64> = target.iter().map(|rgb| f64::from(rgb[channel])).collect();
        loss += f64::from(weights.l1) * x.iter().zip(&y).map(|(x, y)| (x - y).abs()).sum::<f64>() / n / 3.0;
        if weights.ssim != 0.0 {
            let ssim = ssim(&x, &y, training.view.camera.width as usize);
            loss += f64::from(weights.ssim) * (1.0 - ssim) / 3.0;
        }
    }
    if let Some(depth) = training.depth {
        let confident: f64 = depth.confidence.iter().map(|&c| f64::from(c)).sum();
        let pixels = picture.depth_m.iter().zip(depth.depth_m).zip(depth.confidence);
        let sum: f64 = pixels.map(|((d, target), c)| f64::from(*c) * (d - f64::from(*target)).abs()).sum();
        loss += f64::from(weights.depth) * sum / confident;
    }
    loss
}
