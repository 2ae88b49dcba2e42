//! Following points from one image to the next: pyramidal Lucas-Kanade, inverse compositional.
//!
//! Lucas and Kanade 1981; Baker and Matthews, *Lucas-Kanade 20 years on*, IJCV 2004. The template is warped once into
//! the geometry of the target (roll, scale and foreshortening as predicted by the caller), so that the search itself is
//! a pure translation on a regular grid. Gain and bias between the two patches are eliminated in closed form: with the
//! template's Jacobian `J` projected onto the complement of the template `T` and the constant, the update is
//! `(J'WJ)^-1 J'WI / a`, where `a` is the gain and `W` a Gaussian window, which keeps what the warp does not predict from
//! pulling at the rim.

use crate::gray::Pyramid;
use crate::simd;
use crate::window::{Chase, Window};

/// How points are followed and which are believed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KltOptions {
    /// The window is `2 half_window + 1` pixels a side on every level.
    pub half_window: usize,
    /// Iterations a level.
    pub max_iterations: usize,
    /// An update smaller than this ends the iterations, pixels of the level.
    pub epsilon: f32,
    /// Smallest eigenvalue of the mean structure tensor of a followable patch, (gray levels per pixel)^2.
    pub min_eigenvalue: f32,
    /// Forward-backward: largest distance between a point and its return, pixels.
    pub max_forward_backward: f32,
    /// Forward-backward: smallest zero-mean normalised cross-correlation of the two patches.
    pub min_ncc: f32,
}

impl Default for KltOptions {
    fn default() -> Self {
        Self {
            half_window: 5,
            max_iterations: 12,
            epsilon: 0.02,
            min_eigenvalue: 0.25,
            max_forward_backward: 1.0,
            min_ncc: 0.75,
        }
    }
}

/// Where a point went.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Track {
    /// Position in the target frame, pixels.
    pub position: [f32; 2],
    /// Zero-mean normalised cross-correlation of the (warped) template and the patch at `position`, -1 to 1.
    pub ncc: f32,
    /// How well the template's texture ties the position down in its worst direction: the smaller eigenvalue of the
    /// mean structure tensor on the finest level, (gray levels per pixel)^2. An appearance that changes by `e` gray
    /// levels moves the position by about `e / sqrt(texture)` pixels.
    pub texture: f32,
}

/// The identity as a 2x2 row-major warp.
const IDENTITY: [f32; 4] = [1.0, 0.0, 0.0, 1.0];

/// Follows `points` of `from` to `to`.
///
/// `guesses[i]` is where point `i` is expected (the point itself if nothing is known); a missing guess is the point.
/// `warps[i]`, row-major 2x2, maps offsets from the point in `from` to offsets in `to`; a missing warp is the identity.
/// `None` for points that leave the image, have no texture, diverge, or come with a NaN or a singular warp.
pub fn track(
    from: &Pyramid,
    to: &Pyramid,
    points: &[[f32; 2]],
    guesses: &[[f32; 2]],
    warps: Option<&[[f32; 4]]>,
    options: &KltOptions,
) -> Vec<Option<Track>> {
    let mut window = Window::new(options);
    let each = |(i, &point): (usize, &[f32; 2])| {
        let guess = guesses.get(i).copied().unwrap_or(point);
        let warp = warps.and_then(|w| w.get(i)).copied().unwrap_or(IDENTITY);
        let chase =
            Chase { from, to, max_levels: usize::MAX, point, guess, from_target: inverse(warp)?, options };
        simd::follow(&mut window, &chase)
    };
    points.iter().enumerate().map(each).collect()
}

/// [`track`], then back with the inverse warp: points that do not return to within
/// [`KltOptions::max_forward_backward`], or look different ([`KltOptions::min_ncc`]), are `None`.
///
/// Kalal et al., *Forward-backward error*, ICPR 2010. The way back starts with the offset of the guess reversed, not at
/// the point that it is meant to find.
pub fn track_forward_backward(
    from: &Pyramid,
    to: &Pyramid,
    points: &[[f32; 2]],
    guesses: &[[f32; 2]],
    warps: Option<&[[f32; 4]]>,
    options: &KltOptions,
) -> Vec<Option<Track>> {
    let mut window = Window::new(options);
    let mut each = |i: usize, point: [f32; 2]| {
        let guess = guesses.get(i).copied().unwrap_or(point);
        let warp = warps.and_then(|w| w.get(i)).copied().unwrap_or(IDENTITY);
        let out =
            Chase { from, to, max_levels: usize::MAX, point, guess, from_target: inverse(warp)?, options };
        let there = simd::follow(&mut window, &out)?;
        if there.ncc < options.min_ncc {
            return None;
        }
        let start = [there.position[0] - (guess[0] - point[0]), there.position[1] - (guess[1] - point[1])];
        // The way back is as far from its start as the guess was from the answer: if that is near, two levels reach it.
        let correction = (there.position[0] - guess[0]).hypot(there.position[1] - guess[1]);
        let max_levels = if correction <= window.half as f32 { 2 } else { usize::MAX };
        let home = Chase {
            from: to,
            to: from,
            max_levels,
            point: there.position,
            guess: start,
            from_target: warp,
            options,
        };
        let back = simd::follow(&mut window, &home)?;
        let error = (back.position[0] - point[0]).hypot(back.position[1] - point[1]);
        (error <= options.max_forward_backward).then_some(there)
    };
    points.iter().enumerate().map(|(i, &p)| each(i, p)).collect()
}

/// Inverse of a row-major 2x2 matrix, unless it squeezes or stretches areas beyond use.
fn inverse(m: [f32; 4]) -> Option<[f32; 4]> {
    let det = m[0] * m[3] - m[1] * m[2];
    (det.abs() > 0.02 && det.abs() < 50.0).then(|| [m[3] / det, -m[1] / det, -m[2] / det, m[0] / det])
}
