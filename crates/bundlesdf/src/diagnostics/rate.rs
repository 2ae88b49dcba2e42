//! Are there frames missing between others? Their names tell: running numbers, or times.

use serde::{Deserialize, Serialize};

use super::{Notice, WarningKind};

/// Steps of which the median is the usual one.
const STEPS: usize = 31;
/// Fewest steps to know the usual one.
const ENOUGH: usize = 5;
/// A step of this many usual ones is a drop.
const DROP: f64 = 1.8;

/// The numbers in the frames' names.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(super) struct Rate {
    last: Option<f64>,
    /// The newest steps, in a ring.
    steps: Vec<f64>,
    count: usize,
}

impl Rate {
    pub(super) fn check(&mut self, id: &str) -> Option<Notice> {
        let number = number_in(id)?;
        let step = number - self.last.replace(number)?;
        // Names that don't rise are no times.
        if !(step > 0.0 && step.is_finite()) {
            self.steps.clear();
            return None;
        }
        let usual = self.usual();
        if self.steps.len() < STEPS {
            self.steps.push(step);
        } else {
            self.steps[self.count % STEPS] = step;
        }
        self.count += 1;
        let missing = usual.map(|usual| step / usual).filter(|ratio| *ratio > DROP)?;
        Some(Notice {
            kind: WarningKind::FrameDrops,
            patience: 1,
            message: format!("about {:.0} frames are missing before it", missing.round() - 1.0),
            remedy: "record with fewer pixels, to a faster disk or without other programs; slow motion tolerates drops",
        })
    }

    fn usual(&self) -> Option<f64> {
        if self.steps.len() < ENOUGH {
            return None;
        }
        let mut sorted = self.steps.clone();
        sorted.sort_unstable_by(f64::total_cmp);
        sorted.get(sorted.len() / 2).copied()
    }
}

/// The last number in a name, with its fraction: `frame_0012`, `1305031102.175304`.
fn number_in(id: &str) -> Option<f64> {
    let end = id.rfind(|c: char| c.is_ascii_digit())? + 1;
    let head = id.get(..end)?;
    let start = head.rfind(|c: char| !c.is_ascii_digit() && c != '.').map_or(0, |i| i + 1);
    head.get(start..)?.trim_start_matches('.').parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_found_in_names() {
        for (id, number) in [
            ("000012", Some(12.0)),
            ("frame_0012", Some(12.0)),
            ("1305031102.175304", Some(1_305_031_102.175_304)),
            ("a7-color", Some(7.0)),
            ("left", None),
            ("", None),
            ("1.2.3", None),
        ] {
            assert_eq!(number_in(id), number, "{id}");
        }
    }

    #[test]
    fn a_gap_is_told_and_a_constant_stride_is_not() {
        let dropped = |ids: &[f64]| {
            let mut rate = Rate::default();
            ids.iter().filter(|id| rate.check(&format!("{id:.4}")).is_some()).count()
        };
        let steady: Vec<f64> = (0..200).map(|i| f64::from(i) * 3.0).collect();
        assert_eq!(dropped(&steady), 0);
        let jitter: Vec<f64> = (0..200).map(|i| f64::from(i) / 30.0 + f64::from(i % 3) * 0.004).collect();
        assert_eq!(dropped(&jitter), 0);
        let gaps: Vec<f64> = steady.iter().copied().filter(|v| v % 90.0 != 60.0).collect();
        assert!(dropped(&gaps) >= 6);
    }
}
