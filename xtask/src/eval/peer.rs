//! Open3D's odometry and fusion, as a method beside ours: the frames go to a script, its poses and mesh come back.

use std::path::Path;
use std::time::Instant;

use anyhow::Context;
use bundlesdf::{OutputFolder, Status};
use rgbd_io::{CustomWriter, FrameSource, Image, Intrinsics, RgbdFrame};
use serde::Deserialize;

use super::job::read_json;
use super::track::{BaselineFrame, BaselineReport};
use super::video::Video;

/// From the workspace's root.
const SCRIPT: &str = "xtask/peers/open3d_odometry.py";

/// What the script tells.
#[derive(Deserialize)]
struct Told {
    /// Of each frame, reading it not included.
    seconds: Vec<f64>,
    tracked: Vec<bool>,
}

/// Whether there is a Python with Open3D.
pub(super) fn has_open3d(python: Option<&Path>) -> bool {
    python.is_some_and(|python| crate::python::has(python, "open3d"))
}

/// Runs the script on the masked frames of `video` and fills `out`.
pub(super) fn run(
    python: Option<&Path>,
    video: &Video,
    out: &OutputFolder,
    spacing: f32,
) -> anyhow::Result<()> {
    let python = python.context("the method open3d needs --peer PYTHON")?;
    let start = Instant::now();
    let (frames, found) = (out.path().join("peer_frames"), out.path().join("peer"));
    let ids = write_frames(video, out, &frames)?;
    let spacing = spacing.to_string();
    let arguments = [frames.as_os_str(), found.as_os_str(), spacing.as_ref()];
    crate::python::output(python, Path::new(SCRIPT), &arguments)?;
    let told: Told = read_json(&found.join("peer.json"))?;
    for (index, id) in ids.iter().enumerate() {
        let pose = rgbd_io::poses::read_pose(&found.join("ob_in_cam").join(format!("{index:06}.txt")))?;
        out.write_pose(id, &pose)?;
    }
    let mesh = found.join("mesh.ply");
    if mesh.is_file() {
        std::fs::rename(&mesh, out.path().join("mesh.ply"))?;
    }
    for folder in [frames, found] {
        std::fs::remove_dir_all(folder)?;
    }
    let status = |tracked: bool| if tracked { Status::Tracked } else { Status::Lost };
    let frames = ids.into_iter().zip(&told.tracked);
    let frames = frames.map(|(id, tracked)| BaselineFrame { id, status: status(*tracked) }).collect();
    let mut seconds = told.seconds;
    seconds.sort_by(f64::total_cmp);
    let median = seconds.get(seconds.len() / 2).copied().unwrap_or(0.0);
    let tracking_hz_median = if median > 0.0 { 1.0 / median } else { 0.0 };
    let wall_s = start.elapsed().as_secs_f64();
    Ok(out.write_json("run.json", &BaselineReport { frames, tracking_hz_median, wall_s })?)
}

/// Writes every frame with depth on the object alone; a frame that can't be read, or has no mask, shows nothing.
fn write_frames(video: &Video, out: &OutputFolder, folder: &Path) -> anyhow::Result<Vec<String>> {
    let _ = std::fs::remove_dir_all(folder);
    let mut writer: Option<(CustomWriter, Intrinsics, (usize, usize))> = None;
    let mut ids = Vec::new();
    for index in 0..video.len() {
        let id = video.id(index).to_owned();
        let frame = match video.frame(index) {
            Ok(frame) => frame,
            Err(error) if index == 0 => return Err(error.into()),
            Err(error) => {
                eprintln!("warning: {error}; the frame counts as empty");
                let (_, intrinsics, (width, height)) = writer.as_ref().context("no frame can be read")?;
                RgbdFrame {
                    color: Image::filled(*width, *height, [0; 3]),
                    depth: Image::filled(*width, *height, 0.0),
                    mask: None,
                    intrinsics: *intrinsics,
                    id: id.clone(),
                }
            }
        };
        if let Some(mask) = &frame.mask {
            out.write_mask(&id, mask)?;
        }
        if writer.is_none() {
            let created = CustomWriter::create(folder, &frame.intrinsics)?;
            writer = Some((created, frame.intrinsics, frame.color.size()));
        }
        if let Some((writer, ..)) = &writer {
            // Numbered, so that the script reads them in the video's order.
            writer.write_frame(&format!("{index:06}"), &frame.color, &masked(&frame), None)?;
        }
        ids.push(id);
    }
    Ok(ids)
}

/// Depth where the mask is, 0 elsewhere.
fn masked(frame: &RgbdFrame) -> Image<f32> {
    let (width, height) = frame.depth.size();
    Image::from_fn(width, height, |x, y| {
        let on = frame.mask.as_ref().and_then(|m| m.get(x, y)).is_some_and(|m| *m != 0);
        frame.depth.get(x, y).copied().filter(|_| on).unwrap_or(0.0)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_python_is_no_peer() {
        assert!(!has_open3d(None));
        assert!(!has_open3d(Some(Path::new("no-such-python"))));
    }
}
