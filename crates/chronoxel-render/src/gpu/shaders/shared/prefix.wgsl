// Sums of what the 256 invocations of a workgroup hold.

var<workgroup> partial_sums: array<u32, 256>;

// The sum of those before, and of all. To be called in uniform control flow.
fn prefix_sum(local: u32, value: u32) -> vec2<u32> {
    partial_sums[local] = value;
    workgroupBarrier();
    for (var reach = 1u; reach < 256u; reach <<= 1u) {
        var sum = partial_sums[local];
        if local >= reach {
            sum += partial_sums[local - reach];
        }
        workgroupBarrier();
        partial_sums[local] = sum;
        workgroupBarrier();
    }
    let all = partial_sums[255];
    let before = partial_sums[local] - value;
    workgroupBarrier();
    return vec2<u32>(before, all);
}
