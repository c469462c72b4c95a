// Adam (Kingma & Ba 2015, algorithm 1).

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
    return BiasCorrection(1.0 / one_minus_exp(step * ADAM_LN_BETA1), 1.0 / sqrt(one_minus_exp(step * ADAM_LN_BETA2)));
}

struct AdamNumber {
    value: f32,
    first: f32,
    second: f32,
}

fn adam(n: AdamNumber, raw_gradient: f32, rate: f32, correction: BiasCorrection) -> AdamNumber {
    // Not a number fails this comparison.
    let gradient = select(0.0, raw_gradient, abs(raw_gradient) < MAX_GRADIENT);
    let first = n.first * ADAM_BETA1 + gradient * (1.0 - ADAM_BETA1);
    let second = n.second * ADAM_BETA2 + gradient * gradient * (1.0 - ADAM_BETA2);
    let denominator = sqrt(second) * correction.second + ADAM_EPSILON;
    return AdamNumber(n.value - rate * correction.first * first / denominator, first, second);
}
