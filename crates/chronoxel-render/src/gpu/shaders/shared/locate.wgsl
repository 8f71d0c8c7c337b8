// Point location in the page table. Reads `nodes`, eight words a node, which the importing shader declares.
// Twin: `PageTable::locate`.

const KIND_EMPTY: u32 = 0u;
const KIND_CONSTANT: u32 = 1u;
const KIND_BRICK: u32 = 2u;
const KIND_NODE: u32 = 3u;

struct Location {
    kind: u32,
    // Which constant or brick it is.
    number: u32,
    // The box, in cells: bricks of level 0.
    low: vec3<i32>,
    edge: i32,
}

// root_level: of the node at the front, whose box has 2^root_level cells along an edge and holds the cell
fn locate(cell: vec3<i32>, root_level: u32) -> Location {
    var node = 0u;
    var level = root_level - 1u;
    var entry = entry_of(node, cell, level);
    while entry >> 30u == KIND_NODE && level > 0u {
        node = entry & 0x3fffffffu;
        level -= 1u;
        entry = entry_of(node, cell, level);
    }
    let low = (cell >> vec3<u32>(level)) << vec3<u32>(level);
    return Location(entry >> 30u, entry & 0x3fffffffu, low, 1i << level);
}

// What a node holds in the octant of a cell.
fn entry_of(node: u32, cell: vec3<i32>, level: u32) -> u32 {
    let bits = (vec3<u32>(cell) >> vec3<u32>(level)) & vec3<u32>(1u);
    return nodes[8u * node + bits.x + 2u * bits.y + 4u * bits.z];
}
