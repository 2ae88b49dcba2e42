//! `bundlesdf mask`: the first frame's mask from a box or a few points.

use std::{path::PathBuf, process::ExitCode};

use anyhow::Context;
use clap::Args;
use mask_tracker::{Hints, first_mask};
use rgbd_io::{CustomFolder, CustomOptions, FrameSource, Image, Mask, MaskSource, RgbdFrame};

use super::run::print;

#[derive(Args, Debug)]
pub(super) struct MaskArgs {
    /// Folder of the video.
    input: PathBuf,
    /// A box around the object, pixels; a little too large is better than too small.
    #[arg(long = "box", value_name = "X,Y,W,H", value_parser = rectangle, required_unless_present = "points")]
    rectangle: Option<Rectangle>,
    /// Points on the object, pixels.
    #[arg(long, value_name = "X,Y;X,Y...", value_parser = points)]
    points: Option<Points>,
    /// Points that are not on the object.
    #[arg(long = "not", value_name = "X,Y;X,Y...", value_parser = points)]
    others: Option<Points>,
    /// Metres per unit of the depth files.
    #[arg(long, default_value_t = 0.001, value_name = "METRES")]
    depth_scale: f64,
    /// Picture of the result to look at.
    #[arg(long, value_name = "FILE", default_value = "mask-preview.png")]
    preview: PathBuf,
    /// Replace a mask that is already there.
    #[arg(long)]
    force: bool,
}

#[derive(Clone, Debug)]
struct Rectangle([f32; 4]);

#[derive(Clone, Debug)]
struct Points(Vec<[f32; 2]>);

fn numbers<const N: usize>(text: &str) -> Result<[f32; N], String> {
    let values: Vec<f32> = text
        .split(',')
        .map(|v| v.trim().parse().map_err(|_| format!("\"{}\" is no number", v.trim())))
        .collect::<Result<_, _>>()?;
    if values.iter().any(|v| !v.is_finite()) {
        return Err("not a finite number".into());
    }
    values.try_into().map_err(|v: Vec<f32>| format!("needs {N} numbers with commas between, not {}", v.len()))
}

fn rectangle(text: &str) -> Result<Rectangle, String> {
    let rectangle: [f32; 4] = numbers(text)?;
    if rectangle[2] < 4.0 || rectangle[3] < 4.0 {
        return Err("width and height come third and fourth, at least 4 pixels each".into());
    }
    Ok(Rectangle(rectangle))
}

fn points(text: &str) -> Result<Points, String> {
    text.split(';').filter(|p| !p.trim().is_empty()).map(numbers).collect::<Result<_, _>>().map(Points)
}

/// Writes the mask where `bundlesdf run` looks for it, and a picture.
pub(super) fn mask(args: &MaskArgs) -> anyhow::Result<ExitCode> {
    let options =
        CustomOptions { masks: MaskSource::None, depth_scale: args.depth_scale, ..CustomOptions::default() };
    let source = CustomFolder::open(&args.input, &options)?;
    let frame = source.frame(0)?;
    let folder = args.input.join("masks");
    let path = folder.join(format!("{}.png", frame.id));
    anyhow::ensure!(
        args.force || !path.exists(),
        "{}: is already there; pass --force to replace it",
        path.display()
    );
    let list = |points: &Option<Points>| points.as_ref().map(|p| p.0.clone()).unwrap_or_default();
    let hints = Hints {
        rectangle: args.rectangle.as_ref().map(|r| r.0),
        object: list(&args.points),
        background: list(&args.others),
    };
    let (width, height) = frame.color.size();
    let mask = first_mask(&frame, &hints).with_context(|| {
        format!("no object found there: box and points are pixels of the {width}x{height} image, from its top left")
    })?;
    std::fs::create_dir_all(&folder)
        .with_context(|| format!("{} can't be made; check its permissions", folder.display()))?;
    rgbd_io::write_png_mask(&path, &mask)?;
    rgbd_io::write_png_rgb(&args.preview, &preview(&frame, &mask))?;
    let area = mask.pixels().iter().filter(|m| **m != 0).count();
    print(&format!("mask       {} ({area} pixels)\npreview    {}\n", path.display(), args.preview.display()));
    Ok(ExitCode::SUCCESS)
}

/// The image, dark where the background is, with the mask's outline.
fn preview(frame: &RgbdFrame, mask: &Mask) -> Image<[u8; 3]> {
    let (w, h) = mask.size();
    let on = |x: usize, y: usize| mask.get(x, y).is_some_and(|m| *m != 0);
    Image::from_fn(w, h, |x, y| {
        let c = frame.color[(x, y)];
        let inner = x > 0 && y > 0 && on(x - 1, y) && on(x + 1, y) && on(x, y - 1) && on(x, y + 1);
        match (on(x, y), inner) {
            (true, true) => c,
            (true, false) => [255, 40, 40],
            _ => c.map(|v| v / 3),
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn boxes_and_points_are_read() {
        assert_eq!(rectangle("1,2, 30,40").unwrap().0, [1.0, 2.0, 30.0, 40.0]);
        assert_eq!(points("1,2;3,4;").unwrap().0, [[1.0, 2.0], [3.0, 4.0]]);
        for wrong in ["1,2,3", "a,2,30,40", "1,2,0,40", "nan,1,20,20"] {
            assert!(rectangle(wrong).is_err(), "{wrong}");
        }
        assert!(points("1,2;3").is_err());
    }
}
