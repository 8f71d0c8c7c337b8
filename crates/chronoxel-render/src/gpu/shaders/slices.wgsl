// Slices: polygons on planes across the direction of view, blended over each other from back to front.
#import "shared/classification.wgsl"
#import "shared/lighting.wgsl"
#import "shared/compositing.wgsl"
#import "shared/opacity.wgsl"
#import "shared/decode.wgsl"
#import "shared/sampling.wgsl"

override LIT: bool;

struct Planes {
    // From voxels of level 0 to the rows and columns that are drawn: -1 to 1, multiplied by depth in perspective.
    column: vec3<f32>,
    column_offset: f32,
    row: vec3<f32>,
    row_offset: f32,
    // What depth adds to them.
    column_per_depth: f32,
    row_per_depth: f32,
    // Depth where rays start, in step lengths.
    start: f32,
    is_perspective: u32,
}

@group(0) @binding(1) var<uniform> planes: Planes;
@group(0) @binding(6) var<storage, read> bank: array<u32>;

// What polygons are cut from.
struct Box {
    // Its planes, voxels of level 0; none where slices lie along them.
    low: vec3<f32>,
    // The number of a brick or of a constant.
    content: u32,
    high: vec3<f32>,
    padding: u32,
}

@group(0) @binding(7) var<storage, read> boxes: array<Box>;

// In what a box holds: whether it is the number of a constant, not of a brick.
const CONSTANT: u32 = 0x80000000u;

struct Vertex {
    @builtin(position) position: vec4<f32>,
    // Of the polygon's plane: how far behind where rays start, in step lengths.
    @location(0) @interpolate(flat) depth: f32,
    @location(1) @interpolate(flat) number: u32,
}

@vertex
fn place_vertex(@location(0) corner: vec4<f32>, @location(1) number: u32) -> Vertex {
    let depth = select(1.0, corner.w + planes.start, planes.is_perspective == 1u);
    let column = dot(planes.column, corner.xyz) + planes.column_offset + planes.column_per_depth * depth;
    let row = dot(planes.row, corner.xyz) + planes.row_offset + planes.row_per_depth * depth;
    return Vertex(vec4<f32>(column, row, 0.5 * depth, depth), corner.w, number);
}

// What a plane shows at a pixel, premultiplied. Where it is follows from the pixel's ray, not from the vertices, which
// are rounded to a part of a pixel: polygons reach a little too far, and whose a pixel is follows from where it is. That
// is the same to the bit for all boxes, of whatever level; so each pixel of a plane is drawn once.
@fragment
fn shade(vertex: Vertex) -> @location(0) vec4<f32> {
    let pixel = vertex.position.xy + vec2<f32>(0.0, f32(view.first_row));
    // Its part along the direction of view is 1, so that its length is that of the way from plane to plane.
    let direction = view.direction + pixel.x * view.direction_per_column + pixel.y * view.direction_per_row;
    let length = length(direction);
    let start = view.start + pixel.x * view.start_per_column + pixel.y * view.start_per_row;
    let here = start + vertex.depth * direction * view.step_per_direction;
    let place_of = boxes[vertex.number];
    if any(here < place_of.low) || any(here >= place_of.high) {
        discard;
    }
    if (place_of.content & CONSTANT) != 0u {
        let constant = constants[place_of.content ^ CONSTANT];
        let weight = accumulate_constant(constant.color.w, constant.log_transmittance, length).x;
        return weight * constant.color;
    }
    let brick = bricks[place_of.content];
    let place = clamp(here * brick.scale - brick.origin, vec3<f32>(0.0), vec3<f32>(view.most_place));
    if is_masked(brick, place) {
        discard;
    }
    let color = color_at(brick, place);
    if color.w <= 0.0 {
        discard;
    }
    var terms = vec2<f32>(1.0, 0.0);
    if LIT {
        let step = direction / length * view.step_per_direction;
        terms = headlight_terms(view.lighting, difference_at(brick, place), step);
    }
    let weight = accumulate_constant(color.w, log_transmittance_of(color.w), length).x;
    return weight * vec4<f32>(color.xyz * terms.x + color.w * terms.y, color.w);
}
