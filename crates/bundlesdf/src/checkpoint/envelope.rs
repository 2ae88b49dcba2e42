//! Bytes that tell whether they are whole and whose they are: magic, fingerprint of the run, checksum, payload.

use serde::{Serialize, de::DeserializeOwned};

use super::CheckpointError;
use crate::config::{Config, Schedule};

const MAGIC: &[u8; 8] = b"bsdf-cp1";
const HEADER: usize = MAGIC.len() + 4 + 4;

/// Tells runs apart that can't go on from each other's checkpoints.
pub(crate) fn fingerprint(config: &Config, schedule: Schedule) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    hasher.update(env!("CARGO_PKG_VERSION").as_bytes());
    // A config is made of numbers and names: it always has a text.
    hasher.update(&serde_json::to_vec(&(config, schedule)).unwrap_or_default());
    hasher.finalize()
}

/// Wraps a value.
pub(crate) fn seal<T: Serialize>(value: &T, fingerprint: u32) -> Option<Vec<u8>> {
    let payload = postcard::to_stdvec(value).ok()?;
    let mut bytes = Vec::with_capacity(HEADER + payload.len());
    bytes.extend_from_slice(MAGIC);
    bytes.extend_from_slice(&fingerprint.to_le_bytes());
    bytes.extend_from_slice(&crc32fast::hash(&payload).to_le_bytes());
    bytes.extend_from_slice(&payload);
    Some(bytes)
}

/// Unwraps what [`seal`] wrapped.
pub(crate) fn open<T: DeserializeOwned>(bytes: &[u8], fingerprint: u32) -> Result<T, CheckpointError> {
    let rest = bytes.strip_prefix(MAGIC).ok_or(CheckpointError::Damaged)?;
    let (owner, rest) = rest.split_first_chunk::<4>().ok_or(CheckpointError::Damaged)?;
    let (checksum, payload) = rest.split_first_chunk::<4>().ok_or(CheckpointError::Damaged)?;
    if crc32fast::hash(payload) != u32::from_le_bytes(*checksum) {
        return Err(CheckpointError::Damaged);
    }
    if u32::from_le_bytes(*owner) != fingerprint {
        return Err(CheckpointError::OtherRun);
    }
    postcard::from_bytes(payload).map_err(|_| CheckpointError::Damaged)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_whole_bytes_of_the_same_run_are_opened() {
        let sealed = seal(&vec![1.5f64, -0.0, f64::MAX], 7).unwrap();
        assert_eq!(open::<Vec<f64>>(&sealed, 7).unwrap(), vec![1.5, -0.0, f64::MAX]);
        assert!(matches!(open::<Vec<f64>>(&sealed, 8), Err(CheckpointError::OtherRun)));
        for cut in 0..sealed.len() {
            assert!(matches!(open::<Vec<f64>>(&sealed[..cut], 7), Err(CheckpointError::Damaged)), "{cut}");
        }
        // One flipped bit anywhere but in the owner's name is damage.
        for (i, bit) in (0..sealed.len()).flat_map(|i| (0..8).map(move |bit| (i, bit))) {
            let mut damaged = sealed.clone();
            damaged[i] ^= 1 << bit;
            assert!(open::<Vec<f64>>(&damaged, 7).is_err(), "byte {i} bit {bit}");
        }
    }

    #[test]
    fn a_changed_setting_is_another_run() {
        let config = Config::default();
        let changed = Config { seed: 1, ..Config::default() };
        let own = fingerprint(&config, Schedule::Lockstep);
        assert_eq!(own, fingerprint(&config.clone(), Schedule::Lockstep));
        assert_ne!(own, fingerprint(&changed, Schedule::Lockstep));
        assert_ne!(own, fingerprint(&config, Schedule::Realtime));
    }
}
