//! Corners to follow: Shi and Tomasi, *Good features to track*, CVPR 1994.

use crate::blur::Gaussian;
use crate::gray::{Rect, scharr};
use rgbd_io::{Image, Mask};

/// What counts as a corner and how many are wanted.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CornerOptions {
    /// At most this many corners, strongest first.
    pub max_count: usize,
    /// Smallest response as a part of the strongest one in the mask, 0 to 1.
    pub quality: f32,
    /// Smallest response at all, (gray levels per pixel)^2: keeps sensor noise on a plain object from being "corners".
    pub min_response: f32,
    /// Smallest distance between corners, pixels.
    pub min_distance: f32,
    /// Half the side of the structure tensor's Gaussian window, pixels.
    pub half_window: usize,
    /// The tensor's window must lie in the mask eroded by this many pixels. Corners that the silhouette makes with the
    /// background slide over the object as it turns; they are no points of its surface.
    pub border: usize,
}

impl Default for CornerOptions {
    fn default() -> Self {
        Self {
            max_count: 300,
            quality: 0.01,
            min_response: 2.0,
            min_distance: 5.0,
            half_window: 2,
            border: 1,
        }
    }
}

/// Corners of `gray` inside `mask`, strongest first, in pixels, refined to sub-pixel.
///
/// The image itself is not blackened outside the mask. Empty if the sizes differ.
pub fn detect_corners(gray: &Image<f32>, mask: &Mask, options: &CornerOptions) -> Vec<[f32; 2]> {
    detect_new_corners(gray, mask, &[], options)
}

/// [`detect_corners`] that keeps [`CornerOptions::min_distance`] from the `existing` points too, which are not part of
/// the result: tops up a set of tracks.
pub fn detect_new_corners(
    gray: &Image<f32>,
    mask: &Mask,
    existing: &[[f32; 2]],
    options: &CornerOptions,
) -> Vec<[f32; 2]> {
    if mask.size() != gray.size() || options.max_count == 0 {
        return Vec::new();
    }
    // Only the object's box matters; the windows and the derivatives look a little beyond it.
    let Some(rect) = Rect::around_mask(mask, options.half_window.min(15) + 2) else { return Vec::new() };
    let offset = [rect.x as f32, rect.y as f32];
    let local: Vec<[f32; 2]> = existing.iter().map(|p| [p[0] - offset[0], p[1] - offset[1]]).collect();
    let corners = corners_of(&rect.cut(gray), &rect.cut(mask), &local, options);
    corners.into_iter().map(|p| [p[0] + offset[0], p[1] + offset[1]]).collect()
}

fn corners_of(
    gray: &Image<f32>,
    mask: &Mask,
    existing: &[[f32; 2]],
    options: &CornerOptions,
) -> Vec<[f32; 2]> {
    let (width, height) = gray.size();
    if width < 3 || height < 3 {
        return Vec::new();
    }
    let half = options.half_window.clamp(1, 15);
    let response = min_eigenvalue(gray, half);
    let allowed = erode(mask, half.saturating_add(options.border).saturating_add(1));
    let strongest = response
        .pixels()
        .iter()
        .zip(allowed.pixels())
        .filter(|(_, a)| **a != 0)
        .fold(0.0_f32, |m, (r, _)| m.max(*r));
    let threshold = (options.quality * strongest).max(options.min_response).max(f32::MIN_POSITIVE);

    let mut candidates = local_maxima(&response, &allowed, threshold);
    candidates.sort_unstable_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));

    let mut buckets = Buckets::new(width, height, options.min_distance);
    for &point in existing {
        buckets.insert(point);
    }
    let mut corners = Vec::with_capacity(options.max_count.min(candidates.len()));
    for (_, index) in candidates {
        let point = refine(&response, index % width, index / width);
        if buckets.is_free(point) {
            buckets.insert(point);
            corners.push(point);
            if corners.len() == options.max_count {
                break;
            }
        }
    }
    corners
}

/// `mask` without the pixels whose `(2 radius + 1)`-pixel square isn't all object and inside the image.
pub(crate) fn erode(mask: &Mask, radius: usize) -> Mask {
    let (width, height) = mask.size();
    // Two run-length passes: distance to the last background pixel seen along the row, then along the column.
    let side = radius.saturating_mul(2).saturating_add(1);
    let mut rows = Mask::filled(width, height, 0);
    for y in 0..height {
        let mut run = 0;
        for (x, &m) in mask.row(y).iter().enumerate() {
            run = if m != 0 { run + 1 } else { 0 };
            if run >= side {
                rows[(x - radius, y)] = 1;
            }
        }
    }
    let mut out = Mask::filled(width, height, 0);
    let mut runs = vec![0_usize; width];
    for y in 0..height {
        for (x, run) in runs.iter_mut().enumerate() {
            *run = if rows[(x, y)] != 0 { *run + 1 } else { 0 };
            if *run >= side {
                out[(x, y - radius)] = 1;
            }
        }
    }
    out
}

/// Smaller eigenvalue of the structure tensor, a Gaussian mean over a `(2 half + 1)`-pixel window, (gray levels per
/// pixel)^2. A box window would give a plateau around a sharp corner instead of a maximum on it.
fn min_eigenvalue(gray: &Image<f32>, half: usize) -> Image<f32> {
    let (width, height) = gray.size();
    let (dx, dy) = scharr(gray);
    let window = Gaussian::new(0.333 * half as f32);
    let mut scratch = Vec::new();
    let mut mean_of = |a: &Image<f32>, b: &Image<f32>| {
        let products = a.pixels().iter().zip(b.pixels()).map(|(a, b)| a * b).collect();
        window.filter(&Image::from_vec(width, height, products).unwrap_or_default(), &mut scratch)
    };
    let mut out = mean_of(&dx, &dx);
    let (xy, yy) = (mean_of(&dx, &dy), mean_of(&dy, &dy));
    for ((a, b), c) in out.pixels_mut().iter_mut().zip(xy.pixels()).zip(yy.pixels()) {
        *a = 0.5 * (*a + c - ((*a - c) * (*a - c) + 4.0 * b * b).sqrt());
    }
    out
}

/// `(response, index)` of the pixels that are largest in their 3 x 3 neighbourhood.
fn local_maxima(response: &Image<f32>, allowed: &Mask, threshold: f32) -> Vec<(f32, usize)> {
    let (width, height) = response.size();
    let (r, ok) = (response.pixels(), allowed.pixels());
    let mut found = Vec::new();
    for y in 1..height - 1 {
        for at in y * width + 1..(y + 1) * width - 1 {
            let value = r[at];
            if value < threshold || ok[at] == 0 || !value.is_finite() {
                continue;
            }
            // Strict on one side only, so that a plateau has one maximum.
            let before = [r[at - width - 1], r[at - width], r[at - width + 1], r[at - 1]];
            let after = [r[at + 1], r[at + width - 1], r[at + width], r[at + width + 1]];
            if before.iter().all(|&o| value > o) && after.iter().all(|&o| value >= o) {
                found.push((value, at));
            }
        }
    }
    found
}

/// Top of the parabolas through the response along both axes.
fn refine(response: &Image<f32>, x: usize, y: usize) -> [f32; 2] {
    let centre = response[(x, y)];
    let top = |before: f32, after: f32| {
        let curvature = before - 2.0 * centre + after;
        if curvature < 0.0 { (0.5 * (before - after) / curvature).clamp(-0.5, 0.5) } else { 0.0 }
    };
    [
        x as f32 + top(response[(x - 1, y)], response[(x + 1, y)]),
        y as f32 + top(response[(x, y - 1)], response[(x, y + 1)]),
    ]
}

/// Points by grid cell, one cell a minimum distance wide, so that only nine cells are looked at.
struct Buckets {
    cells: Vec<Vec<[f32; 2]>>,
    columns: usize,
    rows: usize,
    cell: f32,
    distance: f32,
}

impl Buckets {
    fn new(width: usize, height: usize, distance: f32) -> Self {
        let distance = if distance.is_finite() { distance.max(0.0) } else { 0.0 };
        let cell = distance.max(4.0);
        let columns = (width as f32 / cell) as usize + 1;
        let rows = (height as f32 / cell) as usize + 1;
        Self { cells: vec![Vec::new(); columns * rows], columns, rows, cell, distance }
    }

    fn cell_of(&self, p: [f32; 2]) -> (usize, usize) {
        (
            ((p[0] / self.cell) as usize).min(self.columns - 1),
            ((p[1] / self.cell) as usize).min(self.rows - 1),
        )
    }

    fn insert(&mut self, p: [f32; 2]) {
        let (cx, cy) = self.cell_of(p);
        self.cells[cy * self.columns + cx].push(p);
    }

    fn is_free(&self, p: [f32; 2]) -> bool {
        let (cx, cy) = self.cell_of(p);
        for y in cy.saturating_sub(1)..(cy + 2).min(self.rows) {
            for x in cx.saturating_sub(1)..(cx + 2).min(self.columns) {
                let taken = |q: &[f32; 2]| {
                    (p[0] - q[0]) * (p[0] - q[0]) + (p[1] - q[1]) * (p[1] - q[1])
                        < self.distance * self.distance
                };
                if self.cells[y * self.columns + x].iter().any(taken) {
                    return false;
                }
            }
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Gray checkerboard on a bright disc in front of black.
    fn scene() -> (Image<f32>, Mask) {
        let mask = Mask::from_fn(120, 100, |x, y| u8::from((x as f32 - 60.0).hypot(y as f32 - 50.0) < 40.0));
        let gray = Image::from_fn(120, 100, |x, y| {
            if mask[(x, y)] == 0 { 0.0 } else { if ((x / 12) + (y / 12)) % 2 == 0 { 230.0 } else { 180.0 } }
        });
        (gray, mask)
    }

    #[test]
    fn corners_are_the_checkerboards_not_the_silhouettes() {
        let (gray, mask) = scene();
        let options = CornerOptions { border: 2, ..CornerOptions::default() };
        let corners = detect_corners(&gray, &mask, &options);
        assert!(corners.len() >= 15, "{} corners", corners.len());
        for c in &corners {
            // Squares change between pixels 12k - 1 and 12k.
            let off = |v: f32| ((v + 0.5) / 12.0 - ((v + 0.5) / 12.0).round()).abs() * 12.0;
            assert!(off(c[0]) < 0.75 && off(c[1]) < 0.75, "no checkerboard corner at {c:?}");
            assert!((c[0] - 60.0).hypot(c[1] - 50.0) < 40.0 - 4.0);
        }
    }

    #[test]
    fn corners_keep_their_distance_from_each_other_and_from_existing_points() {
        let (gray, mask) = scene();
        let options = CornerOptions { min_distance: 15.0, ..CornerOptions::default() };
        let old = [[60.0, 50.0]];
        let corners = detect_new_corners(&gray, &mask, &old, &options);
        assert!(corners.len() > 5);
        for (i, a) in corners.iter().enumerate() {
            for b in corners[..i].iter().chain(&old) {
                assert!((a[0] - b[0]).hypot(a[1] - b[1]) >= 15.0);
            }
        }
        let few = detect_corners(&gray, &mask, &CornerOptions { max_count: 3, ..options });
        assert_eq!(few.len(), 3);
    }

    #[test]
    fn plain_empty_and_odd_inputs_have_no_corners() {
        let options = CornerOptions::default();
        let mask = Mask::filled(40, 40, 255);
        // A plain object with a little noise.
        let plain = Image::from_fn(40, 40, |x, y| 100.0 + ((x * 7919 + y * 104_729) % 13) as f32 * 0.1);
        assert!(detect_corners(&plain, &mask, &options).is_empty());
        assert!(detect_corners(&plain, &Mask::filled(40, 40, 0), &options).is_empty());
        assert!(detect_corners(&plain, &Mask::filled(39, 40, 1), &options).is_empty());
        assert!(detect_corners(&Image::default(), &Mask::default(), &options).is_empty());
        assert!(detect_corners(&Image::filled(40, 40, f32::NAN), &mask, &options).is_empty());
    }

    #[test]
    fn erosion_by_a_square() {
        let mask = Mask::from_fn(12, 10, |x, y| u8::from((2..10).contains(&x) && (1..9).contains(&y)));
        let eroded = erode(&mask, 2);
        let expected = Mask::from_fn(12, 10, |x, y| u8::from((4..8).contains(&x) && (3..7).contains(&y)));
        assert_eq!(eroded, expected);
        assert!(erode(&mask, usize::MAX).pixels().iter().all(|&v| v == 0));
    }
}
