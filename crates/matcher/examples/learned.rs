//! Loads a network's weights, matches two procedural views of one object with it, and prints how right and how fast that
//! was: `cargo run --release -p bundlesdf-matcher --example learned WEIGHTS`, where WEIGHTS is the `.pth` or
//! `.safetensors` file of EdgePoint2 or XFeat.
#![allow(clippy::print_stdout, unreachable_pub)]

#[path = "../tests/texture/mod.rs"]
mod texture;

use matcher::{CropOptions, FeatureMatcher, RollCrop, learned};
use rgbd_io::{Image, Mask};
use std::error::Error;
use std::time::Instant;
use texture::texture;

/// With its margin of 10 pixels on each side, the object's crop has 320 x 256 pixels.
const OBJECT: [f32; 2] = [150.0, 118.0];
const CENTRE: [f32; 2] = [200.0, 170.0];

/// Where pixel `p` of the first view went: a turn of 12 degrees, a little smaller, and moved.
fn moved(p: [f32; 2]) -> [f32; 2] {
    let (s, c) = 0.21_f32.sin_cos();
    let (u, v) = (0.9 * (p[0] - CENTRE[0]), 0.9 * (p[1] - CENTRE[1]));
    [c * u - s * v + CENTRE[0] + 9.0, s * u + c * v + CENTRE[1] - 6.0]
}

/// The pixel of the first view that went to `p`.
fn origin(p: [f32; 2]) -> [f32; 2] {
    let (s, c) = 0.21_f32.sin_cos();
    let (u, v) = ((p[0] - CENTRE[0] - 9.0) / 0.9, (p[1] - CENTRE[1] + 6.0) / 0.9);
    [c * u + s * v + CENTRE[0], -s * u + c * v + CENTRE[1]]
}

fn view(map: impl Fn([f32; 2]) -> [f32; 2]) -> (Image<f32>, Mask) {
    let mut mask = Mask::filled(400, 340, 0);
    let gray = Image::from_fn(400, 340, |x, y| {
        let p = map([x as f32, y as f32]);
        let (dx, dy) = ((p[0] - CENTRE[0]).abs(), (p[1] - CENTRE[1]).abs());
        if dx <= OBJECT[0] && dy <= OBJECT[1] {
            mask[(x, y)] = 255;
            texture(p[0], p[1], 1)
        } else {
            texture(x as f32, y as f32, 2)
        }
    });
    (gray, mask)
}

/// Median of some runs, milliseconds.
fn timed<T>(mut f: impl FnMut() -> T) -> (T, f64) {
    let mut times = Vec::new();
    loop {
        let start = Instant::now();
        let result = f();
        times.push(start.elapsed().as_secs_f64() * 1e3);
        if times.len() == 25 {
            times.sort_by(f64::total_cmp);
            return (result, times[times.len() / 2]);
        }
    }
}

fn main() -> Result<(), Box<dyn Error>> {
    let path = std::env::args().nth(1).ok_or("usage: learned WEIGHTS (a .pth or .safetensors file)")?;
    let bytes = std::fs::read(&path)?;
    let (matcher, load_ms) = timed(|| learned::from_bytes(None, &bytes));
    let matcher: Box<dyn FeatureMatcher> = matcher?;
    println!("{path}: loaded in {load_ms:.1} ms");

    let options = CropOptions::default();
    let crop = |(gray, mask): (Image<f32>, Mask)| RollCrop::new(&gray, &mask, 0.0, &options);
    let a = crop(view(|p| p)).ok_or("the object is empty")?;
    let b = crop(view(origin)).ok_or("the object is empty")?;
    for threads in [1, 2] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build()?;
        let (found, ms) = pool.install(|| timed(|| matcher.detect(&a)));
        println!("{} features of {:?} pixels: {ms:.2} ms on {threads} threads", found.len(), a.gray().size());
    }
    let (fa, fb) = (matcher.detect(&a), matcher.detect(&b));
    let (matches, ms) = timed(|| matcher.match_features(&fa, &fb));
    let error = |m: &matcher::Match| {
        let truth = moved(m.a);
        (m.b[0] - truth[0]).hypot(m.b[1] - truth[1])
    };
    let mut errors: Vec<f32> = matches.iter().map(error).collect();
    errors.sort_by(f32::total_cmp);
    let good = errors.iter().filter(|e| **e < 2.0).count();
    let median = errors.get(good / 2).copied().unwrap_or(f32::NAN);
    println!(
        "{} matches in {ms:.2} ms, {good} within 2 px, their median error {median:.2} px",
        matches.len()
    );
    Ok(())
}
