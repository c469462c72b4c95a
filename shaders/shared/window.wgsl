// Windows of SSIM. A kernel says what is summed: the struct `Sums`, and `add_tap`, which adds one tap of a strip to it.

// Windows of four neighbors together reach over 14 pixels, the taps; what each of them weighs in the windows around the
// pixels 0, 1, 2, 3.
const STRIP: u32 = 4u;
const TAP_0 = vec4<f32>(SSIM_WEIGHTS[0], 0.0, 0.0, 0.0);
const TAP_1 = vec4<f32>(SSIM_WEIGHTS[1], SSIM_WEIGHTS[0], 0.0, 0.0);
const TAP_2 = vec4<f32>(SSIM_WEIGHTS[2], SSIM_WEIGHTS[1], SSIM_WEIGHTS[0], 0.0);
const TAP_3 = vec4<f32>(SSIM_WEIGHTS[3], SSIM_WEIGHTS[2], SSIM_WEIGHTS[1], SSIM_WEIGHTS[0]);
const TAP_4 = vec4<f32>(SSIM_WEIGHTS[4], SSIM_WEIGHTS[3], SSIM_WEIGHTS[2], SSIM_WEIGHTS[1]);
const TAP_5 = vec4<f32>(SSIM_WEIGHTS[5], SSIM_WEIGHTS[4], SSIM_WEIGHTS[3], SSIM_WEIGHTS[2]);
const TAP_6 = vec4<f32>(SSIM_WEIGHTS[6], SSIM_WEIGHTS[5], SSIM_WEIGHTS[4], SSIM_WEIGHTS[3]);
const TAP_7 = vec4<f32>(SSIM_WEIGHTS[7], SSIM_WEIGHTS[6], SSIM_WEIGHTS[5], SSIM_WEIGHTS[4]);
const TAP_8 = vec4<f32>(SSIM_WEIGHTS[8], SSIM_WEIGHTS[7], SSIM_WEIGHTS[6], SSIM_WEIGHTS[5]);
const TAP_9 = vec4<f32>(SSIM_WEIGHTS[9], SSIM_WEIGHTS[8], SSIM_WEIGHTS[7], SSIM_WEIGHTS[6]);
const TAP_10 = vec4<f32>(SSIM_WEIGHTS[10], SSIM_WEIGHTS[9], SSIM_WEIGHTS[8], SSIM_WEIGHTS[7]);
const TAP_11 = vec4<f32>(0.0, SSIM_WEIGHTS[10], SSIM_WEIGHTS[9], SSIM_WEIGHTS[8]);
const TAP_12 = vec4<f32>(0.0, 0.0, SSIM_WEIGHTS[10], SSIM_WEIGHTS[9]);
const TAP_13 = vec4<f32>(0.0, 0.0, 0.0, SSIM_WEIGHTS[10]);

// What the windows around a strip's four pixels add up to. Constant weights instead of a loop: a table that is indexed is
// copied for every pixel.
fn sum_windows(s: Strip) -> Sums {
    var sums = Sums();
    add_tap(s, 0u, TAP_0, &sums);
    add_tap(s, 1u, TAP_1, &sums);
    add_tap(s, 2u, TAP_2, &sums);
    add_tap(s, 3u, TAP_3, &sums);
    add_tap(s, 4u, TAP_4, &sums);
    add_tap(s, 5u, TAP_5, &sums);
    add_tap(s, 6u, TAP_6, &sums);
    add_tap(s, 7u, TAP_7, &sums);
    add_tap(s, 8u, TAP_8, &sums);
    add_tap(s, 9u, TAP_9, &sums);
    add_tap(s, 10u, TAP_10, &sums);
    add_tap(s, 11u, TAP_11, &sums);
    add_tap(s, 12u, TAP_12, &sums);
    add_tap(s, 13u, TAP_13, &sums);
    return sums;
}

// One past the last strip; 0 where SSIM does not count. Not an early return: software Vulkan (Mesa 22.3) does not give the
// memory of such a dispatch back.
fn end_of_strips() -> u32 {
    return select(n_strips(), 0u, view.ssim_weight == 0.0);
}
