// Lists of the faces that each tile may see, from faces sorted by depth: how many tiles each has, a pair of tile and face
// for each of them, and, once those are sorted by tile, where the list of each tile starts.
#import "shared/sight.wgsl"

@group(0) @binding(0) var<uniform> sight: Sight;
@group(0) @binding(1) var<storage, read> corners: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> faces: array<u32>;
// Numbers of the faces by depth.
@group(0) @binding(3) var<storage, read> order: array<u32>;
// Tiles of each face of the order; after a scan, of all before it.
@group(0) @binding(4) var<storage, read_write> places: array<u32>;
// Tile and face.
@group(0) @binding(5) var<storage, read_write> pairs: array<vec2<u32>>;
@group(0) @binding(6) var<storage, read_write> starts: array<u32>;
// Faces that have tiles; pairs.
@group(0) @binding(7) var<storage, read_write> totals: array<atomic<u32>, 4>;

// First and last column and row of the tiles that have a pixel's centre in the face's box; none where the first is behind
// the last.
fn tiles_of(face: u32) -> vec4<u32> {
    let a = corners[faces[3u * face] & POINT_BITS].xy;
    let b = corners[faces[3u * face + 1u]].xy;
    let c = corners[faces[3u * face + 2u]].xy;
    // Centres lie half a pixel in.
    let first = max(ceil(min(min(a, b), c) - 0.5), vec2<f32>(0.0));
    let size = vec2<f32>(f32(sight.num_columns), f32(sight.num_rows));
    let last = min(floor(max(max(a, b), c) - 0.5), size - 1.0);
    if any(first > last) {
        return vec4<u32>(1u, 1u, 0u, 0u);
    }
    let low = vec2<u32>(first) / TILE;
    let high = vec2<u32>(last) / TILE;
    let last_row = sight.first_tile_row + sight.num_tile_rows - 1u;
    return vec4<u32>(low.x, max(low.y, sight.first_tile_row), high.x, min(high.y, last_row));
}

fn num_tiles(tiles: vec4<u32>) -> u32 {
    if any(tiles.xy > tiles.zw) {
        return 0u;
    }
    return (tiles.z - tiles.x + 1u) * (tiles.w - tiles.y + 1u);
}

@compute @workgroup_size(256)
fn count(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) num_groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let number = flat_number(group, num_groups, local);
    if number >= sight.num_faces {
        return;
    }
    let num = num_tiles(tiles_of(order[number]));
    places[number] = num;
    if num > 0u {
        atomicAdd(&totals[0], 1u);
    }
}

@compute @workgroup_size(256)
fn list(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) num_groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let number = flat_number(group, num_groups, local);
    if number >= sight.num_faces {
        return;
    }
    let face = order[number];
    let tiles = tiles_of(face);
    let num = num_tiles(tiles);
    let first = (tiles.y - sight.first_tile_row) * sight.tiles_across + tiles.x;
    let across = tiles.z - tiles.x + 1u;
    for (var i = 0u; i < num; i++) {
        let tile = first + (i / across) * sight.tiles_across + i % across;
        pairs[places[number] + i] = vec2<u32>(tile, face);
    }
}

// One invocation for each pair, and one more.
@compute @workgroup_size(256)
fn start(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) num_groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let number = flat_number(group, num_groups, local);
    let num_pairs = atomicLoad(&totals[1]);
    if number > num_pairs {
        return;
    }
    var first = 0u;
    if number > 0u {
        first = pairs[number - 1u].x + 1u;
    }
    var last = sight.tiles_across * sight.num_tile_rows;
    if number < num_pairs {
        last = pairs[number].x;
    }
    for (var tile = first; tile <= last; tile++) {
        starts[tile] = number;
    }
}
