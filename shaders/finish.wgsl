// One workgroup: adds up the rays' losses into the round's record and moves on to the next step.

struct Params {
    rays: u32,
    unused_a: u32,
    unused_b: u32,
    unused_c: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read_write> schedule: Schedule;
@group(0) @binding(2) var<storage, read> ray_losses: array<f32>;
@group(0) @binding(3) var<storage, read_write> losses: array<f32>;

const LOSSES: u32 = 5u;

var<workgroup> sums: array<f32, 320>;

@compute @workgroup_size(64)
fn main(@builtin(local_invocation_index) me: u32) {
    for (var loss = 0u; loss < LOSSES; loss++) {
        var sum = 0.0;
        for (var ray = me; ray < params.rays; ray += WORKGROUP) {
            sum += ray_losses[loss * params.rays + ray];
        }
        sums[loss * WORKGROUP + me] = sum;
    }
    workgroupBarrier();
    if (me < LOSSES) {
        var sum = 0.0;
        for (var i = 0u; i < WORKGROUP; i++) {
            sum += sums[me * WORKGROUP + i];
        }
        losses[LOSSES * schedule.cursor + me] = sum;
    }
    storageBarrier();
    workgroupBarrier();
    if (me == 0u) {
        schedule.cursor += 1u;
    }
}
