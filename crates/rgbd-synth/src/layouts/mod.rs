//! Sequences in the layouts of published benchmarks, as [`rgbd_io`]'s `datasets` read them.
//!
//! Written from the descriptions of the formats and not with the readers' code, so that each checks the other.

mod behave;
mod bop;
mod ho3d;
mod pickle;
mod tum;
mod ycbineoat;

use crate::{Sequence, SynthFrame};
use marching_cubes::TriMesh;
use rayon::prelude::*;
use rgbd_io::{Error, Image, Mask, poses::write_atomic};
use std::path::Path;

pub use behave::write_behave;
pub use bop::write_bop;
pub use ho3d::write_ho3d;
pub use tum::write_tum;
pub use ycbineoat::write_ycbineoat;

/// Colour is stored with little loss.
const JPEG_QUALITY: u8 = 95;

fn folder(path: &Path) -> Result<(), Error> {
    std::fs::create_dir_all(path).map_err(|e| {
        let remedy = "check the disk, the path and its permissions";
        Error::new(path, format!("creating the folder failed ({e})"), remedy)
    })
}

fn each_frame(
    sequence: &Sequence,
    write: impl Fn(usize, &SynthFrame) -> Result<(), Error> + Sync,
) -> Result<(), Error> {
    (0..sequence.len()).into_par_iter().try_for_each(|index| write(index, &sequence.render(index)))
}

fn text(path: &Path, text: &str) -> Result<(), Error> {
    write_atomic(path, text.as_bytes())
}

/// Writes `mesh` with one of marching-cubes' writers.
fn mesh(
    path: &Path,
    mesh: &TriMesh,
    write: impl Fn(&TriMesh, &mut Vec<u8>) -> std::io::Result<()>,
) -> Result<(), Error> {
    if let Some(parent) = path.parent() {
        folder(parent)?;
    }
    let mut bytes = Vec::new();
    write(mesh, &mut bytes)
        .map_err(|e| Error::new(path, format!("writing the mesh failed ({e})"), "use a smaller mesh"))?;
    write_atomic(path, &bytes)
}

/// Depth in units of which `per_metre` make a metre; what doesn't fit becomes missing.
fn units(depth: &Image<f32>, per_metre: f64) -> Image<u16> {
    depth.map(|z| {
        let units = (f64::from(*z) * per_metre).round();
        if (1.0..65535.0).contains(&units) { units as u16 } else { 0 }
    })
}

fn grey(mask: &Mask) -> Image<[u8; 3]> {
    mask.map(|v| if *v == 0 { [0; 3] } else { [255; 3] })
}

/// `fx 0 cx 0 fy cy 0 0 1` with all digits, separated as asked for.
fn camera_matrix(sequence: &Sequence, separator: &str) -> String {
    let k = sequence.intrinsics();
    [k.fx, 0.0, k.cx, 0.0, k.fy, k.cy, 0.0, 0.0, 1.0].map(|v| v.to_string()).join(separator)
}

fn numbers<'a>(values: impl IntoIterator<Item = &'a f64>) -> String {
    values.into_iter().map(f64::to_string).collect::<Vec<_>>().join(", ")
}
