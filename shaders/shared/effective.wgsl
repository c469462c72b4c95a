@group(0) @binding(1) var<storage, read> anchors: array<DeviceAnchor>;
@group(0) @binding(2) var<storage, read> keyframes: array<KeyframeBlock>;
@group(0) @binding(3) var<storage, read> candidates: array<u32>;

fn effective_at(i: u32, candidate: u32) -> f32 {
    return effective[i * view.candidate_capacity + candidate];
}

fn effective_numbers(c: u32) -> Numbers {
    return Numbers(
        vec3<f32>(effective_at(0u, c), effective_at(1u, c), effective_at(2u, c)),
        vec3<f32>(effective_at(3u, c), effective_at(4u, c), effective_at(5u, c)),
        vec4<f32>(effective_at(6u, c), effective_at(7u, c), effective_at(8u, c), effective_at(9u, c)),
        effective_at(10u, c),
        vec3<f32>(effective_at(11u, c), effective_at(12u, c), effective_at(13u, c)),
    );
}
