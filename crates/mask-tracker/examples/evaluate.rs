//! Propagates the first mask through a recorded sequence and compares with the sequence's own masks.
//!
//! `cargo run --release -p mask-tracker --example evaluate -- FOLDER [--no-pose] [--noise MM DEG] [--overlays DIR]`
//!
//! FOLDER holds `rgb/*.{png,jpg}`, `depth/*.png` (16 bit, mm), `cam_K.txt`, `gt_poses/*.txt` (4x4 object in camera)
//! and `masks_derived/*.png` or `masks/*.png`. The true poses stand in for a tracker: the pose prediction is the
//! constant-velocity one, the model is fused from the refined masks. `--noise` disturbs every pose.
#![allow(clippy::print_stdout, clippy::unwrap_used, clippy::expect_used, missing_docs)]

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Instant;

use mask_tracker::{Prior, Propagate, SurfacePoint, VideoSegmenter};
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
use rgbd_io::{Image, Intrinsics, Mask, RgbdFrame};

struct Arguments {
    folder: PathBuf,
    poses: bool,
    noise: Option<(f64, f64)>,
    overlays: Option<PathBuf>,
}

fn arguments() -> Option<Arguments> {
    let mut args = std::env::args().skip(1);
    let mut out = Arguments { folder: args.next()?.into(), poses: true, noise: None, overlays: None };
    while let Some(a) = args.next() {
        match a.as_str() {
            "--no-pose" => out.poses = false,
            "--noise" => out.noise = Some((args.next()?.parse().ok()?, args.next()?.parse().ok()?)),
            "--overlays" => out.overlays = Some(args.next()?.into()),
            _ => return None,
        }
    }
    Some(out)
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let Some(args) = arguments() else {
        println!("usage: evaluate FOLDER [--no-pose] [--noise MM DEG] [--overlays DIR]");
        return Ok(());
    };
    if !args.folder.join("rgb").is_dir() {
        println!("SKIPPED: {} holds no sequence", args.folder.display());
        return Ok(());
    }
    let intrinsics = rgbd_io::read_intrinsics(&args.folder.join("cam_K.txt"))?;
    let mut images: Vec<PathBuf> =
        std::fs::read_dir(args.folder.join("rgb"))?.filter_map(|e| Some(e.ok()?.path())).collect();
    images.sort();
    let mut segmenter = Propagate::default();
    let mut model = Fusion::default();
    let mut poses: Vec<Isometry3<f64>> = Vec::new();
    let mut scores = Vec::new();
    let mut times = [0.0f64; 2];
    let mut off_outline = 0.0;
    for (index, image) in images.iter().enumerate() {
        let frame = read_frame(&args.folder, image, intrinsics)?;
        let truth = rgbd_io::read_mask(&args.folder.join("masks_derived").join(format!("{}.png", frame.id)))?;
        let pose =
            rgbd_io::poses::read_pose(&args.folder.join("gt_poses").join(format!("{}.txt", frame.id)))?;
        let pose = args.noise.map_or(pose, |(mm, deg)| disturbed(pose, mm, deg, index));
        let predicted = match poses.as_slice() {
            [.., a, b] => b * a.inverse() * b,
            [.., b] => *b,
            [] => pose,
        };
        poses.push(pose);
        if index == 0 {
            let given = args.folder.join("masks").join(format!("{}.png", frame.id));
            let first = if given.is_file() { rgbd_io::read_mask(&given)? } else { truth };
            segmenter.start(&frame, &first);
            if args.poses {
                model.add(&frame, &first, &pose);
                let first = mask_tracker::Segmentation::new(first, 1.0);
                segmenter.refine(&frame, first, &Prior { cam_from_obj: Some(pose), ..Prior::default() });
            }
            continue;
        }
        let points = model.points();
        let prior = |pose| {
            if args.poses {
                Prior { cam_from_obj: Some(pose), model: &points, confidence: 1.0 }
            } else {
                Prior::default()
            }
        };
        let clock = Instant::now();
        let before = segmenter.next(&frame, &prior(predicted));
        times[0] += clock.elapsed().as_secs_f64();
        let first_pass = iou(&before.mask, &truth);
        let clock = Instant::now();
        let after = segmenter.refine(&frame, before, &prior(pose));
        times[1] += clock.elapsed().as_secs_f64();
        let second_pass = iou(&after.mask, &truth);
        off_outline += iou_off_outline(&after.mask, &truth);
        scores.push((index, first_pass, second_pass, after.confidence));
        if args.poses && after.confidence > 0.5 {
            model.add(&frame, &after.mask, &pose);
        }
        if let Some(folder) = &args.overlays {
            std::fs::create_dir_all(folder)?;
            let name = folder.join(format!("{}.png", frame.id));
            rgbd_io::write_png_rgb(&name, &overlay(&frame, &after.mask, &truth))?;
        }
    }
    println!("J off the outline {:.4}", off_outline / scores.len().max(1) as f64);
    report(&args.folder, &scores, times, model.points().len());
    Ok(())
}

fn report(folder: &Path, scores: &[(usize, f64, f64, f32)], times: [f64; 2], points: usize) {
    let n = scores.len().max(1) as f64;
    let mean = |f: fn(&(usize, f64, f64, f32)) -> f64| scores.iter().map(f).sum::<f64>() / n;
    let mut worst = scores.to_vec();
    worst.sort_by(|a, b| a.2.total_cmp(&b.2));
    println!(
        "{}: {} frames, J before the pose {:.4}, after {:.4}, lowest {:.4}; next {:.1} ms, refine {:.1} ms; {points} points",
        folder.file_name().unwrap_or_default().to_string_lossy(),
        scores.len(),
        mean(|s| s.1),
        mean(|s| s.2),
        worst.first().map_or(0.0, |s| s.2),
        times[0] / n * 1e3,
        times[1] / n * 1e3,
    );
    for (i, a, b, c) in worst.iter().take(6) {
        println!("  frame {i}: J {a:.3} -> {b:.3}, confidence {c:.2}");
    }
}

fn read_frame(folder: &Path, image: &Path, intrinsics: Intrinsics) -> Result<RgbdFrame, rgbd_io::Error> {
    let id = image.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let depth = rgbd_io::read_depth_u16(&folder.join("depth").join(format!("{id}.png")))?;
    Ok(RgbdFrame {
        id,
        color: rgbd_io::read_color(image)?,
        depth: depth.map(|&mm| f32::from(mm) * 1e-3),
        mask: None,
        intrinsics,
    })
}

/// A deterministic disturbance of up to `mm` and `deg` per axis.
fn disturbed(pose: Isometry3<f64>, mm: f64, deg: f64, index: usize) -> Isometry3<f64> {
    let wave = |k: usize| (index as f64 * 12.9898 + k as f64 * 78.233).sin();
    let shift = Vector3::new(wave(0), wave(1), wave(2)) * mm * 1e-3;
    let turn = Vector3::new(wave(3), wave(4), wave(5)) * deg.to_radians();
    let mut out = pose;
    out.append_translation_mut(&Translation3::from(shift));
    out.append_rotation_wrt_center_mut(&UnitQuaternion::from_scaled_axis(turn));
    out
}

/// IoU without the pixels within two of the truth's outline, which rendered truth only knows to 1-2 pixels.
fn iou_off_outline(mask: &Mask, truth: &Mask) -> f64 {
    let (w, h) = truth.size();
    let (mut both, mut either) = (0u32, 0u32);
    for y in 2..h.saturating_sub(2) {
        for x in 2..w.saturating_sub(2) {
            let t = truth[(x, y)] != 0;
            if (y - 2..=y + 2).any(|v| (x - 2..=x + 2).any(|u| (truth[(u, v)] != 0) != t)) {
                continue;
            }
            let m = mask[(x, y)] != 0;
            both += u32::from(t && m);
            either += u32::from(t || m);
        }
    }
    if either == 0 { 1.0 } else { f64::from(both) / f64::from(either) }
}

fn iou(a: &Mask, b: &Mask) -> f64 {
    let (mut both, mut either) = (0, 0);
    for (&a, &b) in a.pixels().iter().zip(b.pixels()) {
        both += usize::from(a != 0 && b != 0);
        either += usize::from(a != 0 || b != 0);
    }
    if either == 0 { 1.0 } else { f64::from(both as u32) / f64::from(either as u32) }
}

/// The image around the object, three times as large: the mask's outline red, the truth's green, both yellow.
fn overlay(frame: &RgbdFrame, mask: &Mask, truth: &Mask) -> Image<[u8; 3]> {
    let (w, h) = frame.color.size();
    let outline = |m: &Mask, x: usize, y: usize| {
        m[(x, y)] != 0
            && (x == 0
                || y == 0
                || x + 1 == w
                || y + 1 == h
                || [(x - 1, y), (x + 1, y), (x, y - 1), (x, y + 1)].iter().any(|&p| m[p] == 0))
    };
    let (mut x0, mut y0, mut x1, mut y1) = (w, h, 0, 0);
    for y in 0..h {
        for x in 0..w {
            if mask[(x, y)] != 0 || truth[(x, y)] != 0 {
                (x0, y0, x1, y1) = (x0.min(x), y0.min(y), x1.max(x), y1.max(y));
            }
        }
    }
    let (x0, y0) = (x0.saturating_sub(20).min(w - 1), y0.saturating_sub(20).min(h - 1));
    let (x1, y1) = ((x1 + 20).clamp(x0, w - 1), (y1 + 20).clamp(y0, h - 1));
    Image::from_fn((x1 - x0 + 1) * 3, (y1 - y0 + 1) * 3, |x, y| {
        let (x, y) = (x0 + x / 3, y0 + y / 3);
        match (outline(mask, x, y), outline(truth, x, y)) {
            (true, true) => [255, 255, 0],
            (true, false) => [255, 0, 0],
            (false, true) => [0, 255, 0],
            _ => frame.color[(x, y)],
        }
    })
}

/// Observed surface in voxels of 3 mm; those seen twice count.
#[derive(Default)]
struct Fusion {
    cells: BTreeMap<[i32; 3], ([f32; 3], [f32; 3], f32)>,
}

impl Fusion {
    fn add(&mut self, frame: &RgbdFrame, mask: &Mask, cam_from_obj: &Isometry3<f64>) {
        let obj_from_cam: Isometry3<f32> = cam_from_obj.inverse().cast();
        let (w, h) = frame.depth.size();
        let at = |x: usize, y: usize| {
            let z = frame.depth[(x, y)];
            (z > 0.0 && mask[(x, y)] != 0).then(|| {
                Vector3::from(frame.intrinsics.unproject(x as f64, y as f64, f64::from(z)).map(|v| v as f32))
            })
        };
        for y in (3..h - 3).step_by(2) {
            for x in (3..w - 3).step_by(2) {
                let (Some(c), Some(l), Some(r), Some(t), Some(b)) =
                    (at(x, y), at(x - 3, y), at(x + 3, y), at(x, y - 3), at(x, y + 3))
                else {
                    continue;
                };
                let n = (b - t).cross(&(r - l));
                if (r - l).norm() > 0.03 || (b - t).norm() > 0.03 || n.norm() == 0.0 {
                    continue;
                }
                let p = obj_from_cam * Point3::from(c);
                let n = obj_from_cam.rotation * n.normalize();
                let n = if n.dot(&(obj_from_cam.rotation * c)) > 0.0 { -n } else { n };
                let key = [p.x, p.y, p.z].map(|v| (v / 0.003).floor() as i32);
                let cell = self.cells.entry(key).or_default();
                (0..3).for_each(|k| {
                    cell.0[k] += p[k];
                    cell.1[k] += n[k];
                });
                cell.2 += 1.0;
            }
        }
    }

    fn points(&self) -> Vec<SurfacePoint> {
        self.cells
            .values()
            .filter(|c| c.2 > 1.0)
            .map(|(p, n, count)| SurfacePoint {
                position: p.map(|v| v / count),
                normal: Vector3::from(*n).try_normalize(1e-6).map_or([0.0; 3], Into::into),
            })
            .collect()
    }
}
