//! Which of a folder's masks belongs to which frame.

use std::collections::HashMap;

/// Why masks and frames can't be matched.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "{masks} masks can't be matched with {frames} frames by name, trailing number or order; name each mask like its \
     frame"
)]
pub struct NamingError {
    /// Number of frames.
    pub frames: usize,
    /// Number of masks.
    pub masks: usize,
}

/// For every frame the position of its mask in `masks`; both are file names without extension, in order.
///
/// Tried in turn: the same name; the same number at the end of the name (`rgb_0012` and `mask-12`), if no two masks
/// share one; as many masks as frames, in natural order. The first way that gives at least half of the frames a mask
/// is taken.
///
/// # Errors
/// When none does.
pub fn pair_masks(frames: &[&str], masks: &[&str]) -> Result<Vec<Option<usize>>, NamingError> {
    let enough = |pairs: &Vec<Option<usize>>| {
        let found = pairs.iter().flatten().count();
        found > 0 && 2 * found >= frames.len()
    };
    let by_name: HashMap<&str, usize> = masks.iter().enumerate().map(|(i, m)| (*m, i)).collect();
    let pairs: Vec<_> = frames.iter().map(|f| by_name.get(f).copied()).collect();
    if enough(&pairs) {
        return Ok(pairs);
    }
    let numbers: HashMap<u64, usize> =
        masks.iter().enumerate().filter_map(|(i, m)| Some((trailing_number(m)?, i))).collect();
    let numbered = masks.iter().filter(|m| trailing_number(m).is_some()).count();
    let pairs: Vec<_> =
        frames.iter().map(|f| trailing_number(f).and_then(|n| numbers.get(&n).copied())).collect();
    if numbers.len() == numbered && enough(&pairs) {
        return Ok(pairs);
    }
    if frames.len() == masks.len() && !frames.is_empty() {
        let mut order: Vec<usize> = (0..masks.len()).collect();
        order.sort_by_key(|&i| natural_key(masks[i]));
        return Ok(order.into_iter().map(Some).collect());
    }
    Err(NamingError { frames: frames.len(), masks: masks.len() })
}

/// The number that a name ends with.
fn trailing_number(name: &str) -> Option<u64> {
    let digits = name.len() - name.bytes().rev().take_while(u8::is_ascii_digit).count();
    name.get(digits..)?.parse().ok()
}

/// Texts and numbers of a name in turn: `f2` comes before `f10`.
fn natural_key(name: &str) -> Vec<(String, u64)> {
    let mut key = vec![(String::new(), 0u64)];
    let mut in_number = false;
    for c in name.chars() {
        match (c.to_digit(10), key.last_mut()) {
            (Some(d), Some(last)) => {
                last.1 = last.1.saturating_mul(10).saturating_add(u64::from(d));
                in_number = true;
            }
            (None, Some(last)) if !in_number => last.0.push(c),
            _ => {
                key.push((c.to_string(), 0));
                in_number = false;
            }
        }
    }
    key
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pairs(frames: &[&str], masks: &[&str]) -> Vec<Option<usize>> {
        pair_masks(frames, masks).unwrap()
    }

    #[test]
    fn names_come_first_then_numbers_then_order() {
        assert_eq!(pairs(&["0", "1", "2"], &["2", "0"]), [Some(1), None, Some(0)]);
        assert_eq!(pairs(&["rgb_0011", "rgb_0012"], &["mask-12", "mask-11", "mask-13"]), [Some(1), Some(0)]);
        assert_eq!(pairs(&["a", "b", "c"], &["m10", "m9", "m1x"]), [Some(2), Some(1), Some(0)]);
        // Two masks with one number: by order.
        assert_eq!(pairs(&["f7", "f8"], &["a_7", "b_7"]), [Some(0), Some(1)]);
    }

    #[test]
    fn what_cannot_be_matched_is_an_error() {
        let error = pair_masks(&["a", "b", "c"], &["x", "y"]).unwrap_err();
        assert!(error.to_string().contains("2 masks can't be matched with 3 frames"), "{error}");
        assert!(pair_masks(&["a"], &[]).is_err());
        assert!(pair_masks(&[], &["a"]).is_err());
        assert!(pair_masks(&["99999999999999999999999"], &["x", "y"]).is_err());
    }
}
