//! `run.json` and `keyframes.json`: what a run did, for programs.

use marching_cubes::TriMesh;
use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion};
use neural_field::StepLosses;
use serde::{Deserialize, Serialize};

use crate::{
    config::{Config, Schedule},
    diagnostics::Warning,
    field_worker::FieldUpdate,
    input::VideoInput,
    pool::Keyframe,
    refine::RefinedKeyframe,
    tracker::{FieldSummary, FrameResult, HeldMotion, Status},
    video::VideoRun,
};

/// The content of `run.json`.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct RunReport {
    /// Version of this crate.
    pub version: String,
    /// Where the frames came from; `None` when a program fed them.
    #[serde(default)]
    pub input: Option<VideoInput>,
    /// How the tracker and the field took turns.
    pub schedule: Schedule,
    /// The config that was used, defaults included.
    pub config: Config,
    /// One entry per frame.
    pub frames: Vec<FrameReport>,
    /// Number of keyframes.
    pub keyframes: usize,
    /// What the field did.
    pub field: FieldSummary,
    /// Frames per second of the tracker, from the median time of a frame; waiting for the field doesn't count.
    pub tracking_hz_median: f64,
    /// Wall-clock time of the whole run (seconds).
    pub wall_s: f64,
    /// The final mesh.
    pub mesh: MeshReport,
    /// What is likely wrong with the input, with the remedy.
    #[serde(default)]
    pub warnings: Vec<Warning>,
    /// Frames whose files could not be read, with the reason.
    #[serde(default)]
    pub unreadable: Vec<String>,
    /// Whether the run was stopped before the end.
    pub interrupted: bool,
}

/// One frame of `run.json`.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct FrameReport {
    /// Name of the frame.
    pub id: String,
    /// How much its pose can be trusted.
    pub status: Status,
    /// Feature matches that agree with the pose.
    pub inliers: usize,
    /// Share of the compared depth that agrees with the pose.
    pub depth_agreement: f64,
    /// Motions of the object that can't be seen in this frame: along these its pose is held.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub held: Vec<HeldMotion>,
    /// Whether it became a keyframe.
    pub keyframe: bool,
    /// Milliseconds by stage.
    pub ms: StageMillis,
}

/// Milliseconds by stage.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct StageMillis {
    /// Segmentation.
    pub segment: f64,
    /// Depth clean-up, matching, RANSAC.
    #[serde(rename = "match")]
    pub matching: f64,
    /// Pose graph.
    pub posegraph: f64,
    /// Everything but waiting for the field.
    pub total: f64,
}

/// The mesh in numbers.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct MeshReport {
    /// Vertices.
    pub vertices: usize,
    /// Triangles.
    pub faces: usize,
    /// Whether every edge has exactly two triangles.
    pub watertight: bool,
}

impl MeshReport {
    pub(crate) fn of(mesh: &TriMesh) -> Self {
        Self { vertices: mesh.vertices.len(), faces: mesh.triangles.len(), watertight: mesh.is_watertight() }
    }
}

impl RunReport {
    /// Summarises a run.
    #[must_use]
    pub fn new(config: &Config, schedule: Schedule, run: &VideoRun) -> Self {
        let mut totals: Vec<f64> = run.frames.iter().map(|f| f.times.total.as_secs_f64()).collect();
        totals.sort_unstable_by(f64::total_cmp);
        let median = totals.get(totals.len() / 2).copied().unwrap_or(0.0);
        Self {
            version: env!("CARGO_PKG_VERSION").to_owned(),
            input: None,
            schedule,
            config: config.clone(),
            frames: run.frames.iter().map(FrameReport::of).collect(),
            keyframes: run.reconstruction.keyframes.len(),
            field: run.reconstruction.field.clone(),
            tracking_hz_median: if median > 0.0 { 1.0 / median } else { 0.0 },
            wall_s: run.wall.as_secs_f64(),
            mesh: run.reconstruction.mesh.as_ref().map_or_else(MeshReport::default, MeshReport::of),
            warnings: run.warnings.clone(),
            unreadable: run.unreadable.iter().map(ToString::to_string).collect(),
            interrupted: run.interrupted,
        }
    }

    /// Number of frames with `status`.
    #[must_use]
    pub fn count(&self, status: Status) -> usize {
        self.frames.iter().filter(|f| f.status == status).count()
    }
}

impl FrameReport {
    fn of(result: &FrameResult) -> Self {
        let ms = |d: std::time::Duration| (d.as_secs_f64() * 1e6).round() / 1e3;
        let t = &result.times;
        Self {
            id: result.id.clone(),
            status: result.status,
            inliers: result.inliers,
            depth_agreement: (result.depth_agreement * 1e3).round() / 1e3,
            held: result.uncertainty.iter().flat_map(|u| u.held.iter().map(HeldMotion::rounded)).collect(),
            keyframe: result.keyframe,
            ms: StageMillis {
                segment: ms(t.segment),
                matching: ms(t.matching),
                posegraph: ms(t.posegraph),
                total: ms(t.total),
            },
        }
    }
}

/// Row-major 4x4.
fn rows(pose: &Isometry3<f64>) -> [[f64; 4]; 4] {
    let m = pose.to_homogeneous();
    std::array::from_fn(|r| std::array::from_fn(|c| m[(r, c)]))
}

/// One finished round of the field in `run.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RoundReport {
    /// Keyframes that took part.
    pub keyframes: usize,
    /// Training steps, or iterations of the pose graph.
    pub steps: usize,
    /// Time (milliseconds).
    pub ms: f64,
    /// Mean training loss of consecutive equal parts of the round; empty when nothing was trained.
    pub loss: Vec<f64>,
    /// What the loss of the last part is made of.
    pub terms: Option<LossTerms>,
}

/// The weighted terms of the training loss (paper section 3.4), in truncation units.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct LossTerms {
    /// Distance near the surface.
    pub surface: f64,
    /// Empty space.
    pub empty: f64,
    /// Uncertain free space.
    pub uncertain: f64,
    /// Colour.
    pub color: f64,
    /// Eikonal regularisation.
    pub eikonal: f64,
}

impl RoundReport {
    /// Parts of a round: enough to draw its curve.
    const PARTS: usize = 32;

    pub(crate) fn of(update: &FieldUpdate) -> Self {
        let losses = update.field.as_ref().map_or(&[][..], |field| field.losses());
        let parts: Vec<_> = losses.chunks(losses.len().div_ceil(Self::PARTS).max(1)).collect();
        let mean = |part: &[StepLosses], term: fn(&StepLosses) -> f64| {
            rounded(part.iter().map(term).sum::<f64>() / part.len() as f64)
        };
        Self {
            keyframes: update.poses.len(),
            steps: update.steps,
            ms: rounded(update.elapsed.as_secs_f64() * 1e3),
            loss: parts.iter().map(|part| mean(part, StepLosses::total)).collect(),
            terms: parts.last().map(|part| LossTerms {
                surface: mean(part, |l| l.surface),
                empty: mean(part, |l| l.empty),
                uncertain: mean(part, |l| l.uncertain),
                color: mean(part, |l| l.color),
                eikonal: mean(part, |l| l.eikonal),
            }),
        }
    }
}

/// To a millionth: more digits would only make the file longer.
fn rounded(value: f64) -> f64 {
    (value * 1e6).round() / 1e6
}

/// One keyframe of `keyframes.json` or `keyframes_refined.json`.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct KeyframeReport {
    /// Number of the frame in the video.
    pub index: usize,
    /// Name of the frame.
    pub id: String,
    /// Row-major 4x4, object to camera, metres.
    pub cam_from_obj: [[f64; 4]; 4],
    /// Whether the field has refined this pose.
    pub refined_by_field: bool,
}

impl KeyframeReport {
    /// `cam_from_obj`, with the file's rounding taken out of the rotation; `None` when a number isn't finite.
    pub(crate) fn pose(&self) -> Option<Isometry3<f64>> {
        let m = &self.cam_from_obj;
        if !m.iter().flatten().all(|v| v.is_finite()) {
            return None;
        }
        let rotation = Rotation3::from_matrix_unchecked(Matrix3::from_fn(|r, c| m[r][c]));
        let rotation = UnitQuaternion::from_rotation_matrix(&rotation);
        Some(Isometry3::from_parts(Translation3::new(m[0][3], m[1][3], m[2][3]), rotation))
    }

    pub(crate) fn of(keyframe: &Keyframe) -> Self {
        Self {
            index: keyframe.index,
            id: keyframe.id.clone(),
            cam_from_obj: rows(&keyframe.obj_from_cam.inverse()),
            refined_by_field: keyframe.refined_by_field,
        }
    }

    pub(crate) fn refined(keyframe: &RefinedKeyframe) -> Self {
        Self {
            index: keyframe.index,
            id: keyframe.id.clone(),
            cam_from_obj: rows(&keyframe.obj_from_cam.inverse()),
            refined_by_field: true,
        }
    }
}
