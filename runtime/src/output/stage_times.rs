//! Where the time of a frame went.

/// The parts of the pipeline whose time is reported, in the order of the data.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// Waiting for the frame and reading its header.
    Input,
    /// From pixels to a verified pose.
    Tracking,
    /// Depth of a keyframe and new anchors.
    Insertion,
    /// Map optimisation.
    Mapping,
    /// Pages and keyframe images to disk.
    Store,
}

/// How many stages there are.
pub const N_STAGES: usize = 5;

/// All stages with the names that `frames.csv` and the report give them.
pub const STAGES: [(Stage, &str); N_STAGES] = [
    (Stage::Input, "input"),
    (Stage::Tracking, "tracking"),
    (Stage::Insertion, "insertion"),
    (Stage::Mapping, "mapping"),
    (Stage::Store, "store"),
];

/// Milliseconds per stage of one frame; a stage that did not run has 0.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StageTimes {
    stage_ms: [f32; N_STAGES],
}

impl StageTimes {
    /// Adds time to a stage.
    pub fn add(&mut self, stage: Stage, ms: f32) {
        self.stage_ms[stage as usize] += ms;
    }

    /// Time of a stage, ms.
    pub fn ms(&self, stage: Stage) -> f32 {
        self.stage_ms[stage as usize]
    }

    /// Time of all stages, ms.
    pub fn total_ms(&self) -> f32 {
        self.stage_ms.iter().sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_stage_has_its_own_place() {
        let mut times = StageTimes::default();
        for (idx, (stage, name)) in STAGES.into_iter().enumerate() {
            assert_eq!(stage as usize, idx, "{name}");
            times.add(stage, 1.0);
            times.add(stage, idx as f32);
        }
        assert_eq!(STAGES.map(|(stage, _)| times.ms(stage)), [1.0, 2.0, 3.0, 4.0, 5.0]);
        assert_eq!(times.total_ms(), 15.0);
    }
}
