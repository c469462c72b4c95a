//! Looks at a finished map: brings the pages around a view back from the store and renders it.

use super::scratch::NO_GAUSSIAN;
use crate::map_store::{MapStoreReader, StoreError};
use crate::splat::{
    AnchorHeader, BACKGROUND_COLUMNS, BACKGROUND_TEXELS, GaussianParams, KeyframePlacement, RenderStats, RenderTarget,
    SplatBackend, View,
};
use kilogs_core::camera::Pinhole;
use kilogs_core::conventions::{Rigid, rotation_from_xyzw};
use kilogs_core::map::lod;
use kilogs_core::store::StoredKeyframe;
use nalgebra::{Point3, Vector3};

/// Why a view could not be rendered.
#[derive(Debug, thiserror::Error)]
pub enum ViewerError {
    /// A part of the map is missing or damaged.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The map was built with more Gaussians per anchor than the backend holds.
    #[error("the map has {found} Gaussians per anchor, the backend holds {capacity}: raise map.gaussians_per_anchor")]
    AnchorTooLarge {
        /// In the map.
        found: usize,
        /// In the backend.
        capacity: usize,
    },
    /// The picture is larger than the backend's.
    #[error("a picture of {width} x {height} px does not fit the backend: raise splat.image_buffers")]
    PictureTooLarge {
        /// Of the view, px.
        width: u32,
        /// Of the view, px.
        height: u32,
    },
}

/// What it took to render a view.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Viewed {
    /// Anchors in the bands of their levels around the camera.
    pub n_anchors: usize,
    /// Anchors that did not fit the backend.
    pub n_refused: usize,
    /// Of the renderer.
    pub stats: RenderStats,
}

/// Renders views of a stored map, one at a time, with whatever is near each.
pub struct MapViewer {
    backend: Box<dyn SplatBackend>,
    page_bytes: Vec<u8>,
    slots: Vec<u32>,
    headers: Vec<AnchorHeader>,
    params: Vec<GaussianParams>,
    placements: Vec<KeyframePlacement>,
    background: Vec<[f32; 3]>,
    chunk_shown: Option<u32>,
    n_shown: usize,
    depth_m: Vec<f32>,
    transmittance: Vec<f32>,
}

impl MapViewer {
    /// Wraps a backend whose slots nobody else uses.
    pub fn new(backend: Box<dyn SplatBackend>) -> Self {
        Self {
            backend,
            page_bytes: Vec::new(),
            slots: Vec::new(),
            headers: Vec::new(),
            params: Vec::new(),
            placements: Vec::new(),
            background: vec![[0.0; 3]; BACKGROUND_TEXELS],
            chunk_shown: None,
            n_shown: 0,
            depth_m: Vec::new(),
            transmittance: Vec::new(),
        }
    }

    /// Renders what `camera` sees at `map_from_camera` into `rgb` (one color per pixel), from pages with keyframes
    /// within `radius_m`; nearer pages first when not all fit.
    ///
    /// # Errors
    /// [`ViewerError`]; damaged pages are an error here, because a figure must not be made of half a map.
    pub fn render(
        &mut self,
        map: &MapStoreReader,
        map_from_camera: &Rigid,
        camera: &Pinhole,
        radius_m: f64,
        rgb: &mut [[f32; 3]],
    ) -> Result<Viewed, ViewerError> {
        let position_m = map_from_camera.translation.vector;
        let mut viewed = self.gather(map, map_from_camera, camera, radius_m)?;
        self.show_background(map, &position_m)?;
        let all: Vec<u32> = (0..self.n_shown as u32).collect();
        self.backend.retire_anchors(&all);
        self.backend.set_keyframes(0, &self.placements);
        self.backend.write_anchors(&self.slots, &self.headers, &self.params);
        self.n_shown = self.slots.len();
        let view = View { camera_from_map: map_from_camera.inverse(), camera: *camera, chunk_row: 0 };
        self.depth_m.resize(view.n_pixels(), 0.0);
        self.transmittance.resize(view.n_pixels(), 0.0);
        let target = RenderTarget { rgb, depth_m: &mut self.depth_m, transmittance: &mut self.transmittance };
        viewed.stats = self.backend.render(&view, target);
        match viewed.stats.refused {
            true => Err(ViewerError::PictureTooLarge { width: camera.width, height: camera.height }),
            false => Ok(viewed),
        }
    }

    /// Depth of the last view, `sum T alpha z`, m.
    pub fn depth_m(&self) -> &[f32] {
        &self.depth_m
    }

    /// Transmittance of the last view.
    pub fn transmittance(&self) -> &[f32] {
        &self.transmittance
    }

    /// Collects the anchors that the view can show.
    fn gather(
        &mut self,
        map: &MapStoreReader,
        map_from_camera: &Rigid,
        camera: &Pinhole,
        radius_m: f64,
    ) -> Result<Viewed, ViewerError> {
        let position_m = map_from_camera.translation.vector;
        let mut pages: Vec<(f64, u32)> = map
            .pages_near(&position_m, radius_m)
            .map(|page| (map.page_distance_m(page, &position_m), page.page_id))
            .collect();
        pages.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let (capacity, k) = (self.backend.capacities().anchors, self.backend.capacities().gaussians_per_anchor);
        let keyframe_rows = self.backend.capacities().keyframe_rows;
        self.slots.clear();
        self.headers.clear();
        self.params.clear();
        self.placements.clear();
        let mut rows: Vec<(u32, u32)> = Vec::new();
        let mut viewed = Viewed::default();
        let mut gaussians = [NO_GAUSSIAN; crate::splat::MAX_GAUSSIANS_PER_ANCHOR];
        for (_, page_id) in pages {
            let (label, mut reader) = map.read_page(page_id, &mut self.page_bytes)?;
            if label.gaussians_per_anchor as usize > k {
                return Err(ViewerError::AnchorTooLarge { found: label.gaussians_per_anchor as usize, capacity: k });
            }
            while let Some(anchor) = reader.next_anchor(&mut gaussians) {
                let Some(keyframe) = map.keyframe(anchor.keyframe_id) else { continue };
                let map_from_keyframe = placement_of(keyframe);
                let in_map = apply(&map_from_keyframe, &anchor.position_in_keyframe_m);
                if !can_show(anchor.level, &in_map, map_from_camera, camera) {
                    continue;
                }
                let row = match rows.iter().find(|row| row.0 == anchor.keyframe_id) {
                    Some(row) => row.1,
                    None if rows.len() < keyframe_rows => {
                        let row = rows.len() as u32;
                        rows.push((anchor.keyframe_id, row));
                        self.placements.push(map_from_keyframe);
                        row
                    }
                    None => {
                        viewed.n_refused += 1;
                        continue;
                    }
                };
                if self.slots.len() >= capacity {
                    viewed.n_refused += 1;
                    continue;
                }
                self.slots.push(self.slots.len() as u32);
                self.headers.push(anchor.to_header(row, 0));
                self.params.extend_from_slice(&gaussians[..k]);
                viewed.n_anchors += 1;
            }
        }
        Ok(viewed)
    }

    /// Shows the background of the nearest keyframe's chunk.
    fn show_background(&mut self, map: &MapStoreReader, position_m: &Vector3<f64>) -> Result<(), ViewerError> {
        let distance_m = |keyframe: &StoredKeyframe| (Vector3::from(keyframe.translation_m) - position_m).norm();
        let nearest = map.keyframes().iter().min_by(|a, b| distance_m(a).total_cmp(&distance_m(b)));
        let Some(chunk_id) = nearest.map(|keyframe| keyframe.chunk_id) else { return Ok(()) };
        if self.chunk_shown == Some(chunk_id) {
            return Ok(());
        }
        let chunk = map.read_chunk(chunk_id, &mut self.page_bytes)?;
        if chunk.background_width as usize == BACKGROUND_COLUMNS && chunk.background_texels() == BACKGROUND_TEXELS {
            chunk.read_background(&mut self.background);
            self.backend.write_background(0, &self.background);
            self.chunk_shown = Some(chunk_id);
        }
        Ok(())
    }
}

/// Where a stored keyframe is.
fn placement_of(keyframe: &StoredKeyframe) -> KeyframePlacement {
    KeyframePlacement {
        rotation: rotation_from_xyzw(keyframe.rotation_xyzw),
        translation_m: Vector3::from(keyframe.translation_m),
        scale: keyframe.scale,
    }
}

fn apply(placement: &KeyframePlacement, position_in_keyframe_m: &[f32; 3]) -> Vector3<f64> {
    let position = Vector3::from(position_in_keyframe_m.map(f64::from));
    placement.rotation * position * placement.scale + placement.translation_m
}

/// Room around the picture within which an anchor's centre may lie, relative to its size.
const PICTURE_MARGIN: f64 = 0.5;

/// Whether an anchor is within its level's band, in front of the camera and near the picture.
fn can_show(level: u8, in_map: &Vector3<f64>, map_from_camera: &Rigid, camera: &Pinhole) -> bool {
    let in_camera = map_from_camera.inverse_transform_point(&Point3::from(*in_map)).coords;
    if lod::band_opacity(level, in_camera.norm() as f32) <= 0.0 {
        return false;
    }
    let voxel_m = lod::VOXEL_SIZES_M.get(usize::from(level)).copied().map_or(0.0, f64::from);
    let near = in_camera + Vector3::new(0.0, 0.0, voxel_m);
    let Some(pixel) = camera.project(&near) else { return false };
    let (width, height) = (f64::from(camera.width), f64::from(camera.height));
    let (margin_x, margin_y) = (PICTURE_MARGIN * width, PICTURE_MARGIN * height);
    (-margin_x..width + margin_x).contains(&pixel.x) && (-margin_y..height + margin_y).contains(&pixel.y)
}
