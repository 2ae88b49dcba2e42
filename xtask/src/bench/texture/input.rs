//! What a texture is made from.

use std::path::Path;

use bundlesdf::{OutputFolder, export, texture::View};
use marching_cubes::TriMesh;
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
use rgbd_io::Image;
use rgbd_synth::Sequence;

/// Faces of a true mesh: about those of a reconstructed one.
const FACES: usize = 20_000;

/// What of a run is exchanged for the truth, to see what each costs.
#[derive(Clone, Copy)]
pub(super) struct Truth {
    pub(super) mesh: bool,
    pub(super) poses: bool,
}

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

    /// The mesh, keyframes and masks of a finished run on the sequence, the mesh or the poses exchanged for the true
    /// ones as asked.
    pub(super) fn of_run(video: &Sequence, results: &Path, truth: Truth) -> anyhow::Result<Self> {
        let folder = OutputFolder::open(results)?;
        let (mesh, views) = export::load(&folder)?;
        let mesh = export::clean(&mesh, &views, &export::ExportOptions::default())?;
        let keyframes = folder.read_keyframes()?;
        let used: Vec<usize> = keyframes.iter().map(|k| k.index).collect();
        anyhow::ensure!(views.len() == used.len(), "the run has more keyframes than a texture takes");
        let poses = views
            .iter()
            .zip(&used)
            .map(|(view, &i)| video.cam_from_obj(i).inverse() * view.obj_from_cam.inverse());
        let true_from_obj = mean(&poses.collect::<Vec<_>>(), &mesh);
        let obj_from_true = true_from_obj.inverse();
        let mut input = Self { mesh, views, used, true_from_obj };
        if truth.mesh {
            let moved = obj_from_true.to_homogeneous();
            let rows = std::array::from_fn(|r| std::array::from_fn(|c| moved[(r, c)]));
            input.mesh = video.mesh().simplified(FACES).transformed_by(&rows);
        }
        if truth.poses {
            for (view, &i) in input.views.iter_mut().zip(&input.used) {
                view.obj_from_cam = obj_from_true * video.cam_from_obj(i).inverse();
            }
        }
        Ok(input)
    }

    /// `count` frames far from those that were used.
    pub(super) fn held_out(&self, frames: usize, count: usize) -> Vec<usize> {
        let mut free: Vec<usize> = (0..frames).filter(|i| !self.used.contains(i)).collect();
        let step = free.len().div_ceil(count.max(1)).max(1);
        free = free.into_iter().skip(step / 2).step_by(step).collect();
        free
    }
}

/// The mean of motions that differ little, as they move the mesh: the object frame of a run is its own, so that only
/// what differs between its poses is wrong.
fn mean(motions: &[Isometry3<f64>], mesh: &TriMesh) -> Isometry3<f64> {
    let Some(first) = motions.first() else { return Isometry3::identity() };
    let count = motions.len() as f64;
    let sum = mesh.vertices.iter().fold(Vector3::zeros(), |s, v| s + Vector3::from(v.map(f64::from)));
    let middle = Point3::from(sum / mesh.vertices.len().max(1) as f64);
    let turn = motions.iter().map(|m| (m.rotation * first.rotation.inverse()).scaled_axis());
    let rotation = UnitQuaternion::new(turn.sum::<Vector3<f64>>() / count) * first.rotation;
    let place = motions.iter().map(|m| (m * middle).coords).sum::<Vector3<f64>>() / count;
    Isometry3::from_parts(Translation3::from(place - rotation * middle.coords), rotation)
}

/// Two images of one height side by side.
pub(super) fn beside(a: &Image<[u8; 3]>, b: &Image<[u8; 3]>) -> Image<[u8; 3]> {
    let (width, height) = a.size();
    Image::from_fn(2 * width, height, |x, y| if x < width { a[(x, y)] } else { b[(x - width, y)] })
}
