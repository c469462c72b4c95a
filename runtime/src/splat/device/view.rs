//! What the kernels are told of a view.

use crate::splat::cpu::cull::{Frustum, KeyframeNumbers, place_keyframes};
use crate::splat::cpu::project::CameraConstants;
use crate::splat::cpu::sky::Rays;
use crate::splat::kernel_constants::{NO_ROW, TILE_PX};
use crate::splat::layout::{KeyframeBlock, ViewBlock};
use crate::splat::{BACKGROUND_TEXELS, Capacities, KeyframePlacement, View};

/// The part of the block that drawing needs.
pub fn view_block(capacities: &Capacities, view: &View, n_slots: u32) -> ViewBlock {
    let camera = CameraConstants::of(view);
    let rays = Rays::of(view);
    let direction = |d: [f64; 3]| [d[0] as f32, d[1] as f32, d[2] as f32, 0.0];
    let (width, height) = (view.camera.width, view.camera.height);
    ViewBlock {
        width,
        height,
        tile_columns: width.div_ceil(TILE_PX),
        tile_rows: height.div_ceil(TILE_PX),
        n_slots,
        k: capacities.gaussians_per_anchor as u32,
        candidate_capacity: capacities.visible_gaussians as u32,
        entry_capacity: capacities.row_entries as u32,
        pair_capacity: capacities.pairs as u32,
        first_texel: u32::from(view.chunk_row) * BACKGROUND_TEXELS as u32,
        decoder_rows: if capacities.learned_decoder { capacities.chunk_rows as u32 } else { 0 },
        decoder_row: NO_ROW,
        focal_px: camera.focal_px.map(|v| v as f32),
        center_px: camera.center_px.map(|v| v as f32),
        min_z1: camera.min_z1.map(|v| v as f32),
        max_z1: camera.max_z1.map(|v| v as f32),
        stretch_px: Frustum::of(view).stretch_px,
        ray_corner: direction(rays.corner),
        ray_right: direction(rays.right),
        ray_down: direction(rays.down),
        ..ViewBlock::default()
    }
}

/// Camera from every keyframe row; composed in f64 on the host, so that the length of the route costs no digits.
pub fn place(view: &View, placements: &[KeyframePlacement], out: &mut [KeyframeBlock]) {
    for (placement, block) in placements.iter().zip(out) {
        let mut numbers: [KeyframeNumbers; 1] = [[0.0; 12]];
        place_keyframes(view, core::slice::from_ref(placement), &mut numbers);
        let [m] = numbers;
        *block = KeyframeBlock {
            row_x: [m[0], m[1], m[2], m[9]],
            row_y: [m[3], m[4], m[5], m[10]],
            row_z: [m[6], m[7], m[8], m[11]],
        };
    }
}
