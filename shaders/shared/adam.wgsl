// Adam (Kingma & Ba 2015, algorithm 1).
const BETA1: f32 = 0.9;
const BETA2: f32 = 0.999;
const LN_BETA1: f32 = -0.105360515657826;
const LN_BETA2: f32 = -0.00100050033358353;
const EPSILON: f32 = 1e-15;
// A gradient beyond this is the product of an overflow and not followed.
const MAX_GRADIENT: f32 = 1e15;

// Corrections of the two running means for their start at zero.
struct BiasCorrection {
    first: f32,
    second: f32,
}

// 1 - exp(x) for x <= 0, exact to the last digits near zero too.
fn one_minus_exp(x: f32) -> f32 {
    let series = -x * (1.0 + x * (0.5 + x * (1.0 / 6.0 + x * (1.0 / 24.0 + x * (1.0 / 120.0)))));
    return select(1.0 - exp(x), series, x > -0.25);
}

fn bias_correction(step: f32) -> BiasCorrection {
    return BiasCorrection(1.0 / one_minus_exp(step * LN_BETA1), 1.0 / sqrt(one_minus_exp(step * LN_BETA2)));
}

struct AdamNumber {
    value: f32,
    first: f32,
    second: f32,
}

fn adam(n: AdamNumber, raw_gradient: f32, rate: f32, correction: BiasCorrection) -> AdamNumber {
    // Not a number fails this comparison.
    let gradient = select(0.0, raw_gradient, abs(raw_gradient) < MAX_GRADIENT);
    let first = n.first * BETA1 + gradient * (1.0 - BETA1);
    let second = n.second * BETA2 + gradient * gradient * (1.0 - BETA2);
    let denominator = sqrt(second) * correction.second + EPSILON;
    return AdamNumber(n.value - rate * correction.first * first / denominator, first, second);
}
