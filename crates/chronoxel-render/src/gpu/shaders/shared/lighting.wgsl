// Two-sided local lighting of a sample by its gradient. Twins: `twins::power`, `twins::headlight_terms`.

struct Lighting {
    // From differences of samples to gradients in the world, up to a common factor.
    world_from_difference: vec3<f32>,
    // From `difference * step` to the gradient times the ray's unit vector, up to the same factor.
    unit_from_step: f32,
    ambient: f32,
    diffuse: f32,
    specular: f32,
    specular_power: u32,
}

fn power(base: f32, exponent: u32) -> f32 {
    var result = 1.0;
    var square = base;
    for (var rest = exponent; rest > 0u; rest >>= 1u) {
        if (rest & 1u) == 1u {
            result *= square;
        }
        square *= square;
    }
    return result;
}

// The factor of the colour, and the highlight.
//
// difference: of the neighbours of the sample along each axis
// step: from sample to sample, in voxels
fn headlight_terms(lighting: Lighting, difference: vec3<f32>, step: vec3<f32>) -> vec2<f32> {
    let gradient = difference * lighting.world_from_difference;
    let square = dot(gradient, gradient);
    if !(square > 0.0) {
        return vec2<f32>(1.0, 0.0);
    }
    let cosine = abs(dot(difference, step) * lighting.unit_from_step) * inverseSqrt(square);
    let scattered = lighting.ambient + lighting.diffuse * cosine;
    return vec2<f32>(scattered, lighting.specular * power(cosine, lighting.specular_power));
}
