//! The suite: `suite` prints the table, `suite sheet FILE.png [FRAME]` writes a contact sheet with one frame of each
//! sequence, `suite write NAME FOLDER [FRAMES]` writes a sequence as a folder.
#![allow(clippy::print_stdout)]

use rgbd_io::Image;
use rgbd_synth::{Sequence, write_custom};
use std::path::Path;

type Result = std::result::Result<(), Box<dyn std::error::Error>>;

fn main() -> Result {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    match arguments[..] {
        ["sheet", file] => sheet(file, None),
        ["sheet", file, frame] => sheet(file, Some(frame.parse()?)),
        ["write", name, folder] => write(name, folder, usize::MAX),
        ["write", name, folder, frames] => write(name, folder, frames.parse()?),
        _ => {
            for sequence in Sequence::suite().filter_map(Sequence::named) {
                let stresses = Sequence::stresses(sequence.name()).unwrap_or_default();
                println!("| `{}` | {} | {stresses} |", sequence.name(), sequence.len());
            }
            Ok(())
        }
    }
}

fn write(name: &str, folder: &str, frames: usize) -> Result {
    let sequence = Sequence::named(name)
        .ok_or_else(|| format!("{name} is not in the suite; run without arguments for the names"))?;
    let sequence = sequence.truncated(frames);
    write_custom(&sequence, folder)?;
    println!("{}: {} frames in {folder}", sequence.name(), sequence.len());
    Ok(())
}

/// Colour with the given mask's outline, and depth below, at half the size, five sequences a row.
fn sheet(file: &str, frame: Option<usize>) -> Result {
    const COLUMNS: usize = 5;
    let (width, height) = (320, 480);
    let names: Vec<&str> = Sequence::suite().collect();
    let rows = names.len().div_ceil(COLUMNS);
    let mut out = Image::filled(COLUMNS * width, rows * height, [255u8; 3]);
    for (i, sequence) in names.iter().filter_map(|n| Sequence::named(n)).enumerate() {
        let start = std::time::Instant::now();
        let f = sequence.render(frame.unwrap_or(sequence.len() / 4).min(sequence.len() - 1));
        let area = f.visible_mask.pixels().iter().filter(|m| **m != 0).count();
        println!("{}: object {area} pixels, {:.0?}", sequence.name(), start.elapsed());
        let (left, top) = (i % COLUMNS * width, i / COLUMNS * height);
        let mask = f.frame.mask.as_ref().unwrap_or(&f.visible_mask);
        for y in 0..240 {
            for x in 0..320 {
                let (u, v) = (2 * x, 2 * y);
                let inside = |u: usize, v: usize| mask.get(u, v).is_some_and(|m| *m != 0);
                let edge = inside(u, v) != inside(u + 2, v) || inside(u, v) != inside(u, v + 2);
                let four = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(a, b)| f.frame.color[(u + a, v + b)]);
                let mean =
                    std::array::from_fn(|k| (four.iter().map(|c| u32::from(c[k])).sum::<u32>() / 4) as u8);
                out[(left + x, top + y)] = if edge { [0, 255, 60] } else { mean };
                let z = f.frame.depth[(u, v)];
                let near = if z > 0.0 { (255.0 * (0.35 / z).min(1.0)) as u8 } else { 0 };
                out[(left + x, top + 240 + y)] = if z > 0.0 { [near; 3] } else { [90, 0, 40] };
            }
        }
    }
    rgbd_io::write_png_rgb(Path::new(file), &out)?;
    println!("{file}");
    Ok(())
}
