// Replaces numbers by the sums of those before each, in three passes: sums of 256 parts, their sums, and those within.
#import "shared/prefix.wgsl"

struct Scan {
    num: u32,
    // Numbers of a part, a multiple of 256.
    part: u32,
    padding_a: u32,
    padding_b: u32,
}

@group(0) @binding(0) var<uniform> scan: Scan;
@group(0) @binding(1) var<storage, read_write> numbers: array<u32>;
// Of the parts, and behind them that of all.
@group(0) @binding(2) var<storage, read_write> sums: array<u32>;

@compute @workgroup_size(256)
fn sum_parts(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let end = min((group.x + 1u) * scan.part, scan.num);
    var sum = 0u;
    for (var at = group.x * scan.part + local; at < end; at += 256u) {
        sum += numbers[at];
    }
    let all = prefix_sum(local, sum).y;
    if local == 0u {
        sums[group.x] = all;
    }
}

@compute @workgroup_size(256)
fn sum_sums(@builtin(local_invocation_index) local: u32) {
    let found = prefix_sum(local, sums[local]);
    sums[local] = found.x;
    if local == 0u {
        sums[256] = found.y;
    }
}

@compute @workgroup_size(256)
fn sum_within(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    var before = sums[group.x];
    for (var round = 0u; round < scan.part; round += 256u) {
        let at = group.x * scan.part + round + local;
        var number = 0u;
        if at < scan.num {
            number = numbers[at];
        }
        let found = prefix_sum(local, number);
        if at < scan.num {
            numbers[at] = before + found.x;
        }
        before += found.y;
    }
}
