// Sums of floats that many invocations add to, where the adapter has atomics on them. Expects a module variable
// `sums: array<atomic<Word>>`.

alias Word = f32;

fn add_to_sum(at: u32, value: f32) {
    atomicAdd(&sums[at], value);
}
