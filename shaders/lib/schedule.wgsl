// What changes from step to step, written for a whole round at once; `finish` moves the cursor.

struct Step {
    number: u32,
    // Bias-corrected sizes of an Adam step of grid and networks: m * rate / sqrt(v * root).
    rate: f32,
    root: f32,
    // The same of the poses; a rate of zero leaves them and their moments alone.
    pose_rate: f32,
    pose_root: f32,
    unused_a: u32,
    unused_b: u32,
    unused_c: u32,
}

struct Schedule {
    cursor: u32,
    unused: array<u32, 7>,
    steps: array<Step>,
}
