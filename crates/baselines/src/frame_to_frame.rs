//! Frame-to-frame odometry of the object.
//!
//! Corners of the last frame are followed into the new one (or descriptors matched where that fails), lifted to 3-D, and
//! RANSAC finds the motion; point-to-plane ICP against the last frame refines it. Poses are chained, nothing is ever
//! corrected, and the drift that the methods with a model or a pose graph avoid is there to be seen: the ablation that
//! the paper calls tracking without memory. The frames are fused for the mesh only.

use crate::depth::interpolated;
use crate::icp::{Alignment, Matches, Stage, schedule};
use crate::observation::Observation;
use crate::point_map::PointMap;
use crate::rigid::Rigid;
use crate::tracker::{Model, Registration};
use matcher::{
    CornerOptions, CropOptions, FeatureMatcher, KltOptions, LiftedMatch, Pyramid, RansacOptions, RollCrop,
    ScaleSpaceMatcher, detect_corners, ransac, to_gray, track_forward_backward,
};
use nalgebra::Isometry3;
use rgbd_io::Image;

#[derive(Debug)]
pub(crate) struct FrameToFrame {
    seed: u64,
    last: Option<(Observation, Isometry3<f64>)>,
}

/// Weight of the matches in the refinement, relative to all point-to-plane pairs: they hold what the shape leaves free.
const MATCH_SHARE: f32 = 0.3;
const MIN_INLIERS: usize = 6;

/// Pixels in the crops of the last and of the new frame.
type PixelPair = ([f32; 2], [f32; 2]);

impl FrameToFrame {
    pub(crate) fn new(seed: u64) -> Self {
        Self { seed, last: None }
    }

    /// The motion on which the matches agree, applied to the last pose, and the matches that agree.
    fn motion_of(
        &self,
        pairs: &[PixelPair],
        last: &Observation,
        new: &Observation,
        last_pose: &Isometry3<f64>,
    ) -> Option<(Isometry3<f64>, Matches)> {
        let obj_from_last = last_pose.inverse();
        // Both in the object's frame under the last pose: what is left is the object's motion.
        let from = last.levels.first()?.moved(&obj_from_last);
        let to = new.levels.first()?.moved(&obj_from_last);
        let rigid = Rigid::new(&obj_from_last);
        let mut lifted = Vec::new();
        let mut in_camera = Vec::new();
        for &(p, q) in pairs {
            let (Some(a), Some(b)) = (lift(last, &from, p), lift(new, &to, q)) else { continue };
            let (point_a, point_b) = (rigid.point(a.0), rigid.point(b.0));
            lifted.push(LiftedMatch {
                a: point_a,
                normal_a: a.1,
                b: point_b,
                normal_b: b.1,
                sight: [0.0; 3],
                weight: 1.0,
            });
            in_camera.push((point_a, b.0));
        }
        let (middle, _) = new.bounds();
        let options = RansacOptions {
            // One and a half pixels, but not less than depth noise.
            inlier_distance: (1.5 * middle[2] / new.camera.fx).max(0.005),
            min_inliers: MIN_INLIERS,
            seed: self.seed,
            ..RansacOptions::default()
        };
        let model = ransac::estimate(&lifted, &options)?;
        let inliers = model.inliers.iter().filter_map(|&i| in_camera.get(i).copied()).collect();
        Some((last_pose * model.motion, Matches { pairs: inliers, share: MATCH_SHARE }))
    }
}

impl Registration for FrameToFrame {
    fn register(&mut self, observation: &Observation, model: &Model) -> Option<Isometry3<f64>> {
        let (last, last_pose) = self.last.as_ref()?;
        let by_tracks = self.motion_of(&follow(last, observation), last, observation, last_pose);
        let found =
            by_tracks.or_else(|| self.motion_of(&describe(last, observation), last, observation, last_pose));
        let obj_from_last = last_pose.inverse();
        let surface: Vec<PointMap> = last.levels.iter().map(|l| l.moved(&obj_from_last)).collect();
        let stages = schedule(model.truncation());
        let (start, matches, stages): (_, _, &[Stage]) = match found {
            // Already near: the finer levels are enough.
            Some((pose, matches)) => (pose, matches, &stages[1..]),
            None => (*last_pose, Matches::default(), &stages),
        };
        let has_matches = !matches.pairs.is_empty();
        let alignment = Alignment {
            live: &observation.levels,
            model: &surface,
            model_cam_from_obj: *last_pose,
            radius: model.radius,
            matches,
        };
        alignment.run(&start, stages).or_else(|| has_matches.then_some(start))
    }

    fn keep(&mut self, observation: Observation, cam_from_obj: &Isometry3<f64>) {
        self.last = Some((observation, *cam_from_obj));
    }
}

/// Point in the camera's frame at crop pixel `p`, and the normal that `moved` (the same pixels in another frame) has.
fn lift(view: &Observation, moved: &PointMap, p: [f32; 2]) -> Option<([f32; 3], [f32; 3])> {
    let [z, ..] = interpolated(&view.smooth, p[0], p[1], &view.intrinsics)?;
    let point = view.intrinsics.unproject(p[0].into(), p[1].into(), z.into()).map(|v| v as f32);
    let (x, y) = ((p[0] + 0.5) as usize, (p[1] + 0.5) as usize);
    let normal = moved.normals.get(y * moved.width + x).copied().filter(|n| !n[0].is_nan());
    Some((point, normal.unwrap_or([0.0; 3])))
}

/// Corners of `last` where they are in `new`.
fn follow(last: &Observation, new: &Observation) -> Vec<PixelPair> {
    let origin = |o: &Observation| [o.rect.x as f32, o.rect.y as f32];
    let pyramid = |gray: Image<f32>, o: &Observation| Pyramid::new(gray, 4).with_origin(origin(o));
    let gray = to_gray(&last.color);
    let corners: Vec<[f32; 2]> = detect_corners(&gray, &last.mask, &CornerOptions::default())
        .into_iter()
        .map(|p| [p[0] + origin(last)[0], p[1] + origin(last)[1]])
        .collect();
    let (from, to) = (pyramid(gray, last), pyramid(to_gray(&new.color), new));
    let tracks = track_forward_backward(&from, &to, &corners, &corners, None, &KltOptions::default());
    let local = |p: [f32; 2], o: &Observation| [p[0] - origin(o)[0], p[1] - origin(o)[1]];
    corners
        .iter()
        .zip(tracks)
        .filter_map(|(&p, track)| Some((local(p, last), local(track?.position, new))))
        .collect()
}

/// Matches of descriptors, for motions too fast to follow.
fn describe(last: &Observation, new: &Observation) -> Vec<PixelPair> {
    let matcher = ScaleSpaceMatcher::default();
    let crop = |o: &Observation| RollCrop::new(&to_gray(&o.color), &o.mask, 0.0, &CropOptions::default());
    let (Some(a), Some(b)) = (crop(last), crop(new)) else { return Vec::new() };
    let matches = matcher.match_features(&matcher.detect(&a), &matcher.detect(&b));
    matches.iter().map(|m| (m.a, m.b)).collect()
}
