// A pass of a radix sort: pairs are put into the order of 8 bits of their keys, and stay in order where those are equal.

struct Digit {
    num: u32,
    // Bits below those of this pass.
    shift: u32,
    // Pairs of a part, a multiple of 256, and number of parts, each of a workgroup.
    part: u32,
    num_parts: u32,
}

@group(0) @binding(0) var<uniform> digit: Digit;
@group(0) @binding(1) var<storage, read> pairs: array<vec2<u32>>;
// [digit, part]: how many there are, and after a scan where the first goes.
@group(0) @binding(2) var<storage, read_write> counts: array<u32>;
@group(0) @binding(3) var<storage, read_write> sorted: array<vec2<u32>>;

var<workgroup> nums: array<atomic<u32>, 256>;
// For each digit, which of 256 invocations have it.
var<workgroup> having: array<atomic<u32>, 2048>;
var<workgroup> nexts: array<u32, 256>;

fn digit_of(key: u32) -> u32 {
    return (key >> digit.shift) & 255u;
}

@compute @workgroup_size(256)
fn count(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    atomicStore(&nums[local], 0u);
    workgroupBarrier();
    let end = min((group.x + 1u) * digit.part, digit.num);
    for (var at = group.x * digit.part + local; at < end; at += 256u) {
        atomicAdd(&nums[digit_of(pairs[at].x)], 1u);
    }
    workgroupBarrier();
    counts[local * digit.num_parts + group.x] = atomicLoad(&nums[local]);
}

@compute @workgroup_size(256)
fn move_pairs(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    nexts[local] = counts[local * digit.num_parts + group.x];
    let word = local >> 5u;
    let bit = 1u << (local & 31u);
    for (var round = 0u; round < digit.part; round += 256u) {
        for (var i = 0u; i < 8u; i++) {
            atomicStore(&having[8u * local + i], 0u);
        }
        workgroupBarrier();
        let at = group.x * digit.part + round + local;
        var pair = vec2<u32>(0u);
        var mine = 0u;
        if at < digit.num {
            pair = pairs[at];
            mine = digit_of(pair.x);
            atomicOr(&having[8u * mine + word], bit);
        }
        workgroupBarrier();
        if at < digit.num {
            var place = nexts[mine] + countOneBits(atomicLoad(&having[8u * mine + word]) & (bit - 1u));
            for (var i = 0u; i < word; i++) {
                place += countOneBits(atomicLoad(&having[8u * mine + i]));
            }
            sorted[place] = pair;
        }
        workgroupBarrier();
        var num = 0u;
        for (var i = 0u; i < 8u; i++) {
            num += countOneBits(atomicLoad(&having[8u * local + i]));
        }
        nexts[local] += num;
    }
}

// Writes the second numbers of the pairs where the counts are for other passes.
@compute @workgroup_size(256)
fn take_numbers(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) num_groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let at = (group.y * num_groups.x + group.x) * 256u + local;
    if at < digit.num {
        counts[at] = pairs[at].y;
    }
}
