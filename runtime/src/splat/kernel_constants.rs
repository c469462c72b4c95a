//! Numbers that kernels and their host share, once; `runtime/build.rs` reads this file too, so it depends on nothing.

/// Side of a tile, px.
pub const TILE_PX: u32 = 16;
/// Side of a block, px: what one invocation blends.
pub const BLOCK_PX: u32 = 4;
/// Blocks along the side of a tile.
pub const BLOCKS_PER_SIDE: u32 = TILE_PX / BLOCK_PX;
/// Blocks of a tile, one bit each.
pub const TILE_BLOCKS: u32 = BLOCKS_PER_SIDE * BLOCKS_PER_SIDE;
/// Most rows (or columns) of tiles.
pub const MAX_TILE_ROWS: u32 = 256;
/// Trained numbers per Gaussian.
pub const N_PARAMS: u32 = 14;
/// Position of the scales' logarithms among the trained numbers.
pub const FIRST_LOG_SCALE: u32 = 3;
/// Position of the quaternion.
pub const FIRST_ROTATION: u32 = 6;
/// Position of the opacity's logit, which the colors' logits follow.
pub const FIRST_OPACITY: u32 = 10;
/// Numbers per splat that blending has gradients for.
pub const N_SPLAT_GRADS: u32 = 10;
/// Binary logarithm of the smallest alpha that is blended.
pub const LOG2_MIN_ALPHA: f32 = -7.994_353_4;
/// Largest alpha of a single splat.
pub const MAX_ALPHA: f32 = 0.99;
/// A pixel ends before the Gaussian that would take its transmittance to this or less.
pub const MIN_TRANSMITTANCE: f32 = 1e-4;
/// Variance added to every splat, px^2.
pub const SCREEN_DILATION_PX2: f32 = 0.3;
/// Gaussians nearer than this are not drawn, m.
pub const NEAR_PLANE_M: f32 = 0.01;
/// At an opacity of 1 a splat ends at this many standard deviations.
pub const MAX_SIGMAS: f32 = 3.33;
/// Below this squared norm a quaternion has no direction.
pub const MIN_QUATERNION_NORM2: f32 = 1e-20;
/// Rounding errors of an ellipse's border are smaller than this, px.
pub const BORDER_MARGIN_PX: f32 = 0.01;
/// Extent of a splat that is never fallen below where it divides, px.
pub const MIN_EXTENT_PX: f32 = 1e-3;
/// Texels of a background table around the horizon.
pub const BACKGROUND_COLUMNS: u32 = 128;
/// Texels of a background table from the lowest to the highest elevation.
pub const BACKGROUND_ROWS: u32 = 32;
/// Numbers of one background table.
pub const TEXEL_NUMBERS: u32 = 3 * BACKGROUND_COLUMNS * BACKGROUND_ROWS;
/// Lower edge of a background table, rad.
pub const BACKGROUND_MIN_ELEVATION_RAD: f32 = -15.0 * core::f32::consts::PI / 180.0;
/// Upper edge of a background table, rad.
pub const BACKGROUND_MAX_ELEVATION_RAD: f32 = 60.0 * core::f32::consts::PI / 180.0;
/// Levels of detail.
pub const N_LEVELS: u32 = 5;
/// Half width of the zone in which two levels exist, relative to the border's distance.
pub const BAND_OVERLAP_RATIO: f32 = 0.05;
/// Where each level begins, m.
pub const BAND_STARTS_M: [f32; N_LEVELS as usize] = [0.0, 20.0, 40.0, 80.0, 160.0];

/// Invocations of the kernels that take one Gaussian, pixel or slot each.
pub const GROUP: u32 = 256;
/// Invocations of the kernels that list the pairs of one tile.
pub const TILE_GROUP: u32 = 64;
/// Invocations of the kernels that take one block of pixels each: four tiles.
pub const BLEND_GROUP: u32 = 64;
/// Pieces that the pixels are cut into where every invocation adds up one piece in order (losses).
pub const LOSS_PIECES: u32 = 16384;
/// Kind of a target picture: three bytes per pixel.
pub const TARGET_RGB8: u32 = 0;
/// Kind of a target picture: one byte per pixel.
pub const TARGET_GRAY8: u32 = 1;
/// Kind of a target picture: three reals per pixel.
pub const TARGET_RGB_F32: u32 = 2;
/// Sum of the absolute color differences.
pub const SUM_ABSOLUTE: u32 = 0;
/// Sum of the squared color differences.
pub const SUM_SQUARE: u32 = 1;
/// Sum of the weighted absolute depth differences, m.
pub const SUM_DEPTH: u32 = 2;
/// Sum of SSIM over pixels and channels.
pub const SUM_SSIM: u32 = 3;
/// Gradients of the exposure's gains.
pub const SUM_GAIN: u32 = 4;
/// Gradients of the exposure's biases.
pub const SUM_BIAS: u32 = 7;
/// Sum of the visible Gaussians' anisotropies; the only one that does not come from pixels.
pub const SUM_ANISOTROPY: u32 = 10;
/// Sums of a training view.
pub const N_LOSS_SUMS: u32 = 11;
/// Pieces that a list is cut into where every invocation walks one piece in order (sorting).
pub const SORT_PIECES: u32 = 1024;
/// Bits of a sort key that one pass looks at.
pub const DIGIT_BITS: u32 = 8;
/// Values of a digit.
pub const DIGITS: u32 = 1 << DIGIT_BITS;
/// Sort key of what is not drawn: behind everything.
pub const NOT_VISIBLE: u32 = u32::MAX;

/// A constant as WGSL sees it.
pub enum Value {
    /// Unsigned.
    U32(u32),
    /// Real.
    F32(f32),
    /// Reals.
    F32s(&'static [f32]),
}

/// All constants by name, in the order of the generated text.
pub const ALL: &[(&str, Value)] = &[
    ("TILE_PX", Value::U32(TILE_PX)),
    ("BLOCK_PX", Value::U32(BLOCK_PX)),
    ("BLOCKS_PER_SIDE", Value::U32(BLOCKS_PER_SIDE)),
    ("TILE_BLOCKS", Value::U32(TILE_BLOCKS)),
    ("MAX_TILE_ROWS", Value::U32(MAX_TILE_ROWS)),
    ("N_PARAMS", Value::U32(N_PARAMS)),
    ("N_SPLAT_GRADS", Value::U32(N_SPLAT_GRADS)),
    ("LOG2_MIN_ALPHA", Value::F32(LOG2_MIN_ALPHA)),
    ("MAX_ALPHA", Value::F32(MAX_ALPHA)),
    ("MIN_TRANSMITTANCE", Value::F32(MIN_TRANSMITTANCE)),
    ("SCREEN_DILATION_PX2", Value::F32(SCREEN_DILATION_PX2)),
    ("NEAR_PLANE_M", Value::F32(NEAR_PLANE_M)),
    ("MAX_SIGMAS", Value::F32(MAX_SIGMAS)),
    ("MIN_QUATERNION_NORM2", Value::F32(MIN_QUATERNION_NORM2)),
    ("BORDER_MARGIN_PX", Value::F32(BORDER_MARGIN_PX)),
    ("MIN_EXTENT_PX", Value::F32(MIN_EXTENT_PX)),
    ("BACKGROUND_COLUMNS", Value::U32(BACKGROUND_COLUMNS)),
    ("BACKGROUND_ROWS", Value::U32(BACKGROUND_ROWS)),
    ("BACKGROUND_MIN_ELEVATION_RAD", Value::F32(BACKGROUND_MIN_ELEVATION_RAD)),
    ("BACKGROUND_MAX_ELEVATION_RAD", Value::F32(BACKGROUND_MAX_ELEVATION_RAD)),
    ("N_LEVELS", Value::U32(N_LEVELS)),
    ("BAND_OVERLAP_RATIO", Value::F32(BAND_OVERLAP_RATIO)),
    ("BAND_STARTS_M", Value::F32s(&BAND_STARTS_M)),
    ("GROUP", Value::U32(GROUP)),
    ("TILE_GROUP", Value::U32(TILE_GROUP)),
    ("BLEND_GROUP", Value::U32(BLEND_GROUP)),
    ("SORT_PIECES", Value::U32(SORT_PIECES)),
    ("DIGIT_BITS", Value::U32(DIGIT_BITS)),
    ("DIGITS", Value::U32(DIGITS)),
    ("NOT_VISIBLE", Value::U32(NOT_VISIBLE)),
    ("FIRST_LOG_SCALE", Value::U32(FIRST_LOG_SCALE)),
    ("FIRST_ROTATION", Value::U32(FIRST_ROTATION)),
    ("FIRST_OPACITY", Value::U32(FIRST_OPACITY)),
    ("LOSS_PIECES", Value::U32(LOSS_PIECES)),
    ("TARGET_RGB8", Value::U32(TARGET_RGB8)),
    ("TARGET_GRAY8", Value::U32(TARGET_GRAY8)),
    ("TARGET_RGB_F32", Value::U32(TARGET_RGB_F32)),
    ("SUM_ABSOLUTE", Value::U32(SUM_ABSOLUTE)),
    ("SUM_SQUARE", Value::U32(SUM_SQUARE)),
    ("SUM_DEPTH", Value::U32(SUM_DEPTH)),
    ("SUM_SSIM", Value::U32(SUM_SSIM)),
    ("SUM_GAIN", Value::U32(SUM_GAIN)),
    ("SUM_BIAS", Value::U32(SUM_BIAS)),
    ("SUM_ANISOTROPY", Value::U32(SUM_ANISOTROPY)),
    ("N_LOSS_SUMS", Value::U32(N_LOSS_SUMS)),
    ("TEXEL_NUMBERS", Value::U32(TEXEL_NUMBERS)),
];

/// The constants as WGSL.
pub fn wgsl() -> String {
    ALL.iter()
        .map(|(name, value)| match value {
            Value::U32(v) => format!("const {name}: u32 = {v}u;\n"),
            Value::F32(v) => format!("const {name}: f32 = {v:?}f;\n"),
            Value::F32s(v) => {
                let list: Vec<String> = v.iter().map(|x| format!("{x:?}f")).collect();
                format!("const {name} = array<f32, {}>({});\n", v.len(), list.join(", "))
            }
        })
        .collect()
}
