// Calls the shared functions for a list of arguments, to be held against their twins in Rust.
#import "shared/classification.wgsl"
#import "shared/compositing.wgsl"
#import "shared/decode.wgsl"
#import "shared/lighting.wgsl"
#import "shared/locate.wgsl"
#import "shared/opacity.wgsl"

// Which function it is, in the order of `Function` in `twins.rs`.
override FUNCTION: u32;

struct Arguments {
    a: vec4<f32>,
    b: vec4<f32>,
}

@group(0) @binding(0) var<storage, read> nodes: array<u32>;
@group(0) @binding(1) var<storage, read> bank: array<u32>;
@group(0) @binding(2) var<storage, read> inputs: array<Arguments>;
@group(0) @binding(3) var<uniform> lighting: Lighting;
@group(0) @binding(4) var<storage, read_write> outputs: array<vec4<f32>>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x < arrayLength(&inputs) {
        outputs[id.x] = call(inputs[id.x]);
    }
}

fn call(arguments: Arguments) -> vec4<f32> {
    let a = arguments.a;
    switch FUNCTION {
        case 0u: {
            return vec4<f32>(exp_m1(a.x));
        }
        case 1u: {
            return vec4<f32>(accumulate_constant(a.x, a.y, a.z), 0.0, 0.0);
        }
        case 2u: {
            return vec4<f32>(power(a.x, u32(a.y)));
        }
        case 3u: {
            return vec4<f32>(headlight_terms(lighting, a.xyz, arguments.b.xyz), 0.0, 0.0);
        }
        case 4u: {
            return vec4<f32>(f32(color_index(a.x, a.yz, 4096u)));
        }
        case 5u: {
            let next = decode_units(u32(a.x), u32(a.y), u32(a.z));
            return vec4<f32>(decode_unit(u32(a.x), u32(a.y), u32(a.z)), next, 0.0);
        }
        case 6u: {
            return vec4<f32>(log_transmittance_of(a.x));
        }
        default: {
            let found = locate(vec3<i32>(a.xyz), u32(a.w));
            return vec4<f32>(f32(found.kind), f32(found.number), f32(found.low.x + 100 * found.low.y), f32(found.edge));
        }
    }
}
