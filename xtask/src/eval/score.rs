//! Scores the results of one job.

use super::job::{Asked, read_json};
use super::method::Method;
use super::video::{Masks, Place};
use anyhow::Context;
use eval_metrics::{
    BOUNDARY_TOLERANCE, Camera, MaskRef, MeshProtocol, MeshRef, ModelPoints, alignment, boundary_f,
    keep_faces, normal_error, region_similarity, score_mesh, score_poses, visible_faces,
};
use nalgebra::Isometry3;
use rgbd_io::FrameSource;
use rgbd_io::datasets::{DatasetSequence, ModelMesh, SequenceTruth};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Frames whose views decide which part of the true surface the video shows: neighbours show the same.
const MAX_VIEWS: usize = 300;

/// Surface further from the true one than this (metres) has no normal to be compared with.
const NORMALS_REACH: f64 = 0.01;

/// The content of `score.json`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Score {
    /// Area under the ADD-S recall curve, percent.
    pub(super) add_s: f64,
    /// Area under the ADD recall curve, percent.
    pub(super) add: f64,
    /// Chamfer distance to the surface that the video shows, as the paper's text says, centimetres.
    pub(super) cd_cm: Option<f64>,
    /// The same after registration by ICP, as the published numbers were computed.
    pub(super) cd_icp_cm: Option<f64>,
    /// Without registration, the reconstruction culled to the visible surface as well.
    pub(super) cd_seen_cm: Option<f64>,
    /// Median angle between the normals of that part and the true ones, degrees.
    pub(super) normals_deg: Option<f64>,
    /// Number of frames that the method reported as lost.
    pub(super) lost: usize,
    /// Median rate of the tracker, frames per second.
    pub(super) hz: Option<f64>,
    /// Median time of a field round, seconds.
    pub(super) round_s: Option<f64>,
    /// Time of the whole run, seconds.
    pub(super) wall_s: Option<f64>,
    /// Mean region similarity of the masks after the first, percent; `None` where the true ones were given.
    pub(super) region_j: Option<f64>,
    /// Mean contour accuracy of the same masks, percent.
    pub(super) boundary_f: Option<f64>,
    pub(super) errors: Errors,
}

/// Errors of the frames with a true pose; `None` where the predicted one is missing or not finite.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Errors {
    /// Number of the frame in the video, after the stride.
    pub(super) frames: Vec<usize>,
    /// Metres.
    pub(super) add: Vec<Option<f64>>,
    /// Metres.
    pub(super) add_s: Vec<Option<f64>>,
    /// Radians.
    pub(super) rotation: Vec<Option<f64>>,
    /// Metres.
    pub(super) translation: Vec<Option<f64>>,
}

/// The part of `run.json` that is reported.
#[derive(Default, Deserialize)]
#[serde(default)]
struct RunFile {
    frames: Vec<FrameEntry>,
    field: FieldEntry,
    tracking_hz_median: Option<f64>,
    wall_s: Option<f64>,
}

#[derive(Deserialize)]
struct FrameEntry {
    status: String,
}

#[derive(Default, Deserialize)]
#[serde(default)]
struct FieldEntry {
    rounds: usize,
    ms_per_round_median: Option<f64>,
}

/// What is known about a sequence.
struct Truth {
    ids: Vec<String>,
    known: SequenceTruth,
    mesh: ModelMesh,
    camera: Camera,
}

impl Truth {
    fn read(frames: &DatasetSequence) -> anyhow::Result<Self> {
        let known = frames.truth()?;
        let mesh = known.read_model()?.context("the sequence knows no object")?;
        anyhow::ensure!(
            known.cam_from_obj.iter().any(Option::is_some),
            "{} has no true pose of any frame",
            frames.path().display()
        );
        let (k, (width, height)) = (frames.intrinsics(), frames.size());
        let camera = Camera { fx: k.fx, fy: k.fy, cx: k.cx, cy: k.cy, width, height };
        let ids = (0..frames.len()).map(|i| frames.id(i).to_owned()).collect();
        Ok(Self { ids, known, mesh, camera })
    }

    /// The part of the true surface that the video shows: the dataset's own, where it has one.
    fn seen(&self) -> anyhow::Result<ModelMesh> {
        if let Some(path) = &self.known.visible_model {
            return Ok(ModelMesh::read(path)?);
        }
        let views: Vec<_> = self.known.cam_from_obj.iter().flatten().copied().collect();
        let views: Vec<_> = views.iter().step_by(views.len().div_ceil(MAX_VIEWS).max(1)).copied().collect();
        let seen = visible_faces(by_ref(&self.mesh), &views, &self.camera);
        let triangles = keep_faces(&self.mesh.triangles, &seen);
        Ok(ModelMesh { vertices: self.mesh.vertices.clone(), triangles })
    }
}

fn by_ref(mesh: &ModelMesh) -> MeshRef<'_> {
    MeshRef::new(&mesh.vertices, &mesh.triangles)
}

/// Scores the results in `folder` (`ob_in_cam/`, or `ob_in_cam_refined/` for [`Method::Refined`], `masks/`, `mesh.ply`,
/// `run.json`).
pub(super) fn score(asked: &Asked, folder: &Path) -> anyhow::Result<Score> {
    let run: RunFile = read_json(&folder.join("run.json"))?;
    let truth = Truth::read(&asked.place.open_unmasked()?)?;
    let dir = if asked.method == Method::Refined { "ob_in_cam_refined" } else { "ob_in_cam" };
    let poses = read_poses(&truth, &folder.join(dir));
    let model = ModelPoints::from_mesh(by_ref(&truth.mesh)).context("the true mesh has no surface")?;
    let scores = score_poses(&poses, &truth.known.cam_from_obj, &model, asked.place.benchmark.max_error());
    let finite = |errors: Vec<f64>| errors.into_iter().map(|e| e.is_finite().then_some(e)).collect();
    let mut score = Score {
        add_s: scores.add_s_auc,
        add: scores.add_auc,
        lost: run.frames.iter().filter(|f| f.status == "lost").count(),
        hz: run.tracking_hz_median,
        round_s: run
            .field
            .ms_per_round_median
            .filter(|ms| run.field.rounds > 0 && *ms > 0.0)
            .map(|ms| ms / 1e3),
        wall_s: run.wall_s,
        errors: Errors {
            frames: scores.frames,
            add: finite(scores.add_errors),
            add_s: finite(scores.add_s_errors),
            rotation: finite(scores.rotation_errors),
            translation: finite(scores.translation_errors),
        },
        ..Score::default()
    };
    let mesh_path = folder.join("mesh.ply");
    if mesh_path.exists() {
        score_surface(&mut score, &ModelMesh::read(&mesh_path)?, &truth, &poses)?;
    }
    if asked.masks != Masks::Given {
        score_masks(&mut score, &asked.place, folder);
    }
    Ok(score)
}

/// The predicted pose of each frame of the truth; a file that is missing or unusable is a missing pose.
fn read_poses(truth: &Truth, dir: &Path) -> Vec<Option<Isometry3<f64>>> {
    truth.ids.iter().map(|id| rgbd_io::poses::read_pose(&dir.join(format!("{id}.txt"))).ok()).collect()
}

fn score_surface(
    score: &mut Score,
    mesh: &ModelMesh,
    truth: &Truth,
    poses: &[Option<Isometry3<f64>>],
) -> anyhow::Result<()> {
    let Some(pred_from_gt) = alignment(poses, &truth.known.cam_from_obj) else { return Ok(()) };
    let gt_from_pred = pred_from_gt.inverse();
    let seen = truth.seen()?;
    let centimetres = |pred: MeshRef<'_>, protocol: MeshProtocol| {
        score_mesh(pred, by_ref(&seen), &gt_from_pred, &protocol).map(|chamfer| chamfer.distance() * 100.0)
    };
    score.cd_cm = centimetres(by_ref(mesh), MeshProtocol::paper_text());
    score.cd_icp_cm = centimetres(by_ref(mesh), MeshProtocol::authors_script());
    let views: Vec<_> = truth.known.cam_from_obj.iter().flatten().map(|view| view * gt_from_pred).collect();
    let views: Vec<_> = views.iter().step_by(views.len().div_ceil(MAX_VIEWS).max(1)).copied().collect();
    let pred_seen = keep_faces(&mesh.triangles, &visible_faces(by_ref(mesh), &views, &truth.camera));
    let pred_seen = MeshRef::new(&mesh.vertices, &pred_seen);
    score.cd_seen_cm = centimetres(pred_seen, MeshProtocol::paper_text());
    score.normals_deg =
        normal_error(pred_seen, by_ref(&seen), &gt_from_pred, NORMALS_REACH).map(f64::to_degrees);
    Ok(())
}

/// Compares the masks that were used with the true ones, where the dataset has them. The first was given.
fn score_masks(score: &mut Score, place: &Place, folder: &Path) {
    let Ok(frames) = place.open_true_masks() else { return };
    let (mut region, mut boundary) = (Vec::new(), Vec::new());
    for index in 1..frames.len() {
        let Some(truth) = frames.frame(index).ok().and_then(|f| f.mask) else { continue };
        let used = rgbd_io::read_mask(&folder.join("masks").join(format!("{}.png", frames.id(index))));
        // A frame without a mask was tracked with an empty one.
        let empty = || truth.map(|_| 0);
        let used = used.ok().filter(|m| m.size() == truth.size()).unwrap_or_else(empty);
        let by_ref = |m| MaskRef::new(m, truth.width());
        let (Some(used), Some(real)) = (by_ref(used.pixels()), by_ref(truth.pixels())) else { continue };
        region.extend(region_similarity(used, real));
        boundary.extend(boundary_f(used, real, BOUNDARY_TOLERANCE));
    }
    let mean = |v: &[f64]| (!v.is_empty()).then(|| 100.0 * v.iter().sum::<f64>() / v.len() as f64);
    (score.region_j, score.boundary_f) = (mean(&region), mean(&boundary));
}

#[cfg(test)]
#[path = "score_tests.rs"]
mod tests;
