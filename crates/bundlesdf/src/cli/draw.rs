//! `bundlesdf draw`.

use std::{borrow::Cow, path::PathBuf, process::ExitCode};

use anyhow::Context;
use bundlesdf::{
    OutputFolder, RunReport,
    draw::{Animation, Overlay, View},
};
use rayon::prelude::*;
use rgbd_io::{FrameSource, Image, Mask, write_png_rgb};

use super::{DrawArgs, EXIT_INTERRUPTED, log::Log, run::print, stop_flag};

/// Frames that are read and drawn at once.
const BATCH: usize = 16;

/// Draws over the frames of a finished run.
pub(super) fn draw(args: &DrawArgs, log: Log) -> anyhow::Result<ExitCode> {
    let folder = OutputFolder::open(&args.results)?;
    let report = folder.read_report()?;
    let input = report.input.as_ref().context(
        "run.json doesn't say where the frames came from (a program fed them); draw in that program instead",
    )?;
    let source = input.open_without_masks()?;
    let artist =
        Artist { args, overlay: Overlay::open(&folder)?, folder: &folder, report: &report, source: &source };
    let mut film = args.video.as_ref().map(|path| Animation::create(path, args.fps)).transpose()?;
    if film.is_none() {
        let drawn = folder.drawn();
        std::fs::create_dir_all(&drawn).with_context(|| format!("{}: can't be created", drawn.display()))?;
    }
    let stop = stop_flag();
    let frames: Vec<usize> = (0..report.frames.len()).step_by(args.every as usize).collect();
    let (mut count, mut stopped) = (0, false);
    for batch in frames.chunks(BATCH) {
        if stop.load(std::sync::atomic::Ordering::Relaxed) {
            stopped = true;
            break;
        }
        let pictures: Vec<_> = batch.par_iter().map(|index| artist.picture(*index)).collect();
        for (index, picture) in batch.iter().zip(pictures) {
            let picture = match picture {
                Ok(picture) => picture,
                // The other frames are worth having.
                Err(error) => {
                    log.warning(&format!("{error}; the frame is left out"));
                    continue;
                }
            };
            match &mut film {
                Some(film) => film.push(&picture)?,
                None => write_png_rgb(&artist.png(*index), &picture)?,
            }
            count += 1;
        }
    }
    if let Some(film) = film {
        film.finish()?;
    }
    let place = args.video.clone().unwrap_or_else(|| folder.drawn());
    print(&format!("{count} frames in {}\n", place.display()));
    Ok(if stopped { ExitCode::from(EXIT_INTERRUPTED) } else { ExitCode::SUCCESS })
}

struct Artist<'a> {
    args: &'a DrawArgs,
    overlay: Overlay,
    folder: &'a OutputFolder,
    report: &'a RunReport,
    source: &'a dyn FrameSource,
}

impl Artist<'_> {
    fn png(&self, index: usize) -> PathBuf {
        self.folder.drawn().join(format!("{}.png", self.report.frames[index].id))
    }

    fn picture(&self, index: usize) -> Result<Image<[u8; 3]>, rgbd_io::Error> {
        let entry = &self.report.frames[index];
        let pose = self.folder.read_final_pose(&entry.id)?;
        let frame = self.source.frame(index)?;
        let mask: Option<Mask> =
            if self.args.what.mask { self.folder.read_mask(&entry.id).ok() } else { None };
        let intrinsics = frame.intrinsics;
        let (color, intrinsics) = match self.reduction(frame.color.width()) {
            1 => (Cow::Borrowed(&frame.color), intrinsics),
            factor => {
                let small = reduced(&frame.color, factor);
                let share = 1.0 / factor as f64;
                (Cow::Owned(small), intrinsics.scaled(share, share))
            }
        };
        let view =
            View { color: &color, intrinsics, cam_from_obj: pose, status: entry.status, mask: mask.as_ref() };
        Ok(self.overlay.draw(&view, self.args.what))
    }

    /// By how much a GIF's pictures are made smaller.
    fn reduction(&self, width: usize) -> usize {
        let gif = self
            .args
            .video
            .as_ref()
            .is_some_and(|p| p.extension().is_some_and(|e| e.eq_ignore_ascii_case("gif")));
        if gif { width.div_ceil(Animation::GIF_WIDTH).max(1) } else { 1 }
    }
}

/// Blocks of `factor` times `factor` pixels averaged.
fn reduced(image: &Image<[u8; 3]>, factor: usize) -> Image<[u8; 3]> {
    let (width, height) = ((image.width() / factor).max(1), (image.height() / factor).max(1));
    Image::from_fn(width, height, |x, y| {
        let mut sums = [0_usize; 3];
        let mut count = 0;
        for row in 0..factor {
            for pixel in image.get(x * factor, y * factor + row).map_or(&[][..], |_| {
                let line = image.row(y * factor + row);
                &line[x * factor..((x + 1) * factor).min(line.len())]
            }) {
                (0..3).for_each(|c| sums[c] += usize::from(pixel[c]));
                count += 1;
            }
        }
        sums.map(|s| s.checked_div(count).unwrap_or(0) as u8)
    })
}
