//! Peak signal-to-noise ratio in held-out frames.

use std::path::Path;
use std::sync::Arc;

use anyhow::Context;
use bundlesdf::texture::TexturedMesh;
use nalgebra::Isometry3;
use rgbd_io::Image;
use rgbd_synth::{Gloss, Light, Sensor, Sequence, SequenceSpec, SynthFrame};
use serde::Serialize;

use super::input::beside;

/// What a drawn texture is compared with.
#[derive(Clone, Copy)]
pub(super) enum Target {
    /// The object's own colours: even light, no shine, no noise, no blur.
    Colours,
    /// The same in the video's light.
    Frames,
}

/// A comparison over the object's visible pixels in all held-out frames, but for the outermost, which the rendered
/// lens mixes with what is behind.
#[derive(Serialize)]
pub(super) struct Psnr {
    pub(super) db: f64,
    /// What the texture was multiplied by: how much light fell on the object can't be known from its pictures.
    pub(super) factor: f64,
    /// Decibels without this factor.
    pub(super) db_unscaled: f64,
    /// Share of the compared pixels that the mesh covers.
    pub(super) covered: f64,
}

/// The frames as `wanted` wants them to be seen.
pub(super) fn frames(video: &Sequence, frames: &[usize], wanted: Target) -> Vec<SynthFrame> {
    let truth = target(video, wanted);
    truth.iter().flat_map(|truth| frames.iter().map(|&i| truth.render(i))).collect()
}

/// The sequence as `target` wants it to be seen.
fn target(video: &Sequence, target: Target) -> Option<Sequence> {
    let spec = SequenceSpec { sensor: Sensor::perfect(), ..video.spec().clone() };
    let spec = match target {
        Target::Frames => spec,
        Target::Colours => {
            let matt = Gloss { strength: 0.0, exponent: 1, mirror: 0.0 };
            let object = Arc::new((*spec.object).clone().with_gloss(matt));
            let light = Light { ambient: 1.0, diffuse: 0.0, specular: 0.0, ..Light::default() };
            SequenceSpec { object, light, ..spec }
        }
    };
    Sequence::new(spec).ok()
}

pub(super) fn psnr(
    textured: &TexturedMesh,
    video: &Sequence,
    frames: &[SynthFrame],
    true_from_obj: &Isometry3<f64>,
    wanted: Target,
) -> Psnr {
    let (mut pairs, mut all) = (Vec::new(), 0usize);
    for seen in frames {
        let drawn = textured.render(
            &video.intrinsics(),
            seen.frame.color.size(),
            &(seen.cam_from_obj * true_from_obj),
        );
        for at in inner(seen) {
            all += 1;
            if drawn.depth[at] > 0.0 {
                let (a, b) = (drawn.color[at], seen.frame.color[at]);
                pairs.extend((0..3).map(|k| (f64::from(a[k]), f64::from(b[k]))));
            }
        }
    }
    let product: f64 = pairs.iter().map(|(a, b)| a * b).sum();
    let square: f64 = pairs.iter().map(|(a, _)| a * a).sum();
    let factor = match wanted {
        Target::Colours => product / square,
        Target::Frames => 1.0,
    };
    let db = |factor: f64| {
        let squares: f64 = pairs.iter().map(|(a, b)| (factor * a - b).powi(2)).sum();
        10.0 * (255.0f64.powi(2) * pairs.len() as f64 / squares).log10()
    };
    Psnr { db: db(factor), factor, db_unscaled: db(1.0), covered: pairs.len() as f64 / (3 * all) as f64 }
}

/// Pixels of the object whose neighbours are its pixels too.
pub(super) fn inner(seen: &SynthFrame) -> impl Iterator<Item = (usize, usize)> + '_ {
    let mask = &seen.visible_mask;
    let (width, height) = mask.size();
    let pixels = (1..height - 1).flat_map(move |y| (1..width - 1).map(move |x| (x, y)));
    pixels.filter(move |&(x, y)| (y - 1..=y + 1).all(|v| (x - 1..=x + 1).all(|u| mask[(u, v)] != 0)))
}

/// Draws up to four held-out frames beside the true colours.
pub(super) fn pictures(
    textured: &TexturedMesh,
    video: &Sequence,
    frames: &[usize],
    true_from_obj: &Isometry3<f64>,
    folder: &Path,
) -> anyhow::Result<()> {
    std::fs::create_dir_all(folder).with_context(|| format!("{} can't be made", folder.display()))?;
    let truth = target(video, Target::Colours).context("the sequence can't be rendered")?;
    for &i in frames.iter().step_by(frames.len().div_ceil(4).max(1)) {
        let seen = truth.render(i);
        let pose = seen.cam_from_obj * true_from_obj;
        let drawn = textured.render(&video.intrinsics(), seen.frame.color.size(), &pose);
        let mask = &seen.visible_mask;
        let (width, height) = mask.size();
        let cut = Image::from_fn(width, height, |x, y| {
            if mask[(x, y)] == 0 { [255; 3] } else { seen.frame.color[(x, y)] }
        });
        let cleared = Image::from_fn(width, height, |x, y| {
            if drawn.depth[(x, y)] == 0.0 { [255; 3] } else { drawn.color[(x, y)] }
        });
        let path = folder.join(format!("{}-{i}.png", video.name()));
        rgbd_io::write_png_rgb(&path, &beside(&cleared, &cut))?;
    }
    Ok(())
}
