//! Numbers that the kernels, their CPU counterparts and their host share, each written once. WGSL sees all of them under
//! their names. `runtime/build.rs` reads this file too, so it depends on nothing but the numbers of the map.

use super::numbers;
use core::f64::consts;

/// Declares constants and their WGSL text.
macro_rules! constants {
    ($($(#[$attribute:meta])* $name:ident: $type:ty = $value:expr;)+) => {
        $($(#[$attribute])* pub const $name: $type = $value;)+

        /// The constants as WGSL.
        pub fn wgsl() -> String {
            let declarations = [$(declaration(stringify!($name), &$name)),+];
            declarations.concat()
        }
    };
}

constants! {
    /// Largest side of a picture, px: pixel rows and columns are stored in 16 bits.
    MAX_IMAGE_SIDE_PX: u32 = 4096;
    /// Side of a tile, px.
    TILE_PX: u32 = 16;
    /// Side of a block, px: what one invocation blends.
    BLOCK_PX: u32 = 4;
    /// Blocks along the side of a tile.
    BLOCKS_PER_SIDE: u32 = TILE_PX / BLOCK_PX;
    /// Blocks of a tile, one bit each.
    TILE_BLOCKS: u32 = BLOCKS_PER_SIDE * BLOCKS_PER_SIDE;
    /// Most rows (or columns) of tiles.
    MAX_TILE_ROWS: u32 = MAX_IMAGE_SIDE_PX / TILE_PX;

    /// Trained numbers per Gaussian.
    N_PARAMS: u32 = numbers::GAUSSIAN_PARAMS as u32;
    /// Position of the scales' logarithms among the trained numbers, which begin with the offset.
    FIRST_LOG_SCALE: u32 = 3;
    /// Position of the quaternion.
    FIRST_ROTATION: u32 = 6;
    /// Position of the opacity's logit.
    FIRST_OPACITY: u32 = 10;
    /// Position of the colors' logits.
    FIRST_COLOR: u32 = 11;
    /// Below this squared norm a quaternion has no direction; it is divided by this norm instead of its own.
    MIN_QUATERNION_NORM2: f64 = 1e-20;

    /// Levels of detail.
    N_LEVELS: u32 = numbers::N_LEVELS as u32;
    /// Where each level begins, m.
    BAND_STARTS_M: [f32; numbers::N_LEVELS] = numbers::BAND_STARTS_M;
    /// Half width of the zone in which two levels exist, relative to the border's distance.
    BAND_OVERLAP_RATIO: f32 = numbers::BAND_OVERLAP_RATIO;
    /// Where half of an anchor is left as it is seen from farther aside, as a cosine.
    SIDE_BORDER_COSINE: f32 = numbers::SIDE_BORDER_COSINE;
    /// Half width of the zone around that in which it fades, as a cosine.
    SIDE_FADE_COSINE: f32 = numbers::SIDE_FADE_COSINE;

    /// Features of an anchor.
    FEATURE_LEN: u32 = numbers::FEATURE_LEN as u32;
    /// Numbers that a decoder reads: the feature, the direction, the logarithm of the distance.
    INPUTS: u32 = numbers::INPUTS as u32;
    /// Units of a decoder's hidden layer.
    HIDDEN: u32 = numbers::HIDDEN as u32;
    /// Binary logarithm of the distance, m, at which a decoder's last input is 0.
    LOG2_MIDDLE_DISTANCE: f32 = numbers::LOG2_MIDDLE_DISTANCE;
    /// Change of that logarithm that moves the last input by 1.
    LOG2_DISTANCE_UNIT: f32 = numbers::LOG2_DISTANCE_UNIT;
    /// Cameras nearer to an anchor than this are taken to be this far away, m.
    MIN_DISTANCE_M: f32 = numbers::MIN_DISTANCE_M;
    /// How far a decoder may move a Gaussian beyond the picture's border before it is missed there, in extents.
    MOST_SHIFT: f32 = 4.0;
    /// How much larger than stored a Gaussian beyond the border may become before it is missed there.
    MOST_GROWTH: f32 = 2.0;
    /// Pieces of the candidates over which the gradients of a decoder are summed on their own.
    DECODER_PIECES: u32 = 64;
    /// No chunk row.
    NO_ROW: u32 = u32::MAX;

    /// Numbers per splat that blending has gradients for:
    /// moments `0, x, y, xx, xy, yy` of dL/dq, then RGB and depth.
    N_SPLAT_GRADS: u32 = 10;
    /// Binary logarithm of 1/255: a splat dimmer than one 8-bit step cannot change a pixel (Kerbl et al. 2023, app. C).
    LOG2_MIN_ALPHA: f32 = -7.994_353_4;
    /// Keeps a single splat from hiding everything for ever (Kerbl et al. 2023, app. C).
    MAX_ALPHA: f32 = 0.99;
    /// A pixel ends before the Gaussian that would take its transmittance to this or less.
    MIN_TRANSMITTANCE: f32 = 1e-4;
    /// A Gaussian contributes to a pixel when its `T alpha` is at least this: one 8-bit step of its color.
    MIN_CONTRIBUTION: f32 = 1.0 / 255.0;
    /// Variance added to every splat, px^2: the low-pass filter of a pixel.
    SCREEN_DILATION_PX2: f64 = 0.3;
    /// Gaussians nearer than this are not drawn, m.
    NEAR_PLANE_M: f32 = 0.01;
    /// At an opacity of 1 a splat ends where `q = ln 255`, that is at this many standard deviations.
    MAX_SIGMAS: f32 = 3.33;
    /// Rounding errors of an ellipse's border are smaller than this, px.
    BORDER_MARGIN_PX: f32 = 0.01;
    /// Extent of a splat that is never fallen below where it divides, px.
    MIN_EXTENT_PX: f32 = 1e-3;

    /// Texels of a background table around the horizon; column 0 is centred half a texel to the right of the map's
    /// forward axis (`+z`).
    BACKGROUND_COLUMNS: u32 = 128;
    /// Texels of a background table from the lowest to the highest elevation.
    BACKGROUND_ROWS: u32 = 32;
    /// Numbers of one background table.
    TEXEL_NUMBERS: u32 = 3 * BACKGROUND_COLUMNS * BACKGROUND_ROWS;
    /// Lower edge of a background table, rad; a ray below it sees the lowest row.
    BACKGROUND_MIN_ELEVATION_RAD: f32 = -15.0 * core::f32::consts::PI / 180.0;
    /// Upper edge of a background table, rad; a ray above it sees the highest row.
    BACKGROUND_MAX_ELEVATION_RAD: f32 = 60.0 * core::f32::consts::PI / 180.0;

    /// Full scale of a byte.
    BYTE_SCALE: f32 = 1.0 / 255.0;
    /// Pixels from the middle of a window of SSIM to its border (11x11).
    SSIM_RADIUS: u32 = 5;
    /// Weights along a window of SSIM: Gaussian, standard deviation 1.5 px, sum 1.
    SSIM_WEIGHTS: [f32; 11] = [
        0.001_028_380_1, 0.007_598_758, 0.036_000_773, 0.109_360_69, 0.213_005_54, 0.266_011_72, 0.213_005_54,
        0.109_360_69, 0.036_000_773, 0.007_598_758, 0.001_028_380_1,
    ];
    /// Stabilises the ratio of means (Wang et al. 2004: (0.01 L)^2, L = 1).
    SSIM_C1: f64 = 0.0001;
    /// Stabilises the ratio of variances (Wang et al. 2004: (0.03 L)^2, L = 1).
    SSIM_C2: f64 = 0.0009;

    /// Decay of Adam's mean gradient (Kingma & Ba 2015).
    ADAM_BETA1: f64 = 0.9;
    /// Decay of Adam's mean squared gradient.
    ADAM_BETA2: f64 = 0.999;
    /// Binary logarithm of [`ADAM_BETA1`].
    ADAM_LOG2_BETA1: f64 = -0.152_003_093_445_049_97;
    /// Binary logarithm of [`ADAM_BETA2`].
    ADAM_LOG2_BETA2: f64 = -0.001_443_416_869_668_718_6;
    /// Natural logarithm of [`ADAM_BETA1`].
    ADAM_LN_BETA1: f64 = ADAM_LOG2_BETA1 * consts::LN_2;
    /// Natural logarithm of [`ADAM_BETA2`].
    ADAM_LN_BETA2: f64 = ADAM_LOG2_BETA2 * consts::LN_2;
    /// Keeps Adam's division finite; as small as in Kerbl et al. 2023, because gradients of a mean over pixels are tiny.
    ADAM_EPSILON: f64 = 1e-15;
    /// Adam steps of a Gaussian are counted up to here, as the corrections are 1 long before.
    ADAM_MAX_STEPS: u32 = u16::MAX as u32;
    /// A gradient beyond this is the product of an overflow and not followed.
    MAX_GRADIENT: f32 = 1e15;

    /// Circumference of a circle of radius 1/2.
    PI: f64 = consts::PI;
    /// Circumference of a circle of radius 1.
    TAU: f64 = consts::TAU;
    /// Binary logarithm of e.
    LOG2_E: f64 = consts::LOG2_E;
    /// Twice the natural logarithm of 2.
    TWO_LN_2: f64 = 2.0 * consts::LN_2;
    /// Minimax polynomial of `2^x` on [-1/2, 1/2], highest power first; relative error 9.2e-8 before rounding.
    /// Source: own fit (iteratively reweighted least squares of the relative error).
    #[expect(clippy::approx_constant, reason = "the fit differs from ln 2 where the polynomial is cut off")]
    EXP2_COEFFICIENTS: [f32; 6] = [1.326_472_7e-3, 9.671_513e-3, 5.550_733_6e-2, 2.402_224_2e-1, 6.931_47e-1, 1.0];
    /// `atan(x) / x` on [0, 1] in powers of `x^2`, highest first. Source: own fit, likewise.
    ATAN_COEFFICIENTS: [f64; 8] = [
        -0.004_054_566_26, 0.021_862_956_6, -0.055_912_329_2, 0.096_421_979_4, -0.139_086_3, 0.199_465_658,
        -0.333_298_608, 0.999_999_336,
    ];
    /// The longer side of a direction is taken to be at least this where an angle divides by it.
    MIN_DIRECTION: f64 = 1e-30;

    /// Invocations of the kernels that take one Gaussian, pixel or slot each.
    GROUP: u32 = 256;
    /// Invocations of the kernels that list the pairs of one tile.
    TILE_GROUP: u32 = 64;
    /// Invocations of the kernels that take one block of pixels each: four tiles.
    BLEND_GROUP: u32 = 64;
    /// Pieces that the pixels are cut into where every invocation adds up one piece in order (losses).
    LOSS_PIECES: u32 = 16384;
    /// Pieces that a list is cut into where every invocation walks one piece in order (sorting).
    SORT_PIECES: u32 = 1024;
    /// Bits of a sort key that one pass looks at.
    DIGIT_BITS: u32 = 8;
    /// Values of a digit.
    DIGITS: u32 = 1 << DIGIT_BITS;
    /// Sort key of what is not drawn: behind everything.
    NOT_VISIBLE: u32 = u32::MAX;

    /// Words of an anchor's score: contributions, those where the picture is wrong, the radius.
    SCORE_WORDS: u32 = 3;

    /// Kind of a target picture: three bytes per pixel.
    TARGET_RGB8: u32 = 0;
    /// Kind of a target picture: one byte per pixel.
    TARGET_GRAY8: u32 = 1;
    /// Kind of a target picture: three reals per pixel.
    TARGET_RGB_F32: u32 = 2;
    /// Sum of the absolute color differences.
    SUM_ABSOLUTE: u32 = 0;
    /// Sum of the squared color differences.
    SUM_SQUARE: u32 = 1;
    /// Sum of the weighted absolute depth differences, m.
    SUM_DEPTH: u32 = 2;
    /// Sum of SSIM over pixels and channels.
    SUM_SSIM: u32 = 3;
    /// Gradients of the exposure's gains.
    SUM_GAIN: u32 = 4;
    /// Gradients of the exposure's biases.
    SUM_BIAS: u32 = 7;
    /// How the rays of all pixels would turn the sky: `ray x dL/dray`, three numbers, map axes; the last that comes from
    /// pixels.
    SUM_SKY_TURN: u32 = 10;
    /// Sum of the visible Gaussians' anisotropies; the first that comes from candidates.
    SUM_ANISOTROPY: u32 = 13;
    /// Sum of their gradients with respect to the camera's pose, six numbers.
    SUM_POSE: u32 = 14;
    /// Sums of a training view.
    N_LOSS_SUMS: u32 = 20;
    /// Those of them that come from candidates.
    N_CANDIDATE_SUMS: u32 = N_LOSS_SUMS - SUM_ANISOTROPY;
}

/// One constant as WGSL.
fn declaration(name: &str, value: &impl InWgsl) -> String {
    format!("const {name} = {};\n", value.literal())
}

/// A number that WGSL can have.
trait InWgsl {
    /// The number with its type.
    fn literal(&self) -> String;
}

impl InWgsl for u32 {
    fn literal(&self) -> String {
        format!("{self}u")
    }
}

impl InWgsl for f32 {
    fn literal(&self) -> String {
        format!("{self:?}f")
    }
}

impl InWgsl for f64 {
    fn literal(&self) -> String {
        (*self as f32).literal()
    }
}

impl<T: InWgsl, const N: usize> InWgsl for [T; N] {
    fn literal(&self) -> String {
        format!("array({})", self.iter().map(T::literal).collect::<Vec<_>>().join(", "))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_follows_from_other_constants_does() {
        assert!((LOG2_MIN_ALPHA - (1.0f32 / 255.0).log2()).abs() < 1e-6);
        assert!((MAX_SIGMAS - (2.0 * 255.0f32.ln()).sqrt()).abs() < 1e-3);
        for (log2, beta) in [(ADAM_LOG2_BETA1, ADAM_BETA1), (ADAM_LOG2_BETA2, ADAM_BETA2)] {
            assert!((log2 - beta.log2()).abs() < 1e-15, "{log2} is not the logarithm of {beta}");
        }
        let gaussian = |i: usize| (-0.5 * ((i as f64 - f64::from(SSIM_RADIUS)) / 1.5).powi(2)).exp();
        let sum: f64 = (0..SSIM_WEIGHTS.len()).map(gaussian).sum();
        for (i, weight) in SSIM_WEIGHTS.into_iter().enumerate() {
            assert!((f64::from(weight) - gaussian(i) / sum).abs() < 1e-7, "weight {i} is {weight}");
        }
    }

    #[test]
    fn wgsl_sees_every_kind_of_number() {
        let text = wgsl();
        for line in [
            "const TILE_PX = 16u;",
            "const MAX_ALPHA = 0.99f;",
            "const MIN_QUATERNION_NORM2 = 1e-20f;",
            "const BAND_STARTS_M = array(0.0f, 20.0f, 40.0f, 80.0f, 160.0f);",
        ] {
            assert!(text.lines().any(|found| found == line), "no line {line}");
        }
    }
}
