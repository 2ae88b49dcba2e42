//! What is known about a sequence.

use super::ply::Mesh;
use anyhow::Context;
use eval_metrics::Camera;
use nalgebra::Isometry3;
use rgbd_io::{CustomFolder, CustomOptions, FrameSource, MaskSource};
use std::path::{Path, PathBuf};

/// True poses and mesh of the frames that a run uses.
pub(super) struct Truth {
    /// Names of the frames.
    pub(super) ids: Vec<String>,
    /// `cam_from_obj` per frame, where it is known.
    pub(super) poses: Vec<Option<Isometry3<f64>>>,
    /// The object's surface in the true object frame, metres.
    pub(super) mesh: Mesh,
    pub(super) camera: Camera,
}

impl Truth {
    pub(super) fn read(dir: &Path, stride: usize) -> anyhow::Result<Self> {
        let options = CustomOptions { masks: MaskSource::None, stride, ..CustomOptions::default() };
        let folder = CustomFolder::open(dir, &options)?;
        let ids: Vec<String> = (0..folder.len()).map(|i| folder.id(i).to_owned()).collect();
        let pose_dir = dir.join("gt_poses");
        let mut poses = Vec::with_capacity(ids.len());
        for id in &ids {
            let path = pose_dir.join(format!("{id}.txt"));
            poses.push(if path.exists() { Some(rgbd_io::poses::read_pose(&path)?) } else { None });
        }
        anyhow::ensure!(
            poses.iter().any(Option::is_some),
            "{} has no pose of any frame; true poses are named like the colour images",
            pose_dir.display()
        );
        let (k, (width, height)) = (folder.intrinsics(), folder.size());
        let camera = Camera { fx: k.fx, fy: k.fy, cx: k.cx, cy: k.cy, width, height };
        Ok(Self { ids, poses, mesh: read_obj(&first_obj(&dir.join("mesh"))?)?, camera })
    }
}

fn first_obj(folder: &Path) -> anyhow::Result<PathBuf> {
    let entries = std::fs::read_dir(folder)
        .with_context(|| format!("{} can't be listed; the true mesh belongs there", folder.display()))?;
    entries
        .filter_map(|entry| Some(entry.ok()?.path()))
        .filter(|path| path.extension().is_some_and(|e| e.eq_ignore_ascii_case("obj")))
        .min()
        .with_context(|| format!("{} has no .obj file; the true mesh belongs there", folder.display()))
}

/// All models of an OBJ file as one mesh of triangles.
fn read_obj(path: &Path) -> anyhow::Result<Mesh> {
    let options = tobj::LoadOptions { triangulate: true, ..Default::default() };
    // Materials are of no interest, missing ones are no error.
    let (models, _) =
        tobj::load_obj(path, &options).with_context(|| format!("{} isn't a readable OBJ", path.display()))?;
    let mut mesh = Mesh::default();
    for model in models {
        let base = u32::try_from(mesh.vertices.len())?;
        mesh.vertices.extend(model.mesh.positions.as_chunks::<3>().0.iter().map(|p| p.map(f64::from)));
        mesh.triangles
            .extend(model.mesh.indices.as_chunks::<3>().0.iter().map(|t| t.map(|i| i.saturating_add(base))));
    }
    anyhow::ensure!(!mesh.triangles.is_empty(), "{} has no faces", path.display());
    Ok(mesh)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_models_are_merged_and_triangulated() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("two.obj");
        let text = "mtllib missing.mtl\no a\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n\
                    o b\nv 0 0 5\nv 1 0 5\nv 1 1 5\nf 5 6 7\n";
        std::fs::write(&path, text).unwrap();
        let mesh = read_obj(&first_obj(dir.path()).unwrap()).unwrap();
        assert_eq!((mesh.vertices.len(), mesh.triangles.len()), (7, 3));
        let last = mesh.triangles[2].map(|i| mesh.vertices[i as usize][2]);
        assert_eq!(last, [5.0; 3]);
        std::fs::write(&path, "v 0 0 0\n").unwrap();
        assert!(read_obj(&path).is_err());
    }
}
