// 2^x, and what follows from it, to within rounding whatever the device: software devices approximate theirs to five
// digits, which gradients of thin splats lose.

// Saturates at the ends of the normal numbers.
fn power_of_2(v: vec4<f32>) -> vec4<f32> {
    let x = clamp(v, vec4<f32>(-126.0), vec4<f32>(127.0));
    let whole = round(x);
    let f = x - whole;
    // Constant indices: a table that is indexed by a variable lies in memory.
    var power = EXP2_COEFFICIENTS[0] * f + EXP2_COEFFICIENTS[1];
    power = power * f + EXP2_COEFFICIENTS[2];
    power = power * f + EXP2_COEFFICIENTS[3];
    power = power * f + EXP2_COEFFICIENTS[4];
    power = power * f + EXP2_COEFFICIENTS[5];
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
