//! How different a stored map looks from what the camera saw, by a network.

use super::judge::judge_map;
use super::viewer::RenderError;
use crate::inference::Lpips;
use crate::map_store::MapStoreReader;
use crate::splat::SplatBackend;
use kilogs_core::frame::PixelFormat;
use kilogs_eval::LpipsFigures;

/// Renders every stored view of `map` as [`judge_map`] does, and compares it with the stored image by `lpips`: the means over
/// the keyframes and over the held-out views.
///
/// # Errors
/// [`RenderError`] when the backend refuses the map's picture size, or the network fails.
pub fn measure_lpips(
    map: &MapStoreReader,
    backend: &mut dyn SplatBackend,
    lpips: &mut Lpips,
) -> Result<LpipsFigures, RenderError> {
    let is_grey = map.manifest().pixel_format == PixelFormat::Mono8;
    let (mut render, mut camera) = (Vec::new(), Vec::new());
    // Sum and number of views: keyframes, held out.
    let mut kinds = [(0.0, 0u32); 2];
    judge_map(map, backend, &mut |view| {
        render.clear();
        render.extend(view.render.shown(is_grey));
        camera.clear();
        camera.extend(view.camera.pixels().map(|pixel| pixel.0.map(|channel| f32::from(channel) / 255.0)));
        let (sum, n_views) = &mut kinds[usize::from(view.keyframe.is_held_out)];
        *sum += f64::from(lpips(&render, &camera)?);
        *n_views += 1;
        Ok(())
    })?;
    let [train, held_out] = kinds.map(|(sum, n_views)| (n_views > 0).then(|| sum / f64::from(n_views)));
    Ok(LpipsFigures { train, held_out })
}
