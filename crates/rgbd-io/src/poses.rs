//! Poses as text files, and files written whole or not at all.
//!
//! On disk a pose is `cam_from_obj` (object to camera, metres): four rows of four numbers.

#![warn(clippy::indexing_slicing)]

use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion};

use crate::Error;
use crate::calibration::{numbers, read_text};
use crate::listing;

const REMEDY: &str = "write the pose as 4 rows of 4 numbers: rotation and translation (metres), then 0 0 0 1";

/// How far `R^T R` may be from the identity: text with three digits passes, a scaled matrix doesn't.
const ROTATION_TOLERANCE: f64 = 0.02;

/// Reads one pose; see [`parse_pose`].
///
/// # Errors
/// When the file is missing or isn't a pose.
pub fn read_pose(path: &Path) -> Result<Isometry3<f64>, Error> {
    let text = read_text(path, REMEDY)?;
    parse_pose(&text).map_err(|e| Error { path: path.to_path_buf(), ..e })
}

/// Parses a 4x4 matrix, row-major, as a rigid transform (metres). The rotation is replaced by the nearest
/// orthonormal one (polar decomposition), which undoes the rounding of the text.
///
/// # Errors
/// Unless there are sixteen finite numbers, a rotation up to rounding, and a last row `0 0 0 1`.
pub fn parse_pose(text: &str) -> Result<Isometry3<f64>, Error> {
    let fail = |problem: String| Error::new("pose", problem, REMEDY);
    let n = numbers(text).map_err(fail)?;
    let &[m11, m12, m13, tx, m21, m22, m23, ty, m31, m32, m33, tz, b1, b2, b3, b4] = n.as_slice() else {
        return Err(fail(format!("holds {} numbers instead of 16", n.len())));
    };
    if n.iter().any(|v| !v.is_finite()) {
        return Err(fail("holds a number that isn't finite".into()));
    }
    if (b4 - 1.0).abs() > 1e-6 || [b1, b2, b3].iter().any(|v| v.abs() > 1e-6) {
        let transposed = tx == 0.0 && ty == 0.0 && tz == 0.0;
        let hint = if transposed { " (the matrix is transposed)" } else { "" };
        return Err(fail(format!("has the last row {b1} {b2} {b3} {b4}{hint}")));
    }
    let m = Matrix3::new(m11, m12, m13, m21, m22, m23, m31, m32, m33);
    let rotation = nearest_rotation(&m).map_err(fail)?;
    Ok(Isometry3::from_parts(Translation3::new(tx, ty, tz), rotation))
}

/// The rotation nearest to a matrix that already is one up to rounding.
pub(crate) fn nearest_rotation(m: &Matrix3<f64>) -> Result<UnitQuaternion<f64>, String> {
    let off = m.transpose() * m - Matrix3::identity();
    // `all` and not a maximum, so that an overflow to NaN fails too.
    if !off.iter().all(|v| v.abs() <= ROTATION_TOLERANCE) {
        return Err(format!("has a rotation part that isn't orthonormal (off by {:.3})", off.amax()));
    }
    if m.determinant() < 0.0 {
        return Err("has a rotation part that mirrors (determinant -1)".into());
    }
    let svd = m.try_svd(true, true, 1e-14, 100).ok_or("has a rotation part that can't be decomposed")?;
    match (svd.u, svd.v_t) {
        (Some(u), Some(v_t)) => {
            let rotation = Rotation3::from_matrix_unchecked(u * v_t);
            Ok(UnitQuaternion::from_rotation_matrix(&rotation))
        }
        _ => Err("has a rotation part that can't be decomposed".into()),
    }
}

/// A pose as four lines of four numbers with nine significant digits, ending in a line break; the inverse of
/// [`parse_pose`] up to that rounding.
pub fn format_pose(pose: &Isometry3<f64>) -> String {
    let m = pose.to_homogeneous();
    let mut text = String::with_capacity(224);
    for row in m.row_iter() {
        let numbers: Vec<String> = row.iter().map(|v| nine_digits(*v)).collect();
        text.push_str(&numbers.join(" "));
        text.push('\n');
    }
    text
}

/// C's `%.9g`, near enough: shortest text of the value rounded to nine significant digits.
pub(crate) fn nine_digits(v: f64) -> String {
    let rounded = format!("{v:.8e}").parse::<f64>().unwrap_or(v);
    if rounded == 0.0 {
        "0".into()
    } else if (1e-5..1e15).contains(&rounded.abs()) {
        format!("{rounded}")
    } else {
        format!("{rounded:e}")
    }
}

/// Reads all `*.txt` poses of a folder in natural order of their names; the id is the file's stem.
///
/// # Errors
/// When the folder is missing or one file isn't a pose.
pub fn read_pose_folder(dir: &Path) -> Result<Vec<(String, Isometry3<f64>)>, Error> {
    let files = listing::files(dir, &["txt"])?;
    files.into_iter().map(|(id, path)| Ok((id, read_pose(&path)?))).collect()
}

/// Writes a file whole or not at all: into a temporary file beside it, which is then renamed. Someone who reads
/// along never sees half a file, and an interrupted run leaves the old one.
///
/// # Errors
/// When the folder is missing, the disk full or writing not permitted; nothing is left behind.
pub fn write_atomic(path: &Path, bytes: &[u8]) -> Result<(), Error> {
    static COUNTER: AtomicU64 = AtomicU64::new(0);
    let Some(name) = path.file_name() else {
        return Err(Error::new(path, "isn't the name of a file", "give a path that ends in a file name"));
    };
    let mut temporary_name = std::ffi::OsString::from(".");
    temporary_name.push(name);
    let unique = COUNTER.fetch_add(1, Ordering::Relaxed);
    temporary_name.push(format!(".{}.{unique}.tmp", std::process::id()));
    let temporary: PathBuf = path.with_file_name(temporary_name);

    let write = || -> std::io::Result<()> {
        let mut file = std::fs::OpenOptions::new().write(true).create_new(true).open(&temporary)?;
        file.write_all(bytes)?;
        drop(file);
        std::fs::rename(&temporary, path)
    };
    write().map_err(|e| {
        // The first error is the one to report; the temporary may not even exist.
        let _ = std::fs::remove_file(&temporary);
        Error::io(path, "writing", &e)
    })
}
