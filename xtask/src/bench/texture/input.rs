//! What a texture is made from.

use std::path::Path;

use bundlesdf::{OutputFolder, export, texture::View};
use marching_cubes::TriMesh;
use nalgebra::Isometry3;
use rgbd_io::Image;
use rgbd_synth::Sequence;

/// Faces of a true mesh: about those of a reconstructed one.
const FACES: usize = 20_000;

/// Mesh and views in one frame.
pub(super) struct Input {
    pub(super) mesh: TriMesh,
    pub(super) views: Vec<View>,
    /// The frames that the views are.
    used: Vec<usize>,
    /// From the mesh's frame to that of the sequence's object.
    pub(super) true_from_obj: Isometry3<f64>,
}

impl Input {
    /// The true mesh, poses and masks, with `count` frames as the camera saw them.
    pub(super) fn truth(video: &Sequence, count: usize) -> Self {
        let count = count.clamp(1, video.len());
        let used: Vec<usize> = (0..count).map(|i| (2 * i + 1) * video.len() / (2 * count)).collect();
        let view = |&i: &usize| {
            let seen = video.render(i);
            View {
                color: seen.frame.color,
                depth: seen.frame.depth,
                mask: seen.visible_mask,
                intrinsics: video.intrinsics(),
                obj_from_cam: seen.cam_from_obj.inverse(),
            }
        };
        let views = used.iter().map(view).filter(|v| v.mask.pixels().iter().any(|m| *m != 0)).collect();
        Self { mesh: video.mesh().simplified(FACES), views, used, true_from_obj: Isometry3::identity() }
    }

    /// The mesh, keyframes and masks of a finished run on the sequence.
    pub(super) fn of_run(video: &Sequence, results: &Path) -> anyhow::Result<Self> {
        let folder = OutputFolder::open(results)?;
        let (mesh, views) = export::load(&folder)?;
        let mesh = export::clean(&mesh, &views, &export::ExportOptions::default())?;
        let used = folder.read_keyframes()?.iter().map(|k| k.index).collect();
        let first = folder.read_report()?.frames.first().map(|f| f.id.clone()).unwrap_or_default();
        let cam_from_obj = folder.read_pose(&first)?;
        Ok(Self { mesh, views, used, true_from_obj: video.cam_from_obj(0).inverse() * cam_from_obj })
    }

    /// `count` frames far from those that were used.
    pub(super) fn held_out(&self, frames: usize, count: usize) -> Vec<usize> {
        let mut free: Vec<usize> = (0..frames).filter(|i| !self.used.contains(i)).collect();
        let step = free.len().div_ceil(count.max(1)).max(1);
        free = free.into_iter().skip(step / 2).step_by(step).collect();
        free
    }
}

/// Two images of one height side by side.
pub(super) fn beside(a: &Image<[u8; 3]>, b: &Image<[u8; 3]>) -> Image<[u8; 3]> {
    let (width, height) = a.size();
    Image::from_fn(2 * width, height, |x, y| if x < width { a[(x, y)] } else { b[(x - width, y)] })
}
