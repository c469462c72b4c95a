// A projected Gaussian, with what its gradient needs again.
struct Projected {
    mean_px: vec2<f32>,
    // xx, xy, yy with the dilation, px^2.
    covariance_px2: vec3<f32>,
    // The inverse: xx, xy, yy.
    conic: vec3<f32>,
    mean_in_camera: vec3<f32>,
    // Where the projection is linearised.
    linearised_z1: vec2<f32>,
    // Rotation of the Gaussian.
    rotation: mat3x3<f32>,
    // A square root of the covariance in the camera's frame: linear * rotation * diag(scale).
    root: mat3x3<f32>,
    // jacobian * root, row by row: a square root of the covariance on the picture.
    root_px_x: vec3<f32>,
    root_px_y: vec3<f32>,
}

// Matrices of WGSL are columns; the rows of `root` are needed.
fn row(m: mat3x3<f32>, i: u32) -> vec3<f32> {
    return vec3<f32>(m[0][i], m[1][i], m[2][i]);
}

fn rotation_matrix(q: vec4<f32>) -> mat3x3<f32> {
    return mat3x3<f32>(
        vec3<f32>(1.0 - 2.0 * (q.y * q.y + q.z * q.z), 2.0 * (q.x * q.y + q.w * q.z), 2.0 * (q.x * q.z - q.w * q.y)),
        vec3<f32>(2.0 * (q.x * q.y - q.w * q.z), 1.0 - 2.0 * (q.x * q.x + q.z * q.z), 2.0 * (q.y * q.z + q.w * q.x)),
        vec3<f32>(2.0 * (q.x * q.z + q.w * q.y), 2.0 * (q.y * q.z - q.w * q.x), 1.0 - 2.0 * (q.x * q.x + q.y * q.y)),
    );
}

fn linear_of(placement: KeyframeBlock) -> mat3x3<f32> {
    return transpose(mat3x3<f32>(placement.row_x.xyz, placement.row_y.xyz, placement.row_z.xyz));
}

// EWA projection (Zwicker et al. 2002, eq. 24-31), linearised within the widened field of view.
fn project(placement: KeyframeBlock, g: Decoded) -> Projected {
    let p = in_camera(placement, g.mean);
    let inverse_z = 1.0 / p.z;
    let z1 = p.xy * inverse_z;
    let linearised = clamp(z1, view.min_z1, view.max_z1);
    let rotation = rotation_matrix(g.rotation);
    let oriented = mat3x3<f32>(rotation[0] * g.scale.x, rotation[1] * g.scale.y, rotation[2] * g.scale.z);
    let root = linear_of(placement) * oriented;
    let depth_row = row(root, 2u);
    let along = view.focal_px * inverse_z;
    let root_px_x = along.x * (row(root, 0u) - linearised.x * depth_row);
    let root_px_y = along.y * (row(root, 1u) - linearised.y * depth_row);
    let xx = dot(root_px_x, root_px_x) + SCREEN_DILATION_PX2;
    let xy = dot(root_px_x, root_px_y);
    let yy = dot(root_px_y, root_px_y) + SCREEN_DILATION_PX2;
    // Lagrange's identity: no difference of large products, which would leave nothing of a needle's determinant.
    let normal = cross(root_px_x, root_px_y);
    let determinant = SCREEN_DILATION_PX2 * (xx + yy - SCREEN_DILATION_PX2) + dot(normal, normal);
    return Projected(
        z1 * view.focal_px + view.center_px,
        vec3<f32>(xx, xy, yy),
        vec3<f32>(yy, -xy, xx) / determinant,
        p,
        linearised,
        rotation,
        root,
        root_px_x,
        root_px_y,
    );
}
