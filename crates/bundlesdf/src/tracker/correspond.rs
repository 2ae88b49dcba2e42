//! Correspondences between two observations whose relative pose is roughly known: corners of one are projected into
//! the other, their patches warped by the local surface plane, and tracked to sub-pixel accuracy.

use matcher::klt::{KltOptions, Track, track_forward_backward};
use matcher::ransac::LiftedMatch;
use nalgebra::{Isometry3, Point3, Vector3};
use rayon::prelude::*;

use crate::{
    observation::Observation,
    rigid::{moved_point, moved_vector},
};

/// One point seen in two observations, in each one's camera frame (metres).
#[derive(Clone, Copy, Debug)]
pub(crate) struct Correspondence {
    pub(crate) a: [f32; 3],
    pub(crate) normal_a: [f32; 3],
    pub(crate) b: [f32; 3],
    pub(crate) normal_b: [f32; 3],
    /// Confidence of the match, 0 to 1.
    pub(crate) weight: f32,
}

impl Correspondence {
    /// Both points in the object frame under the given poses: what RANSAC works on.
    pub(crate) fn lifted(&self, obj_from_a: &Isometry3<f64>, obj_from_b: &Isometry3<f64>) -> LiftedMatch {
        LiftedMatch {
            a: moved_point(obj_from_a, self.a),
            normal_a: moved_vector(obj_from_a, self.normal_a),
            b: moved_point(obj_from_b, self.b),
            normal_b: moved_vector(obj_from_b, self.normal_b),
            sight: moved_vector(obj_from_b, unit(self.b)),
            weight: self.weight,
        }
    }
}

fn unit(v: [f32; 3]) -> [f32; 3] {
    let length = v.iter().map(|c| c * c).sum::<f32>().sqrt();
    if length > 0.0 { v.map(|c| c / length) } else { [0.0; 3] }
}

/// Tracks up to `max_corners` corners of `from` into `to`; `to_from` is the guess of the relative motion (maps points
/// of `from`'s camera to `to`'s). Points that the guess turns away from the camera are left out.
pub(crate) fn guided_tracks(
    from: &Observation,
    to: &Observation,
    to_from: &Isometry3<f64>,
    max_corners: usize,
    options: &KltOptions,
) -> Vec<Correspondence> {
    /// Points that one core tracks at a time.
    const PART: usize = 40;
    let mut starts = Vec::new();
    let mut points = Vec::new();
    let mut guesses = Vec::new();
    let mut warps = Vec::new();
    for &corner in from.corners(max_corners) {
        let Some((point, normal)) = from.lift(corner) else { continue };
        let Some((guess, warp)) = predict(from, to, to_from, corner, point, normal) else { continue };
        starts.push((point, normal));
        points.push(corner);
        guesses.push(guess);
        warps.push(warp);
    }
    let in_parts = points.par_chunks(PART).zip(guesses.par_chunks(PART)).zip(warps.par_chunks(PART));
    let tracks: Vec<_> = in_parts
        .flat_map_iter(|((points, guesses), warps)| {
            track_forward_backward(&from.pyramid, &to.pyramid, points, guesses, Some(warps), options)
        })
        .collect();
    starts
        .into_iter()
        .zip(tracks)
        .filter_map(|((a, normal_a), track)| {
            let track = track?;
            let (x, y) = ((track.position[0] + 0.5) as usize, (track.position[1] + 0.5) as usize);
            if to.mask.get(x, y).is_none_or(|m| *m == 0) {
                return None;
            }
            let (b, normal_b) = to.lift(track.position)?;
            Some(Correspondence { a, normal_a, b, normal_b, weight: confidence(&track) })
        })
        .collect()
}

/// How far a track is believed, 0 to 1: its correlation, less where little texture holds it in place.
///
/// Shading and highlights change a patch by some gray levels as the object turns. Strong texture hardly moves by that;
/// on a plain surface the track follows the light instead of the object.
pub(super) fn confidence(track: &Track) -> f32 {
    /// Change of appearance that gain and bias don't explain (gray levels).
    const APPEARANCE: f32 = 3.0;
    /// Scatter of good tracks (pixels).
    const SCATTER: f32 = 1.0;
    let strength = track.texture * SCATTER * SCATTER;
    track.ncc.clamp(0.0, 1.0) * strength / (strength + APPEARANCE * APPEARANCE)
}

/// Where `corner` of `from` should appear in `to`, and the 2x2 warp (row-major) of its neighbourhood under the plane
/// through `point` with `normal`.
pub(super) fn predict(
    from: &Observation,
    to: &Observation,
    to_from: &Isometry3<f64>,
    corner: [f32; 2],
    point: [f32; 3],
    normal: [f32; 3],
) -> Option<([f32; 2], [f32; 4])> {
    /// Surface turned further away than this gives patches too distorted to track.
    const MIN_FACING: f64 = 0.2;
    const MAX_STRETCH: f64 = 3.0;
    let p = Vector3::from(point).cast::<f64>();
    let mut n = Vector3::from(normal).cast::<f64>();
    if n.norm_squared() < 0.5 {
        n = -p.normalize();
    }
    let q = (to_from * Point3::from(p)).coords;
    let facing = -(to_from.rotation * n).dot(&q) / q.norm();
    let pixel = to.intrinsics.project(q.into())?;
    let inside = pixel[0] >= 0.0
        && pixel[1] >= 0.0
        && pixel[0] < to.mask.width() as f64
        && pixel[1] < to.mask.height() as f64;
    if !inside || facing < MIN_FACING || !facing.is_finite() {
        return None;
    }
    let (ka, kb) = (&from.intrinsics, &to.intrinsics);
    let ray = Vector3::from(ka.unproject(f64::from(corner[0]), f64::from(corner[1]), 1.0));
    let along = n.dot(&ray);
    if along.abs() < 1e-6 {
        return None;
    }
    let scale = n.dot(&p) / along;
    // d(point)/d(pixel): the ray turns, and its intersection with the plane slides.
    let column = |step: Vector3<f64>| {
        let dx = to_from.rotation * (step * scale - ray * (scale * n.dot(&step) / along));
        [kb.fx * (dx.x - q.x / q.z * dx.z) / q.z, kb.fy * (dx.y - q.y / q.z * dx.z) / q.z]
    };
    let du = column(Vector3::new(1.0 / ka.fx, 0.0, 0.0));
    let dv = column(Vector3::new(0.0, 1.0 / ka.fy, 0.0));
    let determinant = du[0] * dv[1] - dv[0] * du[1];
    let bounded = [du[0], du[1], dv[0], dv[1]].iter().all(|v| v.abs() < MAX_STRETCH);
    if !bounded || determinant < 1.0 / (MAX_STRETCH * MAX_STRETCH) {
        return None;
    }
    Some(([pixel[0] as f32, pixel[1] as f32], [du[0] as f32, dv[0] as f32, du[1] as f32, dv[1] as f32]))
}
