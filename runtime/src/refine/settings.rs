//! What decides which Gaussians stay.

/// How Gaussians come and go while a map is refined (method.md 12).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LifecycleSettings {
    /// Keyframes of a stretch at most, which are trained and scored together. Longer ones cost more memory and are stored
    /// later; shorter ones have more ends, where what is trained has been trained for the neighbours before.
    pub stretch_keyframes: usize,
    /// Anchors that show much of what is wrong get another Gaussian.
    pub densify: bool,
    /// Masked pixels per view, at 480 px width, above which they do.
    pub densify_px: f64,
    /// Anchors with the worst score end.
    pub prune: bool,
    /// What that score counts.
    pub score: PruneScore,
    /// Normalised score above which an anchor ends, [0, 1].
    pub prune_score: f64,
    /// A pixel is wrong when the mean over its channels of the absolute difference is above this, [0, 1].
    pub error_threshold: f32,
    /// Views of a stretch that scores are taken from.
    pub views: usize,
    /// Gaussians per metre of route that stay, turns counted by the mapper's measure; those that contribute least end.
    pub max_gaussians_per_m: f64,
}

/// What the pruning score counts beside a view's loss.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PruneScore {
    /// Pixels where the anchor contributes, as in the paper.
    Paper,
    /// Only those of them where the picture is wrong.
    ErrorWeighted,
}

impl LifecycleSettings {
    /// The values that the shipped maps were measured with.
    pub const MEASURED: Self = Self {
        stretch_keyframes: 100,
        densify: false,
        densify_px: 5.0,
        prune: false,
        score: PruneScore::ErrorWeighted,
        prune_score: 0.99,
        error_threshold: 0.1,
        views: 10,
        max_gaussians_per_m: 260.0,
    };
}
