//! Forward and backward passes over one view, stage by stage.

use super::anchors::Anchors;
use super::bin::list_entries;
use super::blend::{Blend, BlendJob};
use super::blend_backward::{BlendBackward, BlendBackwardJob};
use super::cull::{Frustum, KeyframeNumbers, ShownGaussians, cull, place_keyframes};
use super::decode_anchors::{SeenAnchors, decode_anchors, place_camera};
use super::decoders::Decoders;
use super::features::Features;
use super::grid::{Grid, MAX_TILE_ROWS};
use super::loss::N_DRAWN;
use super::project::CameraConstants;
use super::reduce::reduce;
use super::simd::Dispatch;
use super::sky::{ComposeRow, Rays};
use super::sort::sort;
use super::splats::{Lists, take_front};
use super::splatting::{CameraView, make_splats};
use crate::pool::Pool;
use crate::splat::{GaussianParams, KeyframePlacement, Overflow, RenderStats, StageClock, View};

/// What every stage runs on.
#[derive(Clone, Copy)]
pub struct Machine<'a> {
    /// Threads.
    pub pool: &'a Pool,
    /// Instruction set.
    pub dispatch: Dispatch,
}

/// Buffers of one view.
pub struct ViewBuffers {
    /// Lists of Gaussians.
    pub lists: Lists,
    /// Camera from each keyframe row.
    pub keyframes: Vec<KeyframeNumbers>,
    /// Where the camera is in the frame of each keyframe row, m.
    pub cameras_in_keyframe_m: Vec<[f32; 3]>,
    /// Every anchor's Gaussians as they are drawn, then their gradients; empty when they are drawn as stored.
    pub shown: Vec<GaussianParams>,
    /// Red, green, blue, depth, transmittance of the largest picture.
    pub planes: Vec<f32>,
    /// Time of the stages.
    pub clock: StageClock,
}

/// What is drawn.
#[derive(Clone, Copy)]
pub struct Map<'a> {
    /// Stored numbers.
    pub anchors: &'a Anchors,
    /// Their features, where the decoder is learned.
    pub features: &'a Features,
    /// The chunks' decoders, where they are learned.
    pub decoders: &'a Decoders,
    /// Map from each keyframe row.
    pub placements: &'a [KeyframePlacement],
    /// Background of the view's chunk.
    pub texels: &'a [[f32; 3]],
}

/// What the backward pass must know of the forward pass.
#[derive(Clone, Copy)]
pub struct Drawn {
    /// From where it was drawn.
    pub view: View,
    /// Size of the picture.
    pub grid: Grid,
    /// The camera.
    pub camera: CameraConstants,
    /// Rays of the view's pixels.
    pub rays: Rays,
    /// Gaussians that passed the first test.
    pub n_candidates: usize,
    /// Gaussians whose splat meets the picture.
    pub n_splats: usize,
    /// Size of the work.
    pub stats: RenderStats,
}

impl ViewBuffers {
    /// The five planes as drawn.
    pub fn drawn(&self, n_pixels: usize) -> [&[f32]; N_DRAWN] {
        core::array::from_fn(|i| &self.planes[i * n_pixels..(i + 1) * n_pixels])
    }

    /// Draws a view into the planes.
    pub fn draw(&mut self, machine: Machine<'_>, map: &Map<'_>, view: &View) -> Drawn {
        let Machine { pool, dispatch } = machine;
        self.clock.restart();
        let grid = Grid::new(view.camera.width as usize, view.camera.height as usize);
        let camera = CameraConstants::of(view);
        let rays = Rays::of(view);
        let frustum = Frustum::of(view);
        place_keyframes(view, map.placements, &mut self.keyframes);
        self.decode(machine, map, view, &frustum);
        let Self { lists, keyframes, .. } = self;
        let anchors = map.anchors;
        let only_marked = map.decoders.is_learned();
        let params = if only_marked { &self.shown } else { &anchors.params };
        let shown = ShownGaussians { fixed: anchors.fixed(), params, slots_end: anchors.slots_end, only_marked };
        let (n_candidates, invisible) = cull(pool, &shown, keyframes, &frustum, lists);
        self.clock.finish("cull");
        let camera_view = CameraView { keyframes, camera, grid };
        make_splats(pool, dispatch, &shown, camera_view, n_candidates, lists);
        self.clock.finish("project");
        let n_splats = sort(pool, n_candidates, lists);
        self.clock.finish("sort");
        let counts = list_entries(pool, dispatch, &grid, n_splats, lists);
        self.clock.finish("bin");
        let pairs = blend(machine, &grid, &rays, map.texels, n_splats, lists, &mut self.planes);
        self.clock.finish("blend");
        let overflow = Overflow {
            visible_gaussians: invisible as u32,
            row_entries: counts.entries_dropped as u32,
            pairs: counts.pairs_dropped as u32,
        };
        let stats = RenderStats {
            visible: n_splats as u32,
            row_entries: counts.entries as u32,
            pairs: pairs as u32,
            overflow,
            refused: false,
        };
        Drawn { view: *view, grid, camera, rays, n_candidates, n_splats, stats }
    }

    /// Fills `shown` where the decoder is learned.
    fn decode(&mut self, machine: Machine<'_>, map: &Map<'_>, view: &View, frustum: &Frustum) {
        if !map.decoders.is_learned() {
            return;
        }
        place_camera(view, map.placements, &mut self.cameras_in_keyframe_m);
        let seen = SeenAnchors {
            fixed: map.anchors.fixed(),
            decoders: map.decoders,
            keyframes: &self.keyframes,
            cameras_in_keyframe_m: &self.cameras_in_keyframe_m,
        };
        let stored = (map.anchors.params.as_slice(), map.features.values());
        let marks = &mut self.lists.visible_bits[..map.anchors.slots_end];
        decode_anchors(machine, seen, stored, frustum, marks, &mut self.shown);
        self.clock.finish("decode");
    }

    /// Gradients of the splats, from those with respect to the planes.
    pub fn draw_backward(&mut self, machine: Machine<'_>, drawn: &Drawn, upstream: [&[f32]; N_DRAWN]) {
        let grid = drawn.grid;
        let n_pixels = grid.n_pixels();
        let planes: [&[f32]; N_DRAWN] = core::array::from_fn(|i| &self.planes[i * n_pixels..(i + 1) * n_pixels]);
        let lists = &mut self.lists;
        let mut rest = &mut lists.entry_grads[..];
        let mut jobs = heapless::Vec::<BlendBackwardJob<'_>, MAX_TILE_ROWS>::new();
        for row in 0..grid.rows {
            let entries = lists.entry_starts[row]..lists.entry_starts[row + 1];
            let pairs = lists.pair_starts[row]..lists.pair_starts[row + 1];
            let first = row * grid.tile_row_pixels();
            let pixels = first..(first + grid.tile_row_pixels()).min(n_pixels);
            let job = BlendBackwardJob {
                row,
                grid,
                sorted: &lists.sorted[..drawn.n_splats],
                entries: &lists.entries[entries.clone()],
                pairs: &lists.pairs[pairs],
                tile_ranges: &lists.tile_ranges[row * grid.columns..(row + 1) * grid.columns],
                drawn: planes.map(|plane| &plane[pixels.clone()]),
                upstream: upstream.map(|plane| &plane[pixels.clone()]),
                entry_grads: take_front(&mut rest, entries.len()),
            };
            if jobs.push(job).is_err() {
                unreachable!("a grid has at most MAX_TILE_ROWS rows");
            }
        }
        // The longest rows first, so that no thread is left with one at the end.
        jobs.sort_unstable_by_key(|job| (core::cmp::Reverse(job.pairs.len()), job.row));
        machine.pool.for_each(&mut jobs, |_, job| machine.dispatch.run(BlendBackward(job)));
        drop(jobs);
        self.clock.finish("blend_backward");
        reduce(machine.pool, &grid, drawn.n_splats, lists);
        self.clock.finish("reduce");
    }
}

/// Lists the pairs, blends them, and puts the background behind; returns the number of pairs.
fn blend(
    machine: Machine<'_>,
    grid: &Grid,
    rays: &Rays,
    texels: &[[f32; 3]],
    n_splats: usize,
    lists: &mut Lists,
    planes: &mut [f32],
) -> usize {
    let n_pixels = grid.n_pixels();
    let mut rest = planes;
    let mut planes: [&mut [f32]; N_DRAWN] = core::array::from_fn(|_| take_front(&mut rest, n_pixels));
    let mut pairs = &mut lists.pairs[..];
    let mut tile_ranges = &mut lists.tile_ranges[..];
    let mut jobs = heapless::Vec::<BlendJob<'_>, MAX_TILE_ROWS>::new();
    for row in 0..grid.rows {
        let n_pairs = lists.pair_starts[row + 1] - lists.pair_starts[row];
        let job = BlendJob {
            row,
            grid: *grid,
            sorted: &lists.sorted[..n_splats],
            entries: &lists.entries[lists.entry_starts[row]..lists.entry_starts[row + 1]],
            pairs: take_front(&mut pairs, n_pairs),
            tile_ranges: take_front(&mut tile_ranges, grid.columns),
            planes: core::array::from_fn(|i| take_front(&mut planes[i], grid.tile_row_pixels())),
            n_pairs: 0,
        };
        if jobs.push(job).is_err() {
            unreachable!("a grid has at most MAX_TILE_ROWS rows");
        }
    }
    jobs.sort_unstable_by_key(|job| (core::cmp::Reverse(job.pairs.len()), job.row));
    machine.pool.for_each(&mut jobs, |_, job| {
        machine.dispatch.run(Blend(job));
        compose(machine.dispatch, rays, texels, job);
    });
    jobs.iter().map(|job| job.n_pairs).sum()
}

fn compose(dispatch: Dispatch, rays: &Rays, texels: &[[f32; 3]], job: &mut BlendJob<'_>) {
    let width = job.grid.width;
    let first_y = job.row * super::grid::TILE_PX;
    let [red, green, blue, _, transmittance] = &mut job.planes;
    for y in 0..transmittance.len() / width {
        let row = y * width..(y + 1) * width;
        let rgb = [&mut red[row.clone()], &mut green[row.clone()], &mut blue[row.clone()]];
        let transmittance = &transmittance[row];
        dispatch.run(ComposeRow { rays, y: first_y + y, texels, transmittance, rgb });
    }
}
