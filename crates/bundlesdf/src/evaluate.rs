//! Scores a run against exact truth.

use eval_metrics::{
    Camera, MeshProtocol, MeshRef, ModelPoints, keep_faces, score_mesh, score_poses, visible_faces,
};
use marching_cubes::TriMesh;
use nalgebra::Isometry3;
use rgbd_io::Intrinsics;
use serde::{Deserialize, Serialize};

/// How good a run is; the content of `eval.json`, and of `eval_refined.json` after a refinement.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Scores {
    /// Area under the ADD curve from 0 to 0.1 m (percent).
    pub add: f64,
    /// Area under the ADD-S curve from 0 to 0.1 m (percent).
    pub add_s: f64,
    /// Chamfer distance to the surface that the video shows (centimetres); `None` without a mesh.
    pub cd_cm: Option<f64>,
    /// Frames with the status `lost`; after a refinement those that had no say in their pose.
    pub lost: usize,
}

/// The truth of a sequence.
#[derive(Clone, Debug)]
pub struct Truth<'a> {
    /// `cam_from_obj` per frame.
    pub cam_from_obj: &'a [Isometry3<f64>],
    /// The object's surface.
    pub mesh: &'a TriMesh,
    /// The camera.
    pub intrinsics: Intrinsics,
    /// Width and height of the images.
    pub size: (usize, usize),
}

/// Compares tracked poses (`cam_from_obj` per frame) and the reconstructed mesh with the truth. The object frames are
/// aligned at the first frame, nothing else is (paper supplement, metrics).
#[must_use]
pub fn evaluate(poses: &[Isometry3<f64>], mesh: Option<&TriMesh>, lost: usize, truth: &Truth<'_>) -> Scores {
    const MAX_ERROR: f64 = 0.1;
    /// Frames whose view decides what was visible: neighbours show the same.
    const VIEWS: usize = 40;
    let predicted: Vec<_> = poses.iter().copied().map(Some).collect();
    let exact: Vec<_> = truth.cam_from_obj.iter().copied().map(Some).collect();
    let vertices = doubles(&truth.mesh.vertices);
    let Some(model) = ModelPoints::new(vertices.clone()) else {
        return Scores { add: 0.0, add_s: 0.0, cd_cm: None, lost };
    };
    let scores = score_poses(&predicted, &exact, &model, MAX_ERROR);
    let chamfer = mesh.and_then(|mesh| {
        let gt_from_pred = eval_metrics::alignment(&predicted, &exact)?.inverse();
        let k = &truth.intrinsics;
        let camera =
            Camera { fx: k.fx, fy: k.fy, cx: k.cx, cy: k.cy, width: truth.size.0, height: truth.size.1 };
        let step = truth.cam_from_obj.len().div_ceil(VIEWS).max(1);
        let views: Vec<_> = truth.cam_from_obj.iter().step_by(step).copied().collect();
        let all = MeshRef::new(&vertices, &truth.mesh.triangles);
        let seen = keep_faces(&truth.mesh.triangles, &visible_faces(all, &views, &camera));
        let predicted_vertices = doubles(&mesh.vertices);
        let predicted_mesh = MeshRef::new(&predicted_vertices, &mesh.triangles);
        let protocol = MeshProtocol::paper_text();
        score_mesh(predicted_mesh, MeshRef::new(&vertices, &seen), &gt_from_pred, &protocol)
    });
    Scores {
        add: scores.add_auc,
        add_s: scores.add_s_auc,
        cd_cm: chamfer.map(|c| c.distance() * 100.0),
        lost,
    }
}

fn doubles(points: &[[f32; 3]]) -> Vec<[f64; 3]> {
    points.iter().map(|p| p.map(f64::from)).collect()
}
