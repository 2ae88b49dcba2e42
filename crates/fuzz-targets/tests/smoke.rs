//! Every target on its seeds, and on mutations of them: what CI sees of the fuzzing.
#![allow(clippy::unwrap_used)]

use fuzz_targets::{TARGETS, Target};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use std::path::PathBuf;

/// Values at which parsers turn: limits of bytes, of lengths and of signs.
const ODD: [u8; 8] = [0, 1, 0x7f, 0x80, 0xff, b'-', b'9', b'\n'];

fn seeds(target: &Target) -> Vec<Vec<u8>> {
    let dir = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/seeds").join(target.name);
    let mut paths: Vec<PathBuf> = std::fs::read_dir(dir).unwrap().map(|e| e.unwrap().path()).collect();
    paths.sort();
    paths.iter().map(|path| std::fs::read(path).unwrap()).collect()
}

/// One to four changes of the kinds that libFuzzer makes.
fn mutate(rng: &mut Pcg64Mcg, bytes: &mut Vec<u8>, other: &[u8]) {
    for _ in 0..rng.random_range(1..=4) {
        let at = rng.random_range(0..=bytes.len());
        let length = rng.random_range(0..=(bytes.len() - at).min(16));
        match rng.random_range(0..6) {
            0 => drop(bytes.drain(at..at + length)),
            1 => bytes.truncate(at),
            2 => bytes.insert(at, ODD[rng.random_range(0..ODD.len())]),
            3 => {
                let copy = bytes[at..at + length].to_vec();
                bytes.splice(at..at, copy);
            }
            4 => {
                let from = rng.random_range(0..=other.len());
                let to = (from + 16).min(other.len());
                bytes.splice(at..at + length, other[from..to].iter().copied());
            }
            _ => bytes[at..at + length].iter_mut().for_each(|b| *b = rng.random()),
        }
    }
}

fn smoke(name: &str, mutations: usize) {
    let target = TARGETS.iter().find(|target| target.name == name).unwrap();
    let seeds = seeds(target);
    assert!(seeds.len() >= 2, "{name} has no seeds");
    (target.run)(&[]);
    seeds.iter().for_each(|seed| (target.run)(seed));
    let mut rng = Pcg64Mcg::seed_from_u64(20);
    for _ in 0..mutations {
        let mut bytes = seeds[rng.random_range(0..seeds.len())].clone();
        mutate(&mut rng, &mut bytes, &seeds[rng.random_range(0..seeds.len())]);
        (target.run)(&bytes);
    }
}

macro_rules! smoke_tests {
    ($($name:ident: $mutations:expr),*) => {
        $(#[test]
        fn $name() {
            smoke(stringify!($name), $mutations);
        })*

        #[test]
        fn no_target_is_left_out() {
            assert_eq!([$(stringify!($name)),*], TARGETS.map(|target| target.name));
        }
    };
}

smoke_tests! {
    images: 2000, pickle: 5000, json: 5000, text: 5000, mesh: 5000, weights: 3000, networks: 300, g2o: 3000,
    datasets: 1000, tracker: 60
}
