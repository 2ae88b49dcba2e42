//! How good a first mask is that is cut out of a box 15 % larger than the object, or grown from three points on it.
//!
//! `cargo run --release -p mask-tracker --example first_mask -- FOLDER...`
//!
//! Each FOLDER holds `rgb/`, `depth/`, `cam_K.txt` and the first frame's true mask in `masks/` or `masks_derived/`.
#![allow(clippy::print_stdout, missing_docs)]

use std::path::PathBuf;

use mask_tracker::{Hints, first_mask};
use rgbd_io::{CustomFolder, CustomOptions, FrameSource, Mask, MaskSource};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folders: Vec<PathBuf> = std::env::args_os().skip(1).map(PathBuf::from).collect();
    if folders.is_empty() {
        println!("usage: first_mask FOLDER...");
    }
    for folder in folders {
        let mut options = CustomOptions { masks: MaskSource::First, ..CustomOptions::default() };
        if !folder.join("masks").is_dir() {
            options.masks = MaskSource::Folder("masks_derived".into());
        }
        let frame = CustomFolder::open(&folder, &options)?.frame(0)?;
        let Some(truth) = &frame.mask else { continue };
        let boxed = Hints { rectangle: Some(loose_box(truth)), ..Hints::default() };
        let pointed = Hints { object: inner_points(truth), ..Hints::default() };
        let score = |hints| first_mask(&frame, hints).map_or(0.0, |mask| iou(&mask, truth));
        println!("{}: box J {:.3}, points J {:.3}", folder.display(), score(&boxed), score(&pointed));
    }
    Ok(())
}

fn iou(a: &Mask, b: &Mask) -> f64 {
    let pairs = || a.pixels().iter().zip(b.pixels());
    let both = pairs().filter(|(a, b)| **a != 0 && **b != 0).count();
    both as f64 / pairs().filter(|(a, b)| **a != 0 || **b != 0).count().max(1) as f64
}

/// The pixels of the mask, row after row.
fn pixels(mask: &Mask) -> Vec<[f32; 2]> {
    let w = mask.width().max(1);
    let set = mask.pixels().iter().enumerate().filter(|(_, m)| **m != 0);
    set.map(|(i, _)| [(i % w) as f32, (i / w) as f32]).collect()
}

fn loose_box(mask: &Mask) -> [f32; 4] {
    let all = pixels(mask);
    let low = |k: usize| all.iter().map(|p| p[k]).fold(f32::INFINITY, f32::min);
    let high = |k: usize| all.iter().map(|p| p[k]).fold(0.0, f32::max);
    let (w, h) = (high(0) - low(0) + 1.0, high(1) - low(1) + 1.0);
    [low(0) - 0.075 * w, low(1) - 0.075 * h, 1.15 * w, 1.15 * h]
}

/// A quarter, half and three quarters down the mask.
fn inner_points(mask: &Mask) -> Vec<[f32; 2]> {
    let all = pixels(mask);
    [1, 2, 3].iter().filter_map(|k| all.get(k * all.len() / 4).copied()).collect()
}
