//! Every target on its seeds, and on mutations of them: what CI sees of the fuzzing.
#![allow(clippy::unwrap_used)]

use fuzz_targets::{TARGETS, Target, mutate};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use std::path::PathBuf;

fn seeds(target: &Target) -> Vec<Vec<u8>> {
    let dir = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/seeds").join(target.name);
    let mut paths: Vec<PathBuf> = std::fs::read_dir(dir).unwrap().map(|e| e.unwrap().path()).collect();
    paths.sort();
    paths.iter().map(|path| std::fs::read(path).unwrap()).collect()
}

fn smoke(name: &str, mutations: usize) {
    let target = TARGETS.iter().find(|target| target.name == name).unwrap();
    let seeds = seeds(target);
    assert!(seeds.len() >= 2, "{name} has no seeds");
    (target.run)(&[]);
    seeds.iter().for_each(|seed| (target.run)(seed));
    let mut rng = Pcg64Mcg::seed_from_u64(20);
    for _ in 0..mutations {
        let [one, other] = [0; 2].map(|_| rng.random_range(0..seeds.len()));
        let mut bytes = seeds[one].clone();
        mutate(&mut rng, &mut bytes, &seeds[other]);
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
