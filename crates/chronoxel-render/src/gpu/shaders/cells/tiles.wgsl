// The tiles: a workgroup takes the faces of its tile, batch after batch. Each invocation sets up a face and finds the
// pixels that it covers; then each draws, on its own pixel, the faces that cover it.
//
// A pixel holds up to K fragments sorted by depth. A new one goes to its place among them, and the nearest of all leaves;
// with the one that left before, it bounds a segment.
#import "shared/sight.wgsl"
#import "shared/missing.wgsl"

override K: u32;
override LIT: bool;
override PERSPECTIVE: bool;
// A ray ends where less than this much of what lies behind would be seen.
override LEAST_TRANSMITTANCE: f32;
// The largest index of a value, and that of a missing one.
override LAST_NODE: f32;
override NO_VALUE: u32;
// The lengths, in half the longest one, between which layers of the table are told apart.
override LEAST_PART: f32;
override MOST_PART: f32;

// The most faces of a tile: programs on the CPU end loops after a number of rounds.
override MOST_FACES: u32;

// Faces that are set up together.
const BATCH: u32 = 64u;
// Nearer than everything.
const NOWHERE: f32 = -3e38;

@group(0) @binding(0) var<uniform> sight: Sight;
// For each sum of two cosines of 8 bits, two in a row: the factor of the colour, and the highlight.
@group(0) @binding(1) var<uniform> light: array<vec4<f32>, 256>;
@group(0) @binding(2) var<storage, read> corners: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> cosines: array<f32>;
@group(0) @binding(4) var<storage, read> faces: array<u32>;
// Tile and face, and for each tile where its pairs start.
@group(0) @binding(5) var<storage, read> pairs: array<vec2<u32>>;
@group(0) @binding(6) var<storage, read> starts: array<u32>;
// [length, front, back]: colour over opacity, and the extinction times log2 e.
@group(0) @binding(7) var<storage, read> colors: array<vec4<f32>>;
// Red, green and blue multiplied by alpha, and transmittance, row by row.
@group(0) @binding(8) var<storage, read_write> gathered: array<vec4<f32>>;
// Fragments and misordered ones, each in two words; tiles of too many faces.
@group(0) @binding(9) var<storage, read_write> counts: array<atomic<u32>, 8>;

// A face as its pixels need it.
struct Setup {
    // The first corner, and from there to the second.
    start: vec2<f32>,
    to_second: vec2<f32>,
    // To the third; the range of depths, or of their inverses.
    to_third: vec2<f32>,
    depths: vec2<f32>,
    // Depth, value and cosine at the first corner, and their changes with two of the edge functions; the range of values.
    depth: vec3<f32>,
    // What all fragments' payloads have in common, were the face's normal to point away from the camera.
    payload: u32,
    value: vec3<f32>,
    least_value: f32,
    cosine: vec3<f32>,
    most_value: f32,
}

var<workgroup> batch: array<Setup, BATCH>;
// For each pixel, which faces of the batch cover it, in two words; and which of those have their normals towards the camera.
var<workgroup> covering: array<atomic<u32>, 128>;
var<workgroup> facing: array<atomic<u32>, 128>;
var<workgroup> is_left: u32;
var<workgroup> tile_counts: array<atomic<u32>, 2>;

struct Fragment {
    depth: f32,
    // From the lowest bit: 4 of the number of tetrahedra that are entered less those that are left, signed; 12 unused; 8 of
    // the cosine; 8 of the value.
    payload: u32,
}

struct Pixel {
    held: array<Fragment, 16>,
    last: Fragment,
    // Tetrahedra that the ray is in.
    inside: i32,
    color: vec3<f32>,
    transmittance: f32,
    // Length along the ray for each unit of depth.
    per_depth: f32,
    num_fragments: u32,
    num_misordered: u32,
}

fn linear(at: vec3<f32>, per_area: f32) -> vec3<f32> {
    return vec3<f32>(at.x, (at.z - at.x) * per_area, (at.x - at.y) * per_area);
}

// Sets up a face of the batch, and finds the pixels of the tile that it covers.
//
// origin: the first pixel of the tile
fn set_up(face: u32, number: u32, origin: vec2<f32>) {
    let words = vec3<u32>(faces[3u * face], faces[3u * face + 1u], faces[3u * face + 2u]);
    let points = vec3<u32>(words.x & POINT_BITS, words.yz);
    let a = corners[points.x];
    let b = corners[points.y];
    let c = corners[points.z];
    let ab = b.xy - a.xy;
    let ac = c.xy - a.xy;
    // Twice the area, with what the products were rounded by; rows run downwards.
    let other = ab.y * ac.x;
    let area = fma(ab.x, ac.y, -other) + fma(-ab.y, ac.x, other);
    let per_area = select(0.0, 1.0 / area, area != 0.0);
    let w = vec3<f32>(a.z, b.z, c.z);
    let values = vec3<f32>(a.w, b.w, c.w);
    var weights = vec3<f32>(1.0);
    if PERSPECTIVE {
        weights = w;
    }
    var setup: Setup;
    setup.start = a.xy;
    setup.to_second = ab;
    setup.to_third = ac;
    setup.depths = vec2<f32>(min(min(w.x, w.y), w.z), max(max(w.x, w.y), w.z));
    setup.depth = linear(w, per_area);
    setup.payload = words.x >> 28u;
    let most = max(max(values.x, values.y), values.z);
    if is_missing(most) {
        setup.payload |= NO_VALUE << 24u;
    } else {
        setup.value = linear(values * weights, per_area);
        setup.least_value = clamp(min(min(values.x, values.y), values.z), 0.0, LAST_NODE);
        setup.most_value = clamp(most, 0.0, LAST_NODE);
    }
    if LIT {
        let of_points = vec3<f32>(cosines[points.x], cosines[points.y], cosines[points.z]);
        setup.cosine = linear(of_points * weights, per_area);
    }
    batch[number] = setup;
    cover(array<vec2<f32>, 3>(a.xy, b.xy, c.xy), number, origin);
}

// Notes which pixels of the tile a face covers.
fn cover(places: array<vec2<f32>, 3>, number: u32, origin: vec2<f32>) {
    let ab = places[1] - places[0];
    let bc = places[2] - places[1];
    let ac = places[2] - places[0];
    let low = min(min(places[0], places[1]), places[2]);
    let high = max(max(places[0], places[1]), places[2]);
    // Centres lie half a pixel in.
    let first = max(ceil(low - 0.5), origin);
    let last = min(floor(high - 0.5), origin + f32(TILE - 1u));
    let word = number >> 5u;
    let bit = 1u << (number & 31u);
    for (var y = first.y; y <= last.y; y += 1.0) {
        for (var x = first.x; x <= last.x; x += 1.0) {
            let centre = vec2<f32>(x, y) + 0.5;
            let signs = vec3<u32>(
                bitcast<u32>(edge(places[0], ab, centre)),
                bitcast<u32>(edge(places[1], bc, centre)),
                ~bitcast<u32>(edge(places[0], ac, centre)),
            );
            // Signs alone count: that of the area may have been rounded away.
            if (((signs.x ^ signs.y) | (signs.x ^ signs.z)) >> 31u) == 0u {
                let place = vec2<u32>(vec2<f32>(x, y) - origin);
                let at = 2u * (place.y * TILE + place.x) + word;
                atomicOr(&covering[at], bit);
                if (signs.x >> 31u) == 1u {
                    atomicOr(&facing[at], bit);
                }
            }
        }
    }
}

// An edge function: the same bits for both faces at the edge, which begins at its point of the lower number. Drivers may
// fuse a product and a sum, but not one of either in two ways.
fn edge(start: vec2<f32>, side: vec2<f32>, pixel: vec2<f32>) -> f32 {
    let away = pixel - start;
    return fma(side.x, away.y, -(side.y * away.x));
}

// Draws a face on a pixel that it covers.
fn draw(pixel: ptr<function, Pixel>, number: u32, is_away: bool, centre: vec2<f32>) {
    let ab = edge(batch[number].start, batch[number].to_second, centre);
    let ac = edge(batch[number].start, batch[number].to_third, centre);
    let fragment = fragment_of(number, vec2<f32>(ab, ac), is_away);
    (*pixel).num_fragments += 1u;
    advance(pixel, insert(pixel, fragment));
}

fn between(at: vec3<f32>, edges: vec2<f32>, low: f32, high: f32) -> f32 {
    return min(max(at.x + (edges.x * at.y + edges.y * at.z), low), high);
}

fn fragment_of(number: u32, edges: vec2<f32>, is_away: bool) -> Fragment {
    let fixed = batch[number].payload;
    let range = batch[number].depths;
    var depth = between(batch[number].depth, edges, range.x, range.y);
    var over = 1.0;
    if PERSPECTIVE {
        depth = 1.0 / depth;
        over = depth;
    }
    var payload = select((16u - (fixed & 15u)) & 15u, fixed & 15u, is_away);
    if (fixed >> 24u) == NO_VALUE {
        payload |= NO_VALUE << 24u;
    } else {
        let at = batch[number].value;
        let value = (at.x + (edges.x * at.y + edges.y * at.z)) * over;
        let nearest = min(max(value, batch[number].least_value), batch[number].most_value);
        payload |= u32(nearest + 0.5) << 24u;
    }
    if LIT {
        let at = batch[number].cosine;
        let cosine = min(abs((at.x + (edges.x * at.y + edges.y * at.z)) * over), 1.0);
        payload |= u32(cosine * 255.0 + 0.5) << 16u;
    }
    return Fragment(depth, payload);
}

// What a place among the fragments holds when a new one has come: all between the new one's place and the front move up.
fn shifted(held: Fragment, behind: Fragment, fragment: Fragment) -> Fragment {
    if fragment.depth < held.depth {
        return held;
    }
    if fragment.depth < behind.depth {
        return fragment;
    }
    return behind;
}

// Puts a fragment among those of a pixel, and takes out the nearest. By constant indices, so that they lie in registers.
fn insert(pixel: ptr<function, Pixel>, fragment: Fragment) -> Fragment {
    let first = (*pixel).held[0];
    let behind_all = Fragment(-NOWHERE, 0u);
    (*pixel).held[0] = shifted(first, (*pixel).held[1], fragment);
    if K == 2u {
        (*pixel).held[1] = shifted((*pixel).held[1], behind_all, fragment);
    } else {
        (*pixel).held[1] = shifted((*pixel).held[1], (*pixel).held[2], fragment);
        (*pixel).held[2] = shifted((*pixel).held[2], (*pixel).held[3], fragment);
        (*pixel).held[3] = shifted((*pixel).held[3], (*pixel).held[4], fragment);
        (*pixel).held[4] = shifted((*pixel).held[4], (*pixel).held[5], fragment);
        if K == 6u {
            (*pixel).held[5] = shifted((*pixel).held[5], behind_all, fragment);
        } else {
            (*pixel).held[5] = shifted((*pixel).held[5], (*pixel).held[6], fragment);
            (*pixel).held[6] = shifted((*pixel).held[6], (*pixel).held[7], fragment);
            (*pixel).held[7] = shifted((*pixel).held[7], (*pixel).held[8], fragment);
            (*pixel).held[8] = shifted((*pixel).held[8], (*pixel).held[9], fragment);
            (*pixel).held[9] = shifted((*pixel).held[9], (*pixel).held[10], fragment);
            (*pixel).held[10] = shifted((*pixel).held[10], (*pixel).held[11], fragment);
            (*pixel).held[11] = shifted((*pixel).held[11], (*pixel).held[12], fragment);
            (*pixel).held[12] = shifted((*pixel).held[12], (*pixel).held[13], fragment);
            (*pixel).held[13] = shifted((*pixel).held[13], (*pixel).held[14], fragment);
            (*pixel).held[14] = shifted((*pixel).held[14], (*pixel).held[15], fragment);
            (*pixel).held[15] = shifted((*pixel).held[15], behind_all, fragment);
        }
    }
    if fragment.depth < first.depth {
        return fragment;
    }
    return first;
}

// Takes the next fragment of a ray.
fn advance(pixel: ptr<function, Pixel>, fragment: Fragment) {
    let last = (*pixel).last;
    if fragment.depth == NOWHERE {
        return;
    }
    if fragment.depth < last.depth {
        (*pixel).num_misordered += 1u;
    }
    let is_behind = last.depth < fragment.depth;
    if is_behind && (*pixel).inside > 0 {
        let length = (fragment.depth - last.depth) * (*pixel).per_depth;
        // A layer for each power of 4 below the longest, found by the exponent.
        let part = min(max(length * sight.per_half_longest, LEAST_PART), MOST_PART);
        let layer = (bitcast<u32>(part) >> 24u) - (bitcast<u32>(LEAST_PART) >> 24u);
        let entry = colors[(layer << 16u) | ((last.payload >> 24u) << 8u) | (fragment.payload >> 24u)];
        let weight = (*pixel).transmittance * opacity(length * entry.w);
        var color = entry.xyz;
        if LIT {
            let sum = ((last.payload >> 16u) & 255u) + ((fragment.payload >> 16u) & 255u);
            let two = light[sum >> 1u];
            let terms = select(two.xy, two.zw, (sum & 1u) == 1u);
            color = color * terms.x + terms.y;
        }
        (*pixel).color += color * weight;
        (*pixel).transmittance -= weight;
    }
    (*pixel).inside += bitcast<i32>(fragment.payload << 28u) >> 28u;
    if is_behind {
        (*pixel).last = fragment;
    }
}

// `1 - 2^-x`, relatively exact to 2e-6, for `x >= 0`. Twin: `opacity` of `cells/tile.rs`.
fn opacity(depth: f32) -> f32 {
    let x = min(depth, 126.0);
    let whole = u32(x);
    let f = x - f32(whole);
    let square = f * f;
    let low = (0.6931472 + f * -0.2402265) + square * (0.05550411 + f * -0.009618129);
    let high = (0.0013333558 + f * -0.0001540353) + square * 0.0000152527;
    let of_fraction = f * (low + (square * square) * high);
    let power = bitcast<f32>((127u - whole) << 23u);
    return (1.0 - power) + power * of_fraction;
}

// Takes what a pixel still holds, once all faces are drawn.
fn flush(pixel: ptr<function, Pixel>) {
    for (var i = 0u; i < K; i++) {
        if (*pixel).transmittance >= LEAST_TRANSMITTANCE {
            let nowhere = Fragment(NOWHERE, 0u);
            let first = (*pixel).held[0];
            (*pixel).held[0] = (*pixel).held[1];
            if K == 2u {
                (*pixel).held[1] = nowhere;
            } else {
                (*pixel).held[1] = (*pixel).held[2];
                (*pixel).held[2] = (*pixel).held[3];
                (*pixel).held[3] = (*pixel).held[4];
                (*pixel).held[4] = (*pixel).held[5];
                if K == 6u {
                    (*pixel).held[5] = nowhere;
                } else {
                    (*pixel).held[5] = (*pixel).held[6];
                    (*pixel).held[6] = (*pixel).held[7];
                    (*pixel).held[7] = (*pixel).held[8];
                    (*pixel).held[8] = (*pixel).held[9];
                    (*pixel).held[9] = (*pixel).held[10];
                    (*pixel).held[10] = (*pixel).held[11];
                    (*pixel).held[11] = (*pixel).held[12];
                    (*pixel).held[12] = (*pixel).held[13];
                    (*pixel).held[13] = (*pixel).held[14];
                    (*pixel).held[14] = (*pixel).held[15];
                    (*pixel).held[15] = nowhere;
                }
            }
            advance(pixel, first);
        }
    }
}

fn new_pixel(centre: vec2<f32>) -> Pixel {
    var pixel: Pixel;
    let none = Fragment(NOWHERE, 0u);
    pixel.held = array<Fragment, 16>(
        none, none, none, none, none, none, none, none, none, none, none, none, none, none, none, none,
    );
    pixel.last = none;
    pixel.transmittance = 1.0;
    pixel.per_depth = 1.0;
    if PERSPECTIVE {
        let aside = (centre - sight.middle) / sight.scale;
        pixel.per_depth = sqrt(1.0 + dot(aside, aside));
    }
    return pixel;
}

@compute @workgroup_size(8, 8)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_id) place: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let tile = group.y * sight.tiles_across + group.x;
    let row = sight.first_tile_row * TILE + group.y * TILE + place.y;
    let column = group.x * TILE + place.x;
    let centre = vec2<f32>(f32(column), f32(row)) + 0.5;
    var pixel = new_pixel(centre);
    if column >= sight.num_columns || row >= sight.num_rows {
        pixel.transmittance = 0.0;
    }
    var end = starts[tile + 1u];
    var first = starts[tile];
    let is_too_long = end - first > MOST_FACES;
    if is_too_long {
        end = first;
    }
    while first < end {
        if local == 0u {
            is_left = 0u;
        }
        for (var word = 0u; word < 2u; word++) {
            atomicStore(&covering[2u * local + word], 0u);
            atomicStore(&facing[2u * local + word], 0u);
        }
        workgroupBarrier();
        if first + local < end {
            let origin = vec2<f32>(f32(group.x * TILE), f32(row - place.y));
            set_up(pairs[first + local].y, local, origin);
        }
        workgroupBarrier();
        for (var word = 0u; word < 2u; word++) {
            var bits = atomicLoad(&covering[2u * local + word]);
            let towards = atomicLoad(&facing[2u * local + word]);
            while bits != 0u && pixel.transmittance >= LEAST_TRANSMITTANCE {
                let number = firstTrailingBit(bits);
                draw(&pixel, 32u * word + number, ((towards >> number) & 1u) == 0u, centre);
                bits &= bits - 1u;
            }
        }
        if pixel.transmittance >= LEAST_TRANSMITTANCE {
            is_left = 1u;
        }
        let is_any_left = workgroupUniformLoad(&is_left);
        first += BATCH;
        if is_any_left == 0u {
            first = end;
        }
    }
    flush(&pixel);
    if column < sight.num_columns && row < sight.num_rows {
        let at = (row - sight.first_row) * sight.num_columns + column;
        gathered[at] = vec4<f32>(pixel.color, pixel.transmittance);
        atomicAdd(&tile_counts[0], pixel.num_fragments);
        atomicAdd(&tile_counts[1], pixel.num_misordered);
    }
    workgroupBarrier();
    if local == 0u {
        add_count(0u, atomicLoad(&tile_counts[0]));
        add_count(2u, atomicLoad(&tile_counts[1]));
        atomicAdd(&counts[4], u32(is_too_long));
    }
}

// Adds to a count of two words.
fn add_count(word: u32, num: u32) {
    let before = atomicAdd(&counts[word], num);
    if before + num < before {
        atomicAdd(&counts[word + 1u], 1u);
    }
}
