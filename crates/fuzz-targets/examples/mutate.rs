//! Fuzzing without libFuzzer: `mutate TARGET SECONDS [SEED]` gives mutations of the target's seeds to it, and counts.
//!
//! Nothing guides it, so it finds less than libFuzzer in the same time. The input under way lies in the file `mutate-TARGET.bin` of the temporary folder, so that a
//! fault leaves it there.
#![allow(clippy::print_stdout)]

use rand::{RngExt, SeedableRng};
use std::path::Path;
use std::time::{Duration, Instant};

/// Inputs grow no longer.
const LONGEST: usize = 8192;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [name, seconds, rest @ ..] = arguments.as_slice() else {
        println!("mutate TARGET SECONDS [SEED]");
        return Ok(());
    };
    let seed = rest.first().map_or(Ok(1), |text| text.parse())?;
    let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/seeds").join(name);
    let mut pool = Vec::new();
    for entry in std::fs::read_dir(dir)? {
        pool.push(std::fs::read(entry?.path())?);
    }
    pool.sort();
    let kept = std::env::temp_dir().join(format!("mutate-{name}.bin"));
    let (start, limit) = (Instant::now(), Duration::from_secs(seconds.parse()?));
    let (mut rng, mut runs, mut slowest) = (rand_pcg::Pcg64Mcg::seed_from_u64(seed), 0_u64, Duration::ZERO);
    while start.elapsed() < limit {
        let [one, other] = [0; 2].map(|_| rng.random_range(0..pool.len()));
        let mut bytes = pool.get(one).cloned().unwrap_or_default();
        for _ in 0..rng.random_range(1..=2) {
            fuzz_targets::mutate(&mut rng, &mut bytes, pool.get(other).map_or(&[], Vec::as_slice));
        }
        bytes.truncate(LONGEST);
        std::fs::write(&kept, &bytes)?;
        let begin = Instant::now();
        fuzz_targets::run(name, &bytes);
        slowest = slowest.max(begin.elapsed());
        runs += 1;
    }
    std::fs::remove_file(&kept)?;
    println!(
        "{name}: {runs} inputs in {} s, slowest {:.0} ms",
        start.elapsed().as_secs(),
        slowest.as_secs_f64() * 1e3
    );
    Ok(())
}
