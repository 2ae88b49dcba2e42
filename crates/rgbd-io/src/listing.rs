//! Files of a folder in natural order.

#![warn(clippy::indexing_slicing)]

use std::cmp::Ordering;
use std::path::{Path, PathBuf};

use crate::Error;

/// One file: its name without the extension, and its path.
pub(crate) type Listed = (String, PathBuf);

/// The files of `dir` with one of `extensions` (compared without case), in natural order of their stems.
/// Hidden files are left out: some systems put `._name` companions beside every image.
pub(crate) fn files(dir: &Path, extensions: &[&str]) -> Result<Vec<Listed>, Error> {
    let failed = |e: std::io::Error| Error::io(dir, "listing the folder", &e);
    let mut found = Vec::new();
    for entry in std::fs::read_dir(dir).map_err(failed)? {
        let path = entry.map_err(failed)?.path();
        let (Some(stem), Some(extension)) = (path.file_stem(), path.extension()) else { continue };
        let stem = stem.to_string_lossy().into_owned();
        let wanted = extensions.iter().any(|e| extension.eq_ignore_ascii_case(e));
        if wanted && !stem.starts_with('.') {
            found.push((stem, path));
        }
    }
    found.sort_by(|a, b| natural_cmp(&a.0, &b.0).then_with(|| a.1.cmp(&b.1)));
    Ok(found)
}

/// Compares like a person would: `frame2` before `frame10`. Total; equal only for equal strings.
pub(crate) fn natural_cmp(a: &str, b: &str) -> Ordering {
    let (mut x, mut y) = (a.as_bytes(), b.as_bytes());
    loop {
        let order = match (x, y) {
            ([], []) => return a.cmp(b),
            ([], _) => Ordering::Less,
            (_, []) => Ordering::Greater,
            ([p, ..], [q, ..]) if p.is_ascii_digit() && q.is_ascii_digit() => {
                let (m, n) = (take_number(&mut x), take_number(&mut y));
                m.len().cmp(&n.len()).then_with(|| m.cmp(n))
            }
            ([p, rest_x @ ..], [q, rest_y @ ..]) => {
                (x, y) = (rest_x, rest_y);
                p.cmp(q)
            }
        };
        if order.is_ne() {
            return order;
        }
    }
}

/// Splits the leading digits off and returns them without leading zeros.
fn take_number<'a>(bytes: &mut &'a [u8]) -> &'a [u8] {
    let end = bytes.iter().position(|b| !b.is_ascii_digit()).unwrap_or(bytes.len());
    let (digits, rest) = bytes.split_at(end);
    *bytes = rest;
    let zeros = digits.iter().take_while(|b| **b == b'0').count();
    digits.get(zeros..).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_sort_by_value() {
        let mut names = ["f10", "f2", "f002", "f1", "a", "f", "f2b", "10", "9"];
        names.sort_by(|a, b| natural_cmp(a, b));
        assert_eq!(names, ["9", "10", "a", "f", "f1", "f002", "f2", "f2b", "f10"]);
    }

    proptest::proptest! {
        #[test]
        fn the_order_is_total(a in "[a0-9]{0,6}", b in "[a0-9]{0,6}", c in "[a0-9]{0,6}") {
            assert_eq!(natural_cmp(&a, &b), natural_cmp(&b, &a).reverse());
            assert_eq!(natural_cmp(&a, &b).is_eq(), a == b);
            if natural_cmp(&a, &b).is_le() && natural_cmp(&b, &c).is_le() {
                assert!(natural_cmp(&a, &c).is_le());
            }
        }
    }
}
