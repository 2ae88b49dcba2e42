//! The camera matrix as a text file.

#![warn(clippy::indexing_slicing)]

use std::path::Path;

use crate::{Error, Intrinsics};

const REMEDY: &str = "write the 3x3 camera matrix in pixels as three rows: fx 0 cx / 0 fy cy / 0 0 1";

/// Larger text files aren't ours; reading one would only cost memory.
const MAX_TEXT_BYTES: u64 = 1 << 20;

/// Reads a camera matrix `K` (3x3, row-major, pixels) from a text file; see [`parse_intrinsics`].
///
/// # Errors
/// When the file is missing or isn't a camera matrix.
pub fn read_intrinsics(path: &Path) -> Result<Intrinsics, Error> {
    let text = read_text(path, REMEDY)?;
    parse_intrinsics(&text).map_err(|e| Error { path: path.to_path_buf(), ..e })
}

/// Parses a camera matrix `K` (3x3, row-major, pixels). Numbers may be separated by spaces, commas, semicolons
/// or brackets; lines from `#` on are comments. `fx` and `fy` may differ.
///
/// # Errors
/// Unless there are exactly nine finite numbers with positive focal lengths, no skew and a last row `0 0 1`.
pub fn parse_intrinsics(text: &str) -> Result<Intrinsics, Error> {
    let n = numbers(text).map_err(|problem| Error::new("camera matrix", problem, REMEDY))?;
    intrinsics_of(&n)
}

/// The camera of a matrix given by rows; see [`parse_intrinsics`].
pub(crate) fn intrinsics_of(n: &[f64]) -> Result<Intrinsics, Error> {
    let fail = |problem: String| Error::new("camera matrix", problem, REMEDY);
    let &[fx, skew, cx, k10, fy, cy, k20, k21, k22] = n else {
        return Err(fail(format!("holds {} numbers instead of 9", n.len())));
    };
    if n.iter().any(|v| !v.is_finite()) {
        return Err(fail("holds a number that isn't finite".into()));
    }
    if fx <= 0.0 || fy <= 0.0 {
        return Err(fail(format!("has a focal length that isn't positive (fx {fx}, fy {fy})")));
    }
    if cx == 0.0 && cy == 0.0 && (k20 != 0.0 || k21 != 0.0) {
        return Err(fail("is transposed (the principal point is in the last row)".into()));
    }
    if [k10, k20, k21].iter().any(|v| v.abs() > 1e-9) || (k22 - 1.0).abs() > 1e-6 {
        return Err(fail(format!(
            "isn't a camera matrix (below the diagonal {k10} {k20} {k21}, corner {k22})"
        )));
    }
    // A thousandth of the focal length moves a point at the image's edge by under half a pixel.
    if skew.abs() > 1e-3 * fx {
        let remedy = "rectify the images to a camera without skew and write its matrix";
        return Err(Error::new(
            "camera matrix",
            format!("has a skew of {skew}, which isn't supported"),
            remedy,
        ));
    }
    Ok(Intrinsics { fx, fy, cx, cy })
}

/// All numbers of a text, or what is wrong with it.
pub(crate) fn numbers(text: &str) -> Result<Vec<f64>, String> {
    let text = text.trim_start_matches('\u{feff}');
    let lines = text.lines().map(|line| line.split('#').next().unwrap_or(""));
    let words = lines.flat_map(|l| l.split(|c: char| c.is_whitespace() || ",;[]()".contains(c)));
    let mut numbers = Vec::new();
    for word in words.filter(|w| !w.is_empty()) {
        match word.parse::<f64>() {
            Ok(v) => numbers.push(v),
            Err(_) => {
                let shown: String = word.chars().take(20).collect();
                return Err(format!("holds \"{}\", which isn't a number", shown.escape_debug()));
            }
        }
    }
    Ok(numbers)
}

/// Reads a small text file; what isn't UTF-8 becomes replacement characters, for the parser to complain about.
pub(crate) fn read_text(path: &Path, remedy: &str) -> Result<String, Error> {
    let read = || -> std::io::Result<Result<Vec<u8>, String>> {
        let meta = std::fs::metadata(path)?;
        if !meta.is_file() {
            return Ok(Err("isn't a file".into()));
        }
        if meta.len() > MAX_TEXT_BYTES {
            return Ok(Err(format!("has {} bytes, too many for this kind of text", meta.len())));
        }
        std::fs::read(path).map(Ok)
    };
    match read() {
        Ok(Ok(bytes)) => Ok(String::from_utf8_lossy(&bytes).into_owned()),
        Ok(Err(problem)) => Err(Error::new(path, problem, remedy)),
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => Err(Error::new(path, "is missing", remedy)),
        Err(e) => Err(Error::io(path, "reading", &e)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn accepts_the_usual_spellings() {
        let k = Intrinsics { fx: 500.0, fy: 480.5, cx: 320.0, cy: 240.0 };
        for text in [
            "500 0 320\n0 480.5 240\n0 0 1\n",
            "500,0,320,0,480.5,240,0,0,1",
            "[[500.0, 0, 320], [0, 4.805e2, 240], [0, 0, 1]]",
            "\u{feff}# camera\r\n500 0 320\r\n0 480.5 240 # second row\r\n0 0 1",
        ] {
            assert_eq!(parse_intrinsics(text).unwrap(), k, "{text}");
        }
    }

    #[test]
    fn says_what_is_wrong() {
        for (text, word) in [
            ("", "0 numbers"),
            ("1 2 3 4", "4 numbers"),
            ("500 0 320 0 500 240 0 0 1 7", "10 numbers"),
            ("500 0 320 0 nan 240 0 0 1", "finite"),
            ("500 0 inf 0 500 240 0 0 1", "finite"),
            ("-500 0 320 0 500 240 0 0 1", "positive"),
            ("500 0 320 0 0 240 0 0 1", "positive"),
            ("500 0 0 0 500 0 320 240 1", "transposed"),
            ("500 0 320 0 500 240 0 0 2", "camera matrix"),
            ("500 9 320 0 500 240 0 0 1", "skew"),
            ("fx 0 cx", "\"fx\""),
        ] {
            let message = parse_intrinsics(text).unwrap_err().to_string();
            assert!(message.contains(word), "{text}: {message}");
            assert!(!message.contains('\n'));
        }
    }
}
