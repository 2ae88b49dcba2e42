//! Inputs near given ones, for fuzzing without libFuzzer.

use rand::RngExt;
use rand_pcg::Pcg64Mcg;

/// Values at which parsers turn: limits of bytes, of lengths and of signs.
const ODD: [u8; 8] = [0, 1, 0x7f, 0x80, 0xff, b'-', b'9', b'\n'];

/// Makes one to four changes of the kinds that libFuzzer makes; `other` is another input, to take pieces from.
pub fn mutate(rng: &mut Pcg64Mcg, bytes: &mut Vec<u8>, other: &[u8]) {
    for _ in 0..rng.random_range(1..=4) {
        let at = rng.random_range(0..=bytes.len());
        let length = rng.random_range(0..=(bytes.len() - at).min(16));
        match rng.random_range(0..6) {
            0 => drop(bytes.drain(at..at + length)),
            1 => bytes.truncate(at),
            2 => bytes.insert(at, ODD.get(rng.random_range(0..ODD.len())).copied().unwrap_or(0)),
            3 => {
                let copy: Vec<u8> = bytes.iter().skip(at).take(length).copied().collect();
                bytes.splice(at..at, copy);
            }
            4 => {
                let from = rng.random_range(0..=other.len());
                let to = (from + 16).min(other.len());
                bytes.splice(at..at + length, other.iter().take(to).skip(from).copied());
            }
            _ => bytes.iter_mut().skip(at).take(length).for_each(|b| *b = rng.random()),
        }
    }
}
