// Sums of floats that many invocations add to, where the adapter has atomics on integers only. Expects a module
// variable `sums: array<atomic<Word>>`.

alias Word = u32;

fn add_to_sum(at: u32, value: f32) {
    var seen = atomicLoad(&sums[at]);
    loop {
        let wanted = bitcast<u32>(bitcast<f32>(seen) + value);
        let outcome = atomicCompareExchangeWeak(&sums[at], seen, wanted);
        if (outcome.exchanged) {
            break;
        }
        seen = outcome.old_value;
    }
}
