//! Candidates become splats: decoding, projection, and which pixel rows each one reaches.

use super::cull::{KeyframeNumbers, ShownGaussians, visibility_of};
use super::decode::decode;
use super::grid::{Grid, MAX_TILE_ROWS, TILE_PX};
use super::lane::{Lane, each};
use super::packet::{PACKET, Packet, Row, ZERO_ROW, as_arrays};
use super::project::{CameraConstants, NEAR_PLANE_M, project};
use super::simd::Dispatch;
use super::splats::{LOG2_MIN_ALPHA, Lists, MAX_JOBS, Splat, piece_len, take_front};
use crate::pool::Pool;
use crate::splat::kernel_constants::BORDER_MARGIN_PX;
use core::f32::consts::{LN_2, LOG2_E};
use pulp::{Simd, WithSimd};

/// The camera, and where it sees each keyframe.
#[derive(Clone, Copy)]
pub struct CameraView<'a> {
    /// Camera from each keyframe row.
    pub keyframes: &'a [KeyframeNumbers],
    /// The camera.
    pub camera: CameraConstants,
    /// Size of the picture.
    pub grid: Grid,
}

/// Key of a candidate that does not meet the picture.
pub const NOT_VISIBLE: u64 = u64::MAX;

/// Fills splats, sort keys and the counts per row of tiles for the first `n_candidates` candidates.
pub fn make_splats(
    pool: &Pool,
    dispatch: Dispatch,
    gaussians: &ShownGaussians<'_>,
    view: CameraView<'_>,
    n_candidates: usize,
    lists: &mut Lists,
) {
    let len = piece_len(n_candidates);
    let mut splats = &mut lists.splats[..n_candidates];
    let mut keys = &mut lists.keys[..n_candidates];
    let mut row_counts = &mut lists.row_counts[..];
    let mut jobs = heapless::Vec::<SplatJob<'_>, MAX_JOBS>::new();
    for (i, candidates) in lists.candidates[..n_candidates].chunks(len).enumerate() {
        let job = SplatJob {
            gaussians,
            view,
            first: i * len,
            candidates,
            splats: take_front(&mut splats, len),
            keys: take_front(&mut keys, len),
            row_counts: take_front(&mut row_counts, MAX_TILE_ROWS),
        };
        if jobs.push(job).is_err() {
            unreachable!("piece_len makes at most MAX_JOBS pieces");
        }
    }
    pool.for_each(&mut jobs, |_, job| dispatch.run(RunSplatJob(job)));
    // Pieces that do not exist count nothing.
    row_counts.fill(0);
}

struct SplatJob<'a> {
    gaussians: &'a ShownGaussians<'a>,
    view: CameraView<'a>,
    first: usize,
    candidates: &'a [u32],
    splats: &'a mut [Splat],
    keys: &'a mut [u64],
    row_counts: &'a mut [u32],
}

struct RunSplatJob<'j, 'a>(&'j mut SplatJob<'a>);

impl WithSimd for RunSplatJob<'_, '_> {
    type Output = ();
    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let job = self.0;
        job.row_counts.fill(0);
        let (view, fixed) = (job.view, job.gaussians.fixed);
        let params = as_arrays(job.gaussians.params);
        let mut packet = Packet::new();
        let mut out = ProjectedRows::new();
        let outputs = job.splats.chunks_mut(PACKET).zip(job.keys.chunks_mut(PACKET));
        for (i, (ids, (splats, keys))) in job.candidates.chunks(PACKET).zip(outputs).enumerate() {
            packet.gather(&fixed, params, view.keyframes, ids, 0);
            for first in (0..PACKET).step_by(S::F32_LANES) {
                out.compute(simd, &view.camera, &packet, first);
            }
            let candidate = job.first + i * PACKET;
            for (lane, (splat, key)) in splats.iter_mut().zip(keys).enumerate() {
                let visibility = ids.get(lane).map_or(0.0, |&id| {
                    let header = &fixed.headers[id as usize / fixed.k];
                    visibility_of(header, &view.keyframes[header.keyframe_row as usize])
                });
                *key = match out.splat(lane, visibility, &view.grid) {
                    Some(found) => {
                        *splat = found;
                        let [top, bottom] = found.rows_px.map(|y| usize::from(y) / TILE_PX);
                        job.row_counts[top..=bottom].iter_mut().for_each(|n| *n += 1);
                        (u64::from(found.depth_m.to_bits()) << 32) | (candidate + lane) as u64
                    }
                    None => NOT_VISIBLE,
                };
            }
        }
    }
}

/// Results of the lane mathematics, for [`PACKET`] Gaussians.
struct ProjectedRows {
    mean_px: [Row; 2],
    depth_m: Row,
    variance_px2: [Row; 2],
    conic: [Row; 3],
    opacity: Row,
    color: [Row; 3],
}

impl ProjectedRows {
    fn new() -> Self {
        Self {
            mean_px: [ZERO_ROW; 2],
            depth_m: ZERO_ROW,
            variance_px2: [ZERO_ROW; 2],
            conic: [ZERO_ROW; 3],
            opacity: ZERO_ROW,
            color: [ZERO_ROW; 3],
        }
    }

    #[inline(always)]
    fn compute<S: Simd>(&mut self, simd: S, camera: &CameraConstants, packet: &Packet, first: usize) {
        let lanes = packet.lanes(simd, first);
        let decoded = decode(&lanes.anchor, &lanes.params);
        let projected = project(camera, &lanes.placement, &decoded);
        let [xx, xy, yy] = projected.conic;
        let log2_e = xx.constant(f64::from(LOG2_E));
        let half = xx.constant(-0.5) * log2_e;
        let conic_log2 = [half * xx, -log2_e * xy, half * yy];
        for i in 0..3 {
            self.conic[i].store(first, conic_log2[i]);
        }
        for i in 0..2 {
            self.mean_px[i].store(first, projected.mean_px[i]);
            self.variance_px2[i].store(first, projected.covariance_px2[2 * i]);
        }
        for i in 0..3 {
            self.color[i].store(first, decoded.color[i]);
        }
        self.depth_m.store(first, projected.depth_m);
        self.opacity.store(first, decoded.opacity);
    }

    /// The splat of one lane, `None` when it does not meet the picture (or is not a number).
    ///
    /// `visibility` scales the opacity and needs no backward pass of its own: the gradient of the opacity is that
    /// of `q` over the opacity, and the factor cancels there.
    #[inline(always)]
    fn splat(&self, lane: usize, visibility: f32, grid: &Grid) -> Option<Splat> {
        let depth_m = self.depth_m.0[lane];
        let log2_opacity = (self.opacity.0[lane] * visibility).log2();
        let reach = log2_opacity - LOG2_MIN_ALPHA;
        let conic_log2 = each!(i in 3 => self.conic[i].0[lane]);
        let mean_px = each!(i in 2 => self.mean_px[i].0[lane]);
        // q <= ln(255 opacity) reaches sqrt(2 q variance) from the mean.
        let extent_px = each!(i in 2 => (2.0 * LN_2 * reach * self.variance_px2[i].0[lane]).sqrt());
        let all_finite = (mean_px[0] + mean_px[1] + conic_log2[0] + conic_log2[1] + conic_log2[2]).is_finite()
            && (extent_px[0] + extent_px[1]).is_finite();
        let is_ellipse = conic_log2[0] < 0.0 && conic_log2[2] < 0.0;
        if !(depth_m >= NEAR_PLANE_M && reach >= 0.0 && all_finite && is_ellipse) {
            return None;
        }
        let columns = pixels_within(mean_px[0], -extent_px[0], extent_px[0], grid.width);
        let rows = pixels_within(mean_px[1], -extent_px[1], extent_px[1], grid.height);
        if columns[0] > columns[1] || rows[0] > rows[1] {
            return None;
        }
        Some(Splat {
            mean_px,
            conic_log2,
            log2_opacity,
            color: each!(i in 3 => self.color[i].0[lane]),
            depth_m,
            extent_px,
            rows_px: [rows[0] as u16, rows[1] as u16],
        })
    }
}

/// First and last pixel of the picture whose centre lies in `mean + low..=mean + high`; the first is larger when
/// there is none.
#[inline(always)]
pub fn pixels_within(mean_px: f32, low_px: f32, high_px: f32, size: usize) -> [i32; 2] {
    let first = (mean_px + low_px - 0.5 - BORDER_MARGIN_PX).ceil().max(0.0);
    let last = (mean_px + high_px - 0.5 + BORDER_MARGIN_PX).floor().min(size as f32 - 1.0);
    [first as i32, last as i32]
}
