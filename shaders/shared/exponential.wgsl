// 2^x, and what follows from it, to within rounding whatever the device: software devices approximate theirs to five
// digits, which gradients of thin splats lose. Own fit of 2^x on [-1/2, 1/2], highest power first.
const LOG2_E: f32 = 1.44269504088896;
const EXP2_5: f32 = 1.3264727e-3;
const EXP2_4: f32 = 9.671513e-3;
const EXP2_3: f32 = 5.5507336e-2;
const EXP2_2: f32 = 2.4022242e-1;
const EXP2_1: f32 = 6.93147e-1;

// Saturates at the ends of the normal numbers.
fn power_of_2(v: vec4<f32>) -> vec4<f32> {
    let x = clamp(v, vec4<f32>(-126.0), vec4<f32>(127.0));
    let whole = round(x);
    let f = x - whole;
    let power = ((((EXP2_5 * f + EXP2_4) * f + EXP2_3) * f + EXP2_2) * f + EXP2_1) * f + 1.0;
    return bitcast<vec4<f32>>(bitcast<vec4<i32>>(power) + (vec4<i32>(whole) << vec4<u32>(23u)));
}

fn exponential(v: vec4<f32>) -> vec4<f32> {
    return power_of_2(v * LOG2_E);
}

// The device's logarithm, improved by one step of Newton's method.
fn binary_logarithm(x: f32) -> f32 {
    let guess = log2(x);
    return guess + (x * power_of_2(vec4<f32>(-guess)).x - 1.0) * LOG2_E;
}
