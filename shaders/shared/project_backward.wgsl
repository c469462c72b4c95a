// Gradients with respect to what is blended.
struct SplatGradient {
    mean_px: vec2<f32>,
    // With respect to the square root of the covariance on the picture, row by row.
    root_px_x: vec3<f32>,
    root_px_y: vec3<f32>,
    opacity: f32,
    color: vec3<f32>,
    depth: f32,
}

// Gradient with respect to the quaternion's components, from that with respect to the columns of the matrix.
fn rotation_backward(q: vec4<f32>, d: mat3x3<f32>) -> vec4<f32> {
    let xy = d[1].x + d[0].y;
    let xz = d[2].x + d[0].z;
    let yz = d[2].y + d[1].z;
    let about_x = d[1].z - d[2].y;
    let about_y = d[2].x - d[0].z;
    let about_z = d[0].y - d[1].x;
    return 2.0 * vec4<f32>(
        q.y * xy + q.z * xz + q.w * about_x - 2.0 * q.x * (d[1].y + d[2].z),
        q.x * xy + q.z * yz + q.w * about_y - 2.0 * q.y * (d[0].x + d[2].z),
        q.x * xz + q.y * yz + q.w * about_z - 2.0 * q.z * (d[0].x + d[1].y),
        q.x * about_x + q.y * about_y + q.z * about_z,
    );
}

// Gradients with respect to what is projected.
struct ProjectedGradient {
    gaussian: Decoded,
    mean_in_camera: vec3<f32>,
    // Column by column.
    root: mat3x3<f32>,
}

// With respect to the turning omega of a left increment of the camera's pose: a mean moves by omega x mean, the columns of
// the covariance's root turn by omega x column. (That of the moving is that of the mean.)
fn turn_of(p: Projected, grad: ProjectedGradient) -> vec3<f32> {
    return cross(p.mean_in_camera, grad.mean_in_camera) + cross(p.root[0], grad.root[0])
        + cross(p.root[1], grad.root[1]) + cross(p.root[2], grad.root[2]);
}

// Gradients with respect to the decoded Gaussian, from those with respect to its splat.
fn project_backward(placement: KeyframeBlock, g: Decoded, p: Projected, grad: SplatGradient) -> ProjectedGradient {
    let grad_root_px_x = grad.root_px_x;
    let grad_root_px_y = grad.root_px_y;
    let inverse_z = 1.0 / p.mean_in_camera.z;
    let z1 = p.mean_in_camera.xy * inverse_z;
    let along = view.focal_px * inverse_z;
    let grad_root_x = along.x * grad_root_px_x;
    let grad_root_y = along.y * grad_root_px_y;
    let grad_root_z = -p.linearised_z1.x * grad_root_x - p.linearised_z1.y * grad_root_y;
    // root_px scales with 1/z, and moves with the linearisation point where that is not clamped.
    let grad_along = vec2<f32>(dot(grad_root_px_x, p.root_px_x), dot(grad_root_px_y, p.root_px_y));
    let depth_row = row(p.root, 2u);
    let inside = (view.min_z1 < z1) & (z1 < view.max_z1);
    let by_point = -along * vec2<f32>(dot(grad_root_px_x, depth_row), dot(grad_root_px_y, depth_row));
    let grad_z1 = select(vec2<f32>(), by_point, inside) + grad.mean_px * view.focal_px;
    let by_depth = (grad_along + grad_z1 * z1) * inverse_z;
    let grad_mean = vec3<f32>(grad_z1 * inverse_z, grad.depth - by_depth.x - by_depth.y);

    let linear = linear_of(placement);
    let to_keyframe = transpose(linear);
    // Columns of the gradient of root, from its rows.
    let grad_root = transpose(mat3x3<f32>(grad_root_x, grad_root_y, grad_root_z));
    let grad_oriented = to_keyframe * grad_root;
    let grad_rotation =
        mat3x3<f32>(grad_oriented[0] * g.scale.x, grad_oriented[1] * g.scale.y, grad_oriented[2] * g.scale.z);
    let gaussian = Decoded(
        to_keyframe * grad_mean,
        rotation_backward(g.rotation, grad_rotation),
        vec3<f32>(
            dot(p.rotation[0], grad_oriented[0]),
            dot(p.rotation[1], grad_oriented[1]),
            dot(p.rotation[2], grad_oriented[2]),
        ),
        grad.opacity,
        grad.color,
    );
    return ProjectedGradient(gaussian, grad_mean, grad_root);
}
