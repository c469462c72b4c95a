//! What is exchanged in the mapper.

/// Settings of a drive and of the refinement of its map.
pub(super) struct Arm {
    /// Name in the tables.
    pub name: &'static str,
    /// Settings of the drive and of the refinement.
    pub mapping: &'static [&'static str],
    /// Settings of the refinement alone: arms with the same drive share its map.
    pub refining: &'static [&'static str],
}

/// Arms that show what a map forgets: they have this in their names.
pub(super) const DECODERS: &str = "decoder";

/// All arms. Every one of them inserts by the same quota.
pub(super) const ARMS: [Arm; 16] = [
    drive("ours", &[]),
    drive("insertion: random", &["mapping.insertion=random"]),
    drive("insertion: Canny", &["mapping.insertion=canny"]),
    drive("insertion: LoG", &["mapping.insertion=log"]),
    drive("insertion: no depth gradient", &["mapping.insertion_depth_edge_weight=0"]),
    drive("insertion: no NMS", &["mapping.insertion_suppression=false"]),
    drive("decoder: one per chunk", &["mapping.decoder=learned"]),
    drive("decoder: one for all chunks", &["mapping.decoder=shared"]),
    lifecycle("lifecycle: densify", &["lifecycle.densify=true"]),
    lifecycle("lifecycle: prune, error-weighted", &["lifecycle.prune=true"]),
    lifecycle("lifecycle: prune, paper", &["lifecycle.prune=true", "lifecycle.score=paper"]),
    lifecycle("lifecycle: densify, prune, error-weighted", &["lifecycle.densify=true", "lifecycle.prune=true"]),
    lifecycle(
        "lifecycle: densify, prune, paper",
        &["lifecycle.densify=true", "lifecycle.prune=true", "lifecycle.score=paper"],
    ),
    // What is scored together; 100 keyframes unless told otherwise.
    lifecycle("lifecycle: chunks of 20", &["lifecycle.stretch_keyframes=20"]),
    lifecycle(
        "lifecycle: chunks of 20, densify, prune, error-weighted",
        &["lifecycle.stretch_keyframes=20", "lifecycle.densify=true", "lifecycle.prune=true"],
    ),
    lifecycle(
        "lifecycle: chunks of 20, densify, prune, paper",
        &["lifecycle.stretch_keyframes=20", "lifecycle.densify=true", "lifecycle.prune=true", "lifecycle.score=paper"],
    ),
];

const fn drive(name: &'static str, mapping: &'static [&'static str]) -> Arm {
    Arm { name, mapping, refining: &[] }
}

const fn lifecycle(name: &'static str, refining: &'static [&'static str]) -> Arm {
    Arm { name, mapping: &[], refining }
}

impl Arm {
    /// Whether its map is asked what it forgot: with each kind of decoder, and without one.
    pub fn shows_forgetting(&self) -> bool {
        self.name.starts_with(DECODERS) || (self.mapping.is_empty() && self.refining.is_empty())
    }
}

/// Folder name for an arm.
pub(super) fn folder_name(name: &str) -> String {
    name.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '-' }).collect()
}
