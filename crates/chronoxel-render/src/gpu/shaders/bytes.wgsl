// A picture in 8 bits, as it is read back for a screen: premultiplied red, green, blue and alpha.

// Of rays: red, green and blue multiplied by alpha, and transmittance.
@group(0) @binding(0) var<storage, read> gathered: array<vec4<f32>>;
@group(0) @binding(1) var<storage, read_write> packed: array<u32>;
// Of slices: red, green and blue multiplied by alpha, and alpha.
@group(0) @binding(2) var blended: texture_2d<f32>;

// Pixels may be more than workgroups along one axis.
fn pixel_of(id: vec3<u32>, groups: vec3<u32>) -> u32 {
    return id.x + id.y * groups.x * 64u;
}

@compute @workgroup_size(64)
fn pack_rays(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let at = pixel_of(id, groups);
    if at < min(arrayLength(&gathered), arrayLength(&packed)) {
        let pixel = gathered[at];
        packed[at] = pack4x8unorm(vec4<f32>(pixel.xyz, 1.0 - pixel.w));
    }
}

@compute @workgroup_size(64)
fn pack_slices(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let at = pixel_of(id, groups);
    let size = textureDimensions(blended);
    if at < min(size.x * size.y, arrayLength(&packed)) {
        packed[at] = pack4x8unorm(textureLoad(blended, vec2<u32>(at % size.x, at / size.x), 0));
    }
}
