//! A backend that draws nothing and remembers what it was told: what a viewer does can be read off it.

use crate::splat::{
    AnchorFeature, AnchorHeader, AnchorScore, Capacities, Exposure, GaussianParams, KeyframePlacement, RenderStats,
    RenderTarget, ScoreReport, SplatBackend, StepReport, StepSettings, TrainingView, View,
};
use std::collections::BTreeMap;

pub(super) struct StubBackend {
    capacities: Capacities,
    anchors: BTreeMap<u32, AnchorHeader>,
    keyframes: BTreeMap<u32, KeyframePlacement>,
    backgrounds: BTreeMap<u16, [f32; 3]>,
    /// Per render: distances of the live anchors' keyframes along z, rounded to metres.
    pub(super) shown_z_m: Vec<Vec<i64>>,
}

impl StubBackend {
    pub(super) fn new(anchors: usize, keyframe_rows: usize, chunk_rows: usize) -> Self {
        Self {
            capacities: Capacities { keyframe_rows, chunk_rows, ..Capacities::for_map(anchors, 2, 32, 16) },
            anchors: BTreeMap::new(),
            keyframes: BTreeMap::new(),
            backgrounds: BTreeMap::new(),
            shown_z_m: Vec::new(),
        }
    }
}

impl SplatBackend for StubBackend {
    fn capacities(&self) -> &Capacities {
        &self.capacities
    }

    fn write_anchors(&mut self, slots: &[u32], headers: &[AnchorHeader], params: &[GaussianParams]) -> usize {
        assert_eq!(params.len(), slots.len() * self.capacities.gaussians_per_anchor);
        for (slot, header) in slots.iter().zip(headers) {
            assert!((*slot as usize) < self.capacities.anchors);
            assert!(self.keyframes.contains_key(&header.keyframe_row), "the keyframe is placed first");
            assert!(self.backgrounds.contains_key(&header.chunk_row), "the chunk is there first");
            assert_eq!(self.anchors.insert(*slot, *header), None, "slot {slot} was in use");
        }
        0
    }

    fn read_anchors(&self, _: &[u32], _: &mut [AnchorHeader], _: &mut [GaussianParams]) -> usize {
        0
    }

    fn write_features(&mut self, slots: &[u32], _: &[AnchorFeature]) -> usize {
        slots.len()
    }

    fn read_features(&self, slots: &[u32], _: &mut [AnchorFeature]) -> usize {
        slots.len()
    }

    fn retire_anchors(&mut self, slots: &[u32]) -> usize {
        slots.iter().filter(|slot| self.anchors.remove(slot).is_none()).count()
    }

    fn set_keyframes(&mut self, first_row: u32, placements: &[KeyframePlacement]) -> usize {
        self.keyframes.extend((first_row..).zip(placements.iter().copied()));
        0
    }

    fn write_background(&mut self, chunk_row: u16, texels: &[[f32; 3]]) -> bool {
        self.backgrounds.insert(chunk_row, texels[0]);
        true
    }

    fn read_background(&self, _: u16, _: &mut [[f32; 3]]) -> bool {
        false
    }

    fn write_decoder(&mut self, _: u16, _: &[f32]) -> bool {
        false
    }

    fn read_decoder(&self, _: u16, _: &mut [f32]) -> bool {
        false
    }

    fn write_exposure(&mut self, _: u32, _: Exposure) -> bool {
        false
    }

    fn read_exposure(&self, _: u32) -> Option<Exposure> {
        None
    }

    fn render(&mut self, view: &View, target: RenderTarget<'_>) -> RenderStats {
        let z_m = |header: &AnchorHeader| self.keyframes[&header.keyframe_row].translation_m.z.round() as i64;
        let mut shown: Vec<i64> = self.anchors.values().map(z_m).collect();
        shown.sort_unstable();
        self.shown_z_m.push(shown);
        target.rgb.fill(self.backgrounds[&view.chunk_row]);
        RenderStats { refused: view.camera.width > self.capacities.image_width_px, ..RenderStats::default() }
    }

    fn train_step(&mut self, _: &TrainingView<'_>, _: &StepSettings) -> StepReport {
        StepReport::default()
    }

    fn score_view(&mut self, _: &TrainingView<'_>, _: f32, _: &mut [AnchorScore]) -> ScoreReport {
        ScoreReport::default()
    }
}
