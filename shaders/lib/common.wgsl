// Shared by all kernels: 64 invocations a workgroup, dispatches folded into two dimensions where one is too short.

const WORKGROUP: u32 = 64u;

fn linear_id(id: vec3<u32>, groups: vec3<u32>) -> u32 {
    return id.x + id.y * groups.x * WORKGROUP;
}
