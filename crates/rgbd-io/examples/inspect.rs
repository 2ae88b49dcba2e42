//! Looks over a recording: `cargo run --example inspect -- FOLDER [MASK_FOLDER]`. Without a folder it writes a
//! small synthetic one and looks over that.
#![allow(clippy::print_stdout)]

use std::path::{Path, PathBuf};

use rgbd_io::{CustomOptions, CustomWriter, Image, Intrinsics, MaskSource, inspect};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args_os().skip(1).map(PathBuf::from);
    if let Some(folder) = arguments.next() {
        let masks = arguments.next().map_or(MaskSource::First, MaskSource::Folder);
        println!("{}", inspect(folder, &CustomOptions { masks, ..Default::default() }));
        return Ok(());
    }
    let dir = tempfile::tempdir()?;
    write_sphere(dir.path(), 6)?;
    println!("{}", inspect(dir.path(), &CustomOptions::default()));
    Ok(())
}

/// A ball of 6 cm radius that rolls past a wall, seen by a small camera.
fn write_sphere(dir: &Path, frames: usize) -> Result<(), rgbd_io::Error> {
    let camera = Intrinsics { fx: 150.0, fy: 150.0, cx: 79.5, cy: 59.5 };
    let writer = CustomWriter::create(dir, &camera)?;
    for i in 0..frames {
        let centre = [0.02 * i as f64 - 0.05, 0.0, 0.6];
        let depth = Image::from_fn(160, 120, |x, y| {
            let [a, b, _] = camera.unproject(x as f64, y as f64, 1.0);
            // |t (a, b, 1) - centre| = radius, for the nearer t.
            let (p, q) = (a * centre[0] + b * centre[1] + centre[2], a * a + b * b + 1.0);
            let c: f64 = centre.iter().map(|v| v * v).sum::<f64>() - 0.06 * 0.06;
            let disc = p * p - q * c;
            if disc > 0.0 { ((p - disc.sqrt()) / q) as f32 } else { 1.2 }
        });
        let mask = depth.map(|z| if *z < 1.0 { 255 } else { 0 });
        let color = depth.map(|z| if *z < 1.0 { [220, 120, 40] } else { [90, 90, 90] });
        writer.write_frame(&format!("{i:04}"), &color, &depth, (i == 0).then_some(&mask))?;
    }
    Ok(())
}
