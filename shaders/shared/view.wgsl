// The uniform block of every kernel.
struct ViewBlock {
    width: u32,
    height: u32,
    tile_columns: u32,
    tile_rows: u32,
    n_slots: u32,
    k: u32,
    candidate_capacity: u32,
    entry_capacity: u32,
    pair_capacity: u32,
    first_texel: u32,
    target_kind: u32,
    has_depth: u32,
    focal_px: vec2<f32>,
    center_px: vec2<f32>,
    min_z1: vec2<f32>,
    max_z1: vec2<f32>,
    stretch_px: vec2<f32>,
    has_exposure: u32,
    l1_weight: f32,
    ray_corner: vec4<f32>,
    ray_right: vec4<f32>,
    ray_down: vec4<f32>,
    gain: vec4<f32>,
    bias: vec4<f32>,
    ssim_weight: f32,
    depth_weight: f32,
    isotropy_weight: f32,
    confidence_sum: f32,
    offset_rate: f32,
    log_scale_rate: f32,
    rotation_rate: f32,
    opacity_rate: f32,
    color_rate: f32,
    background_rate: f32,
    decoder_rows: u32,
    background_step: u32,
    decoder_row: u32,
    decoder_step: u32,
    feature_rate: f32,
    hidden_rate: f32,
    output_offset_rate: f32,
    output_log_scale_rate: f32,
    output_rotation_rate: f32,
    output_opacity_rate: f32,
    output_color_rate: f32,
    finds_pose: u32,
    error_threshold: f32,
    finished_rows: u32,
}
@group(0) @binding(0) var<uniform> view: ViewBlock;

struct IndirectGroups {
    candidates_x: u32,
    candidates_y: u32,
    candidates_z: u32,
    spare: u32,
}

struct KeyframeBlock {
    row_x: vec4<f32>,
    row_y: vec4<f32>,
    row_z: vec4<f32>,
}

// A point of a keyframe's frame in camera coordinates.
fn in_camera(placement: KeyframeBlock, p: vec3<f32>) -> vec3<f32> {
    let h = vec4<f32>(p, 1.0);
    return vec3<f32>(dot(placement.row_x, h), dot(placement.row_y, h), dot(placement.row_z, h));
}
