//! From score maps to keypoints, and descriptors at keypoints.

use super::nn::Map;
use rgbd_io::Mask;

/// Largest distance of a pixel that suppresses a keypoint (a 5x5 window).
const SUPPRESSION: usize = 2;

/// Pixels of the first channel of `scores` that lie on `allowed`, at least `border` pixels inside it (1 or more), exceed
/// `threshold` and are the largest of their 5x5 neighbours. `allowed` may be smaller than the map.
pub(super) fn local_maxima(scores: &Map, allowed: &Mask, border: usize, threshold: f32) -> Vec<[usize; 2]> {
    let (width, height) = (allowed.width().min(scores.width()), allowed.height().min(scores.height()));
    let border = border.max(1);
    let mut found = Vec::new();
    for y in border..height.saturating_sub(border) {
        let (row, object) = (scores.row(0, y), allowed.row(y));
        for x in border..width.saturating_sub(border) {
            let value = row[x];
            // Most pixels fall here.
            if object[x] == 0
                || value.is_nan()
                || value <= threshold
                || value < row[x - 1]
                || value < row[x + 1]
            {
                continue;
            }
            if is_largest(scores, x, y) {
                found.push([x, y]);
            }
        }
    }
    found
}

fn is_largest(scores: &Map, x: usize, y: usize) -> bool {
    let value = scores.at(0, x, y);
    let left = x.saturating_sub(SUPPRESSION);
    let right = (x + SUPPRESSION + 1).min(scores.width());
    (y.saturating_sub(SUPPRESSION)..(y + SUPPRESSION + 1).min(scores.height())).all(|v| {
        let row = &scores.row(0, v)[left..right];
        // Of equal pixels, the first one counts.
        row.iter().enumerate().all(|(i, &other)| other < value || (other == value && (v, left + i) >= (y, x)))
    })
}

/// The mean offset in the 3x3 window about pixel `(x, y)`, weighted by `weight` of the first channel's values.
/// `(x, y)` must not be on the map's edge.
pub(super) fn centroid(map: &Map, [x, y]: [usize; 2], weight: impl Fn(f32) -> f32) -> [f32; 2] {
    let (mut sum, mut moment) = (0.0, [0.0, 0.0]);
    for dy in 0..3 {
        for dx in 0..3 {
            let w = weight(map.at(0, x + dx - 1, y + dy - 1));
            sum += w;
            moment[0] += w * (dx as f32 - 1.0);
            moment[1] += w * (dy as f32 - 1.0);
        }
    }
    let offset = moment.map(|m| m / sum);
    if offset.iter().all(|o| o.is_finite()) { offset } else { [0.0, 0.0] }
}

/// A value of a map as a weighted sum of `N` of them: index in the channel (margin included) and weight.
pub(super) type Taps<const N: usize> = [(usize, f32); N];

/// Bilinear interpolation at `(x, y)` pixels of a map of this size, zeros around it.
pub(super) fn bilinear(map: &Map, [x, y]: [f32; 2]) -> Taps<4> {
    let (x0, y0) = (x.floor(), y.floor());
    let (fx, fy) = (x - x0, y - y0);
    let weights =
        [(0, 0, (1.0 - fx) * (1.0 - fy)), (1, 0, fx * (1.0 - fy)), (0, 1, (1.0 - fx) * fy), (1, 1, fx * fy)];
    weights.map(|(dx, dy, w)| tap(map, x0 as i64 + dx, y0 as i64 + dy, w))
}

/// Bicubic interpolation (Keys' kernel, A = -0.75) at `(x, y)` pixels of a map of this size, zeros around it.
pub(super) fn bicubic(map: &Map, [x, y]: [f32; 2]) -> Taps<16> {
    const A: f32 = -0.75;
    let (x0, y0) = (x.floor(), y.floor());
    let weights = |t: f32| {
        let near = |d: f32| ((A + 2.0) * d - (A + 3.0)) * d * d + 1.0;
        let far = |d: f32| ((A * d - 5.0 * A) * d + 8.0 * A) * d - 4.0 * A;
        [far(t + 1.0), near(t), near(1.0 - t), far(2.0 - t)]
    };
    let (wx, wy) = (weights(x - x0), weights(y - y0));
    std::array::from_fn(|i| {
        let (dx, dy) = (i % 4, i / 4);
        tap(map, x0 as i64 + dx as i64 - 1, y0 as i64 + dy as i64 - 1, wx[dx] * wy[dy])
    })
}

fn tap(map: &Map, x: i64, y: i64, weight: f32) -> (usize, f32) {
    let inside = |v: i64, size: usize| usize::try_from(v).ok().filter(|v| *v < size);
    match (inside(x, map.width()), inside(y, map.height())) {
        (Some(x), Some(y)) => ((y + 1) * map.stride() + x + 1, weight),
        _ => (0, 0.0),
    }
}

/// The map's values at some points, as the pixels of a map of one row.
pub(super) fn sample<const N: usize>(map: &Map, points: &[Taps<N>]) -> Map {
    let mut out = Map::zeros(map.channels(), points.len(), 1);
    for (c, channel) in map.data().chunks_exact(map.plane()).take(map.channels()).enumerate() {
        for (value, taps) in out.row_mut(c, 0).iter_mut().zip(points) {
            *value = taps.iter().map(|&(at, w)| w * channel[at]).sum();
        }
    }
    out
}

/// The columns of a map of one row, one after the other, each of length 1.
pub(super) fn descriptors(mut map: Map) -> Vec<f32> {
    map.normalise_pixels();
    let len = map.channels();
    let mut out = vec![0.0; len * map.width()];
    for c in 0..len {
        for (descriptor, value) in out.chunks_exact_mut(len).zip(map.row(c, 0)) {
            descriptor[c] = *value;
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn maxima_are_isolated_allowed_and_above_the_threshold() {
        let peaks =
            [([8, 8], 5.0), ([10, 9], 4.0), ([20, 8], 3.0), ([14, 20], 0.5), ([2, 20], 9.0), ([25, 25], 2.0)];
        let map = Map::from_fn(1, 32, 32, |_, x, y| {
            peaks.iter().find(|(p, _)| *p == [x, y]).map_or(-1.0, |(_, v)| *v)
        });
        let allowed = Mask::from_fn(32, 32, |x, _| u8::from(x < 24));
        assert_eq!(local_maxima(&map, &allowed, 4, 1.0), [[8, 8], [20, 8]]);
        // Of a plateau, one pixel is left in each window.
        let flat = Map::from_fn(1, 32, 32, |_, _, _| 1.0);
        assert_eq!(local_maxima(&flat, &Mask::filled(32, 32, 1), 1, 0.0).len(), 0);
        assert!(local_maxima(&flat, &Mask::default(), 1, 0.0).is_empty());
    }

    #[test]
    fn the_centroid_of_a_blob_is_its_centre() {
        let blob =
            |_: usize, x: usize, y: usize| -((x as f32 - 5.3).powi(2) + (y as f32 - 6.8).powi(2)) * 1.5;
        let map = Map::from_fn(1, 12, 12, blob);
        let [dx, dy] = centroid(&map, [5, 7], f32::exp);
        assert!((dx - 0.3).abs() < 0.05 && (dy + 0.2).abs() < 0.05, "{dx} {dy}");
        assert_eq!(centroid(&map, [5, 7], |_| 0.0), [0.0, 0.0]);
    }

    #[test]
    fn interpolation_reproduces_planes() {
        let map = Map::from_fn(2, 12, 10, |c, x, y| 1.0 + c as f32 + 2.0 * x as f32 - 3.0 * y as f32);
        let points = [[4.3, 5.8], [2.0, 7.0], [8.5, 2.25]];
        let exact = |c: usize, p: [f32; 2]| 1.0 + c as f32 + 2.0 * p[0] - 3.0 * p[1];
        let two = sample(&map, &points.map(|p| bilinear(&map, p)));
        let cubic = sample(&map, &points.map(|p| bicubic(&map, p)));
        for (k, p) in points.into_iter().enumerate() {
            for c in 0..2 {
                assert!((two.at(c, k, 0) - exact(c, p)).abs() < 1e-4);
                // Keys' kernel with A = -0.75 is not exact on ramps between pixels; it is on constants and at pixels.
                assert!((cubic.at(c, k, 0) - exact(c, p)).abs() < 0.6);
            }
        }
        let taps = bicubic(&map, [4.3, 5.8]);
        assert!((taps.iter().map(|t| t.1).sum::<f32>() - 1.0).abs() < 1e-5);
        assert!((cubic.at(0, 1, 0) - exact(0, points[1])).abs() < 1e-4);
        // Outside are zeros.
        assert_eq!(sample(&map, &[bilinear(&map, [-3.0, 2.0])]).at(0, 0, 0), 0.0);
        assert!((sample(&map, &[bilinear(&map, [-0.5, 0.0])]).at(0, 0, 0) - 0.5).abs() < 1e-6);
    }

    #[test]
    fn descriptors_have_unit_length() {
        let d = descriptors(Map::from_fn(3, 4, 1, |c, x, _| (1 + c * x) as f32));
        assert_eq!(d.len(), 12);
        assert!(d.chunks_exact(3).all(|d| (d.iter().map(|v| v * v).sum::<f32>() - 1.0).abs() < 1e-5));
        assert!((d[3 + 2] / d[3] - 3.0).abs() < 1e-5);
    }
}
