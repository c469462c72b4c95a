// A Gaussian in its keyframe's frame.
struct Decoded {
    mean: vec3<f32>,
    // Unit quaternion xyzw.
    rotation: vec4<f32>,
    // Standard deviations along its axes, m.
    scale: vec3<f32>,
    opacity: f32,
    color: vec3<f32>,
}

// The numbers of a Gaussian before they are decoded, or gradients with respect to them.
struct Numbers {
    offset: vec3<f32>,
    log_scale: vec3<f32>,
    rotation: vec4<f32>,
    opacity: f32,
    color: vec3<f32>,
}

// Logistic function of four numbers.
fn sigmoid(x: vec4<f32>) -> vec4<f32> {
    return 1.0 / (1.0 + exponential(-x));
}

// Exponentials of three numbers.
fn exponential3(x: vec3<f32>) -> vec3<f32> {
    return exponential(vec4<f32>(x, 0.0)).xyz;
}

fn inverse_quaternion_norm(q: vec4<f32>) -> f32 {
    return 1.0 / sqrt(max(dot(q, q), MIN_QUATERNION_NORM2));
}

fn decode(position: vec3<f32>, extent: vec3<f32>, n: Numbers) -> Decoded {
    let logistic = sigmoid(vec4<f32>(n.color, n.opacity));
    return Decoded(
        position + n.offset * extent,
        n.rotation * inverse_quaternion_norm(n.rotation),
        extent * exponential3(n.log_scale),
        logistic.w,
        logistic.xyz,
    );
}

// Gradients with respect to the numbers, from those with respect to the decoded Gaussian.
fn decode_backward(extent: vec3<f32>, n: Numbers, g: Decoded, grad: Decoded) -> Numbers {
    let along = dot(g.rotation, grad.rotation);
    return Numbers(
        grad.mean * extent,
        grad.scale * g.scale,
        (grad.rotation - g.rotation * along) * inverse_quaternion_norm(n.rotation),
        grad.opacity * g.opacity * (1.0 - g.opacity),
        grad.color * g.color * (1.0 - g.color),
    );
}
