//! Numbers that fix what a map is made of. Nothing but constants: the build of the device kernels reads this file too.

/// Trainable numbers per Gaussian.
pub const GAUSSIAN_PARAMS: usize = 14;

/// Levels of the voxel hierarchy, 0 the finest.
pub const N_LEVELS: usize = 5;
/// Distance from the camera at which each level takes over from the finer one, m.
pub const BAND_STARTS_M: [f32; N_LEVELS] = [0.0, 20.0, 40.0, 80.0, 160.0];
/// Half width of the zone around a band's border in which both levels exist, relative to the border's distance.
pub const BAND_OVERLAP_RATIO: f32 = 0.05;
/// Cosine of the angle between the rays to an anchor from its keyframe and from the camera at which half of it is left: 60
/// degrees. A camera that passes an anchor sees it from half its own angle of view at most.
pub const SIDE_BORDER_COSINE: f32 = 0.5;
/// Half the width of the zone around that in which it fades, as a cosine: whole within 46 degrees, gone beyond 72.
pub const SIDE_FADE_COSINE: f32 = 0.2;

/// Features of an anchor.
pub const FEATURE_LEN: usize = 32;
/// Inputs of a decoder that say from where the anchor is seen: direction and logarithm of the distance.
pub const VIEW_INPUTS: usize = 4;
/// Numbers that a decoder reads.
pub const INPUTS: usize = FEATURE_LEN + VIEW_INPUTS;
/// Units of a decoder's hidden layer.
pub const HIDDEN: usize = 32;
/// Binary logarithm of the distance, m, at which a decoder's last input is 0.
pub const LOG2_MIDDLE_DISTANCE: f32 = 4.0;
/// Change of that logarithm that moves the last input by 1: -1 is 2 m, 1 is 128 m.
pub const LOG2_DISTANCE_UNIT: f32 = 3.0;
/// Cameras nearer to an anchor are taken to be this far away, m.
pub const MIN_DISTANCE_M: f32 = 0.125;
