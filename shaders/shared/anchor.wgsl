struct DeviceAnchor {
    position_x: f32,
    position_y: f32,
    position_z: f32,
    keyframe_row: u32,
    extent_x: f32,
    extent_y: f32,
    extent_z: f32,
    packed: u32,
}

fn position_of(anchor: DeviceAnchor) -> vec3<f32> {
    return vec3<f32>(anchor.position_x, anchor.position_y, anchor.position_z);
}

fn extent_of(anchor: DeviceAnchor) -> vec3<f32> {
    return vec3<f32>(anchor.extent_x, anchor.extent_y, anchor.extent_z);
}

fn level_of(anchor: DeviceAnchor) -> u32 {
    return anchor.packed & 0xffu;
}

fn n_gaussians_of(anchor: DeviceAnchor) -> u32 {
    return (anchor.packed >> 8u) & 0xffu;
}

fn chunk_row_of(anchor: DeviceAnchor) -> u32 {
    return anchor.packed >> 16u;
}
