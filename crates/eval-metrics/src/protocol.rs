//! The evaluation of BundleSDF: which frames count, what aligns the object frames, how surfaces are sampled.

use crate::{
    Chamfer, IcpOptions, MeshRef, ModelPoints, add, add_s, auc, icp, rebase, rotation_error, sample_surface,
    thin, translation_error,
};
use nalgebra::{Isometry3, Point3};

/// Scores of a video's poses. The lists have one entry for each frame with a true pose, `INFINITY` where the
/// predicted pose is missing or not finite.
#[derive(Clone, Debug, PartialEq)]
pub struct PoseScores {
    /// Area under the ADD recall curve, percent.
    pub add_auc: f64,
    /// Area under the ADD-S recall curve, percent.
    pub add_s_auc: f64,
    /// Index in the input of each frame with a true pose.
    pub frames: Vec<usize>,
    /// ADD, metres.
    pub add_errors: Vec<f64>,
    /// ADD-S, metres.
    pub add_s_errors: Vec<f64>,
    /// Rotation error, radians.
    pub rotation_errors: Vec<f64>,
    /// Error of the object origin, metres.
    pub translation_errors: Vec<f64>,
}

/// Scores poses against the truth, the object frames aligned at the first frame with truth ([`rebase`]).
///
/// `pred`, `gt`: `cam_from_obj` per frame; frames without truth do not count, frames without prediction are
/// infinitely wrong. `max_error`: upper end of the areas, 0.1 m for hand-sized objects (HO3D, YCBInEOAT),
/// 0.5 m for furniture (BEHAVE).
pub fn score_poses(
    pred: &[Option<Isometry3<f64>>],
    gt: &[Option<Isometry3<f64>>],
    model: &ModelPoints,
    max_error: f64,
) -> PoseScores {
    let aligned = rebase(pred, gt);
    let mut scores = PoseScores {
        add_auc: 0.0,
        add_s_auc: 0.0,
        frames: Vec::new(),
        add_errors: Vec::new(),
        add_s_errors: Vec::new(),
        rotation_errors: Vec::new(),
        translation_errors: Vec::new(),
    };
    for (i, truth) in gt.iter().enumerate() {
        let Some(truth) = truth else { continue };
        let found = aligned.get(i).copied().flatten();
        let error = |measure: &dyn Fn(&Isometry3<f64>) -> f64| {
            found.as_ref().map(measure).filter(|e| e.is_finite()).unwrap_or(f64::INFINITY)
        };
        scores.frames.push(i);
        scores.add_errors.push(error(&|p| add(p, truth, model)));
        scores.add_s_errors.push(error(&|p| add_s(p, truth, model)));
        scores.rotation_errors.push(error(&|p| rotation_error(p, truth)));
        scores.translation_errors.push(error(&|p| translation_error(p, truth)));
    }
    scores.add_auc = auc(&scores.add_errors, max_error);
    scores.add_s_auc = auc(&scores.add_s_errors, max_error);
    scores
}

/// How a reconstructed surface is compared with the true one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MeshProtocol {
    /// Points sampled on the reconstruction.
    pub pred_samples: usize,
    /// Spacing of the points on the true surface, metres.
    pub gt_spacing: f64,
    /// Reconstructed vertices farther outside the true bounding box than this (metres) are dropped with their
    /// triangles.
    pub crop_margin: Option<f64>,
    /// Registers the reconstruction to the truth before measuring.
    pub icp: Option<IcpOptions>,
    /// Seed of the samples.
    pub seed: u64,
}

impl MeshProtocol {
    /// What the paper describes: the true surface at 5 mm, and no registration, so that an error of the first
    /// pose counts.
    ///
    /// The reconstruction is sampled densely. A perfect one scores about 1.1 mm, half the mean distance to a
    /// point of a 5 mm grid.
    pub fn paper_text() -> Self {
        Self { pred_samples: 99_999, gt_spacing: 0.005, crop_margin: None, icp: None, seed: 0 }
    }

    /// What the published numbers were computed with: also crops the reconstruction to the true box plus 0.3 m
    /// and registers it to the truth by point-to-point ICP.
    pub fn authors_script() -> Self {
        Self { crop_margin: Some(0.3), icp: Some(IcpOptions::default()), ..Self::paper_text() }
    }
}

/// Chamfer distance of a reconstruction to the truth; [`Chamfer::forward`] is from the reconstruction to the
/// truth.
///
/// `pred`: in the tracker's object frame. `gt`: in the true object frame, culled to what the video shows
/// ([`crate::visible_faces`], [`crate::keep_faces`]). `gt_from_pred`: inverse of [`crate::alignment`]. The
/// reconstruction is not culled, so that invented surface costs; cull it as well to measure what was seen only.
///
/// `None` when one of the meshes has no surface.
pub fn score_mesh(
    pred: MeshRef<'_>,
    gt: MeshRef<'_>,
    gt_from_pred: &Isometry3<f64>,
    protocol: &MeshProtocol,
) -> Option<Chamfer> {
    let mut vertices = transformed(pred.vertices, gt_from_pred);
    let gt_points = thin(&sample_surface(gt, protocol.pred_samples, protocol.seed), protocol.gt_spacing);
    if let Some(margin) = protocol.crop_margin {
        crop(&mut vertices, &gt_points, margin);
    }
    // Another seed than the truth's: a mesh compared with itself must not meet its own samples.
    let pred_mesh = MeshRef::new(&vertices, pred.triangles);
    let mut pred_points = sample_surface(pred_mesh, protocol.pred_samples, protocol.seed.wrapping_add(1));
    if let Some(options) = &protocol.icp {
        pred_points = transformed(&pred_points, &icp(&pred_points, &gt_points, options));
    }
    Chamfer::between(&pred_points, &gt_points)
}

fn transformed(points: &[[f64; 3]], motion: &Isometry3<f64>) -> Vec<[f64; 3]> {
    points.iter().map(|p| (motion * Point3::from(*p)).into()).collect()
}

/// Makes vertices outside the box of `around` plus `margin` invalid, which drops their triangles.
fn crop(vertices: &mut [[f64; 3]], around: &[[f64; 3]], margin: f64) {
    let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for p in around {
        for k in 0..3 {
            low[k] = low[k].min(p[k] - margin);
            high[k] = high[k].max(p[k] + margin);
        }
    }
    for v in vertices {
        if (0..3).any(|k| !(low[k]..=high[k]).contains(&v[k])) {
            *v = [f64::NAN; 3];
        }
    }
}
