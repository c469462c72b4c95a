//! From a keyframe's image to new anchors: depth, comparison with the rendered map, sampling, spawning.

use super::depth::DepthSource;
use super::images::KeptImage;
use super::mapper::{InsertReport, Mapper};
use super::scratch::ImageScratch;
use crate::splat::{AnchorHeader, RenderTarget, View};
use kilogs_core::camera::Pinhole;
use kilogs_core::map::depth::motion_stereo::MAX_SOURCES;
use kilogs_core::map::depth::{DepthImage, DepthRequest, EarlierView};
use kilogs_core::map::insertion::{
    InsertionImages, InsertionSample, InsertionSettings, SamplingScratch, depth_edges, find_structure, sample,
};
use kilogs_core::map::pool::{AnchorRecord, NOT_STORED};
use kilogs_core::map::spawn::{SurfaceSample, initial_gaussian, voxels_for};
use kilogs_core::map::voxel::VoxelKey;
use kilogs_core::math::Rng;
use kilogs_core::tracking::{KeyframePoint, RoadPlane};
use nalgebra::{Point3, Vector3};

/// Purpose of the draws here (see [`Rng::new`]).
const SAMPLING: u64 = 0x696e_7365;

impl Mapper {
    /// Inserts from the keyframe `age` places before the newest, comparing it with those of `source_ages`; `visit` counts
    /// the insertions from this keyframe, so that each draws its own numbers.
    pub(super) fn insert_from(
        &mut self,
        (age, visit): (usize, u32),
        source_ages: &[usize],
        points: &[KeyframePoint],
        road: Option<RoadPlane>,
    ) -> InsertReport {
        let kept = self.images.newest(age).filter(|_| !self.shows_nothing_new(age));
        let Some(keyframe) = kept.map(|kept| kept.keyframe) else { return InsertReport::default() };
        let (ordinal, settings) = (keyframe.ordinal, self.insertion_for(age));
        let from_stereo = self.estimate_depth(age, source_ages, points, road);
        if from_stereo {
            let ImageScratch { inverse_depth, confidence, .. } = &self.scratch;
            self.depths.keep(ordinal, inverse_depth, confidence, self.settings.trusted_depth_m);
            self.look_at_sky(age);
        }
        let mean_transmittance = self.compare_with_map(age);
        let mut rng =
            Rng::new(self.settings.seed, u64::from(ordinal), SAMPLING + age as u64 + (u64::from(visit) << u32::BITS));
        let scratch = &mut self.scratch;
        let images = InsertionImages {
            size: scratch.size,
            structure: &scratch.structure,
            depth_edges: &scratch.depth_edges,
            rendered_structure: &scratch.rendered_structure,
            rendered_depth_edges: &scratch.rendered_depth_edges,
            transmittance: &scratch.transmittance,
            error: &scratch.error,
            confidence: &scratch.confidence,
        };
        let memory = SamplingScratch { probability: &mut scratch.probability, kept: &mut scratch.kept };
        let most_samples = self.quota.available() as f32;
        let drawn = sample(&images, &settings, most_samples, &mut rng, memory, &mut scratch.samples);
        let mut report = self.spawn_samples(age, drawn.n_samples);
        self.quota.spend(report.n_gaussians);
        report.n_samples = drawn.n_samples as u32;
        // The list of samples is as long as new anchors have Gaussians.
        report.refused.new_anchors += drawn.n_refused as u32;
        report.mean_transmittance = mean_transmittance;
        report.from_stereo = from_stereo;
        report
    }

    /// Fills inverse depth and confidence; whether motion stereo could tell.
    fn estimate_depth(
        &mut self,
        age: usize,
        source_ages: &[usize],
        points: &[KeyframePoint],
        road: Option<RoadPlane>,
    ) -> bool {
        let Some(kept) = self.images.newest(age) else { return false };
        let earlier: heapless::Vec<EarlierView<'_>, MAX_SOURCES> = source_ages
            .iter()
            .filter_map(|&source_age| self.images.newest(source_age))
            .map(|source| EarlierView { luma: source.luma, world_from_camera: source.keyframe.world_from_camera })
            .take(MAX_SOURCES)
            .collect();
        let (camera, native) = (*self.images.camera(), self.images.native());
        let request = DepthRequest {
            camera,
            luma: kept.luma,
            world_from_camera: kept.keyframe.world_from_camera,
            earlier: &earlier,
            points,
            native_per_map_px: [
                f64::from(native.width) / f64::from(camera.width),
                f64::from(native.height) / f64::from(camera.height),
            ],
            road,
        };
        let scratch = &mut self.scratch;
        let sources: [&mut dyn DepthSource; 2] = [&mut self.stereo, &mut self.sparse];
        let answered = sources.into_iter().position(|source| {
            let out = DepthImage { inverse_depth: &mut scratch.inverse_depth, confidence: &mut scratch.confidence };
            source.estimate(&request, &self.settings, out)
        });
        let from_stereo = answered == Some(0);
        for (sure, &inverse_depth) in scratch.confidence.iter_mut().zip(&scratch.inverse_depth) {
            if *sure < self.settings.min_confidence || inverse_depth <= 0.0 {
                *sure = 0.0;
            }
        }
        from_stereo
    }

    /// Renders the map where the keyframe is and fills structures and edges of both pictures; mean transmittance.
    fn compare_with_map(&mut self, age: usize) -> f32 {
        let Some(kept) = self.images.newest(age) else { return 1.0 };
        let Some(chunk_row) = self.chunk_row(kept.keyframe.ordinal) else { return 1.0 };
        let camera_from_map = kept.keyframe.world_from_camera.inverse();
        let view = View { camera_from_map, camera: *self.images.camera(), chunk_row };
        let ImageScratch { size, rgb, rendered_depth, transmittance, .. } = &mut self.scratch;
        let size = *size;
        let stats = self.backend.render(&view, RenderTarget { rgb, depth_m: rendered_depth, transmittance });
        self.list_load.add(&stats);
        let scratch = &mut self.scratch;
        let InsertionSettings { operator, sigmas_px, .. } = self.settings.insertion;
        for (value, &grey) in scratch.luma.iter_mut().zip(kept.luma) {
            *value = f32::from(grey) / 255.0;
        }
        find_structure(operator, (&scratch.luma, size), sigmas_px, &mut scratch.blur, &mut scratch.structure);
        for (value, &[red, green, blue]) in scratch.luma.iter_mut().zip(&scratch.rgb) {
            *value = 0.299 * red + 0.587 * green + 0.114 * blue;
        }
        for ((error, &rendered), &grey) in scratch.error.iter_mut().zip(&scratch.luma).zip(kept.luma) {
            *error = (rendered - f32::from(grey) / 255.0).abs();
        }
        find_structure(operator, (&scratch.luma, size), sigmas_px, &mut scratch.blur, &mut scratch.rendered_structure);
        // The rendered depth is weighted by what was hit; its inverse is that of the mean hit.
        for (depth, &through) in scratch.rendered_depth.iter_mut().zip(&scratch.transmittance) {
            *depth = if *depth > 0.0 && through < 0.5 { (1.0 - through) / *depth } else { 0.0 };
        }
        depth_edges(&scratch.inverse_depth, size, &mut scratch.depth_edges);
        depth_edges(&scratch.rendered_depth, size, &mut scratch.rendered_depth_edges);
        scratch.transmittance.iter().sum::<f32>() / size.n_pixels().max(1) as f32
    }

    /// Turns the drawn samples into Gaussians and hands them to the backend.
    fn spawn_samples(&mut self, age: usize, n_samples: usize) -> InsertReport {
        let mut report = InsertReport::default();
        let Some(kept) = self.images.newest(age) else { return report };
        let (keyframe, camera) = (kept.keyframe, *self.images.camera());
        let camera_in_map = keyframe.world_from_camera.translation.vector;
        for nth in 0..n_samples {
            let sampled = self.scratch.samples[nth];
            let surface = self.surface_at(age, &sampled);
            let point_in_keyframe = surface.point_in_keyframe(&camera);
            let point_in_map = (keyframe.world_from_camera * Point3::from(point_in_keyframe)).coords;
            for key in voxels_for(&point_in_map, &camera_in_map).into_iter().flatten() {
                self.spawn(age, key, &surface, &camera, &mut report);
            }
        }
        self.backend.write_anchors(&self.staging.slots, &self.staging.headers, &self.staging.params);
        for (&slot, header) in self.staging.slots.iter().zip(&self.staging.headers) {
            if let Some(record) = self.pool.handle_at(slot).and_then(|handle| self.pool.get_mut(handle)) {
                record.n_gaussians = header.n_gaussians;
            }
        }
        self.staging.clear();
        report
    }

    /// Puts one Gaussian into a voxel: a new anchor where it is free, the next Gaussian of an anchor that this
    /// insertion created, and nothing where it is taken.
    fn spawn(
        &mut self,
        age: usize,
        key: VoxelKey,
        surface: &SurfaceSample,
        camera: &Pinhole,
        report: &mut InsertReport,
    ) {
        let Some(kept) = self.images.newest(age) else { return };
        let keyframe = kept.keyframe;
        let center_in_map = Vector3::from(key.center_in_map_m());
        let anchor_in_keyframe = (keyframe.world_from_camera.inverse() * Point3::from(center_in_map)).coords;
        let extent_m = f64::from(key.size_m());
        let rows = (self.keyframe_row(keyframe.ordinal), self.chunk_row(keyframe.ordinal));
        let (Some(keyframe_row), Some(chunk_row)) = rows else { return };
        let slot = match self.grid.get(key) {
            Some(slot) if self.staging.holds(slot) => slot,
            Some(slot) if self.is_shown_to(slot, key, &keyframe.world_from_camera.translation.vector) => {
                report.n_occupied += 1;
                return;
            }
            _ => {
                if self.staging.is_full() {
                    report.refused.new_anchors += 1;
                    return;
                }
                let record = AnchorRecord {
                    voxel: key,
                    keyframe_ordinal: keyframe.ordinal,
                    n_gaussians: 0,
                    page_part: NOT_STORED,
                };
                let Ok(handle) = self.pool.insert(record) else {
                    report.refused.anchors += 1;
                    return;
                };
                if self.grid.insert(key, handle.slot).is_err() {
                    self.pool.remove(handle);
                    report.refused.voxels += 1;
                    return;
                }
                let header = AnchorHeader {
                    position_in_keyframe_m: anchor_in_keyframe.cast::<f32>().into(),
                    keyframe_row,
                    log_extent: [key.size_m().ln(); 3],
                    level: key.level(),
                    n_gaussians: 0,
                    chunk_row,
                };
                self.staging.push(handle.slot, header);
                report.n_anchors += 1;
                handle.slot
            }
        };
        let gaussian = initial_gaussian(surface, camera, &anchor_in_keyframe, extent_m, &self.settings.spawn);
        if self.staging.add_gaussian(slot, gaussian) {
            report.n_gaussians += 1;
        } else {
            report.n_occupied += 1;
        }
    }

    /// The surface under a sampled pixel.
    fn surface_at(&self, age: usize, sampled: &InsertionSample) -> SurfaceSample {
        let ImageScratch { size, inverse_depth, .. } = &self.scratch;
        let (x, y) = (usize::from(sampled.x), usize::from(sampled.y));
        let index = y * size.width + x;
        let color = self.images.newest(age).map_or([0.5; 3], |kept| color_at(&kept, self.images.channels(), index));
        let at = |x: Option<usize>, y: Option<usize>| {
            let (x, y) = (x.filter(|&x| x < size.width)?, y.filter(|&y| y < size.height)?);
            Some(f64::from(inverse_depth[y * size.width + x]))
        };
        let middle = f64::from(inverse_depth[index]);
        let slope_x = slope(middle, |step| at(x.checked_add_signed(step), Some(y)));
        let slope_y = slope(middle, |step| at(Some(x), y.checked_add_signed(step)));
        SurfaceSample {
            pixel: [x as f64 + 0.5, y as f64 + 0.5],
            inverse_depth: middle,
            inverse_depth_slope: [slope_x, slope_y],
            sigma_px: f64::from(sampled.sigma_px),
            color,
        }
    }
}

/// Half length of the line along which a slope is measured, px: the depth's own grid is two pixels wide.
const SLOPE_REACH_PX: isize = 4;
/// Relative change of inverse depth over that length beyond which it is an edge and not a slope.
const MAX_SLOPE_CHANGE: f64 = 0.25;

/// Slope of the inverse depth along a line through a pixel, per pixel; one-sided next to an edge, zero at a point.
fn slope(middle: f64, at: impl Fn(isize) -> Option<f64>) -> f64 {
    let side = |step: isize| at(step).filter(|value| (value - middle).abs() <= MAX_SLOPE_CHANGE * middle);
    let reach = SLOPE_REACH_PX as f64;
    match (side(-SLOPE_REACH_PX), side(SLOPE_REACH_PX)) {
        (Some(before), Some(after)) => (after - before) / (2.0 * reach),
        (Some(before), None) => (middle - before) / reach,
        (None, Some(after)) => (after - middle) / reach,
        (None, None) => 0.0,
    }
}

/// Color of a pixel of a kept image, RGB in [0, 1].
pub(super) fn color_at(kept: &KeptImage<'_>, channels: usize, index: usize) -> [f32; 3] {
    match kept.pixels.get(index * channels..(index + 1) * channels) {
        Some(&[red, green, blue]) => [red, green, blue].map(|value| f32::from(value) / 255.0),
        Some(&[grey]) => [f32::from(grey) / 255.0; 3],
        _ => [0.5; 3],
    }
}
