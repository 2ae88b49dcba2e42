//! Everything the page shows, read from the results folder.

use std::fs;

use base64::{Engine, engine::general_purpose::STANDARD};
use nalgebra::{Isometry3, Vector3};
use rgbd_io::Error;

use super::overlays::{Overlays, draw_overlays};
use crate::{
    KeyframeReport, RunReport,
    draw::{Overlay, direction},
    evaluate::Scores,
    export::{Asset, glb},
    output::OutputFolder,
    report::MeshReport,
};

/// A finished run.
pub(super) struct Results {
    pub(super) report: RunReport,
    pub(super) keyframes: Vec<KeyframeReport>,
    /// Whether mesh, poses and keyframes are those of a refinement.
    pub(super) refined: bool,
    /// `cam_from_obj` by frame; `None` where its file is missing.
    pub(super) poses: Vec<Option<Isometry3<f64>>>,
    pub(super) overlay: Overlay,
    pub(super) overlays: Overlays,
    /// The mesh as base64 of a GLB file.
    pub(super) model: Option<String>,
    /// Scores of the run and of its refinement, where the truth is known.
    pub(super) scores: Option<Scores>,
    pub(super) refined_scores: Option<Scores>,
    /// Names of the files and folders in the results folder.
    pub(super) files: Vec<String>,
    /// What could not be read for the page.
    pub(super) problems: Vec<String>,
}

impl Results {
    pub(super) fn gather(folder: &OutputFolder) -> Result<Self, Error> {
        let mut report = folder.read_report()?;
        let refined = folder.read_refined_keyframes()?;
        let mut problems = Vec::new();
        let overlay = Overlay::open(folder).unwrap_or_else(|error| {
            problems.push(error.to_string());
            Overlay::new(None)
        });
        // The numbers in run.json are those of the mesh before.
        if let (Some(_), Some(mesh)) = (&refined, overlay.mesh()) {
            report.mesh = MeshReport::of(mesh);
        }
        let poses: Vec<_> = report.frames.iter().map(|f| folder.read_final_pose(&f.id).ok()).collect();
        let overlays = draw_overlays(folder, &report, &poses, &overlay);
        let scores = |name: &str| serde_json::from_slice(&fs::read(folder.path().join(name)).ok()?).ok();
        let refined_scores = refined.as_ref().and_then(|_| scores("eval_refined.json"));
        let mut files: Vec<String> = fs::read_dir(folder.path())
            .map(|entries| entries.flatten().map(|e| e.file_name().to_string_lossy().into_owned()).collect())
            .unwrap_or_default();
        files.sort();
        Ok(Self {
            model: model(folder, &overlay),
            report,
            refined: refined.is_some(),
            keyframes: match refined {
                Some(keyframes) => keyframes,
                None => folder.read_keyframes()?,
            },
            poses,
            overlay,
            overlays,
            scores: scores("eval.json"),
            refined_scores,
            files,
            problems,
        })
    }

    /// Lengths of the smallest box around the mesh, longest first (centimetres).
    pub(super) fn size_cm(&self) -> Option<[f64; 3]> {
        let mut size: [f64; 3] = (self.overlay.bounds()?.size * 100.0).into();
        size.sort_by(|a, b| b.total_cmp(a));
        Some(size)
    }

    /// From which directions of the object frame the camera looked: unit vectors from the object to the camera.
    pub(super) fn camera_direction(&self, cam_from_obj: &Isometry3<f64>) -> Option<Vector3<f64>> {
        let centre = self.overlay.bounds().map_or_else(nalgebra::Point3::origin, |b| b.centre());
        let towards = cam_from_obj.inverse().translation.vector - centre.coords;
        towards.try_normalize(1e-9)
    }

    /// Directions of the keyframes' cameras; `None` for a pose that can't be used.
    pub(super) fn keyframe_directions(&self) -> Vec<Option<Vector3<f64>>> {
        self.keyframes.iter().map(|k| self.camera_direction(&k.pose()?)).collect()
    }

    /// Share of all viewing directions with a keyframe within 45 degrees: those sides were seen well.
    pub(super) fn coverage(&self) -> f64 {
        const SAMPLES: usize = 600;
        let seen: Vec<_> = self.keyframe_directions().into_iter().flatten().collect();
        let near = 45_f64.to_radians().cos();
        let covered =
            (0..SAMPLES).filter(|i| seen.iter().any(|d| d.dot(&direction(*i, SAMPLES)) > near)).count();
        covered as f64 / SAMPLES as f64
    }
}

/// The exported GLB, or one made from the mesh for a run that wrote none.
fn model(folder: &OutputFolder, overlay: &Overlay) -> Option<String> {
    let exported = fs::read(folder.path().join("mesh.glb")).ok();
    let bytes = exported.or_else(|| glb(&Asset::plain(overlay.mesh()?.clone())).ok())?;
    Some(STANDARD.encode(bytes))
}
