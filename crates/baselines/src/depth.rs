//! Depth images: cleaning, smoothing, halving and interpolation, none of which may mix two surfaces.

use rgbd_io::{Image, Intrinsics};

/// The largest step of depth (metres) between neighbouring pixels of one surface at depth `z`: a slope of 79 degrees,
/// and room for noise that grows with the square of the distance.
#[inline]
pub(crate) fn largest_step(z: f32, k: &Intrinsics) -> f32 {
    5.0 * z / k.fx as f32 + 0.003 + 0.003 * z * z
}

/// Drops pixels that fewer than four of their eight neighbours support: flying pixels between two surfaces.
pub(crate) fn without_flying(depth: &Image<f32>, k: &Intrinsics) -> Image<f32> {
    let (width, height) = depth.size();
    let px = depth.pixels();
    Image::from_fn(width, height, |x, y| {
        let z = px[y * width + x];
        if z <= 0.0 {
            return 0.0;
        }
        let step = largest_step(z, k);
        let mut support = 0;
        for v in y.saturating_sub(1)..(y + 2).min(height) {
            for u in x.saturating_sub(1)..(x + 2).min(width) {
                let other = px[v * width + u];
                support += usize::from(other > 0.0 && (other - z).abs() <= step);
            }
        }
        // The pixel itself counts as well.
        if support > 4 { z } else { 0.0 }
    })
}

/// Bilateral filter (Tomasi and Manduchi 1998), as KinectFusion smooths depth before it takes normals.
///
/// The range kernel is as wide as the noise of a depth camera and no wider, so that a curved surface keeps its shape.
pub(crate) fn bilateral(depth: &Image<f32>) -> Image<f32> {
    const RADIUS: usize = 2;
    const SIGMA_PIXELS: f32 = 1.5;
    let (width, height) = depth.size();
    let px = depth.pixels();
    let spatial: [[f32; 2 * RADIUS + 1]; 2 * RADIUS + 1] = std::array::from_fn(|i| {
        std::array::from_fn(|j| {
            let (dy, dx) = (i as f32 - RADIUS as f32, j as f32 - RADIUS as f32);
            (-0.5 * (dx * dx + dy * dy) / (SIGMA_PIXELS * SIGMA_PIXELS)).exp()
        })
    });
    Image::from_fn(width, height, |x, y| {
        let z = px[y * width + x];
        if z <= 0.0 {
            return 0.0;
        }
        let sigma = 0.001 + 0.004 * z * z;
        let inverse = 1.0 / (9.0 * sigma * sigma);
        let (mut sum, mut total) = (0.0, 0.0);
        for v in y.saturating_sub(RADIUS)..(y + RADIUS + 1).min(height) {
            let row = &px[v * width..(v + 1) * width];
            for u in x.saturating_sub(RADIUS)..(x + RADIUS + 1).min(width) {
                let other = row[u];
                // Tukey's kernel in place of a Gaussian of the same width: no exponential, and a hard end.
                let s = 1.0 - (other - z) * (other - z) * inverse;
                if other > 0.0 && s > 0.0 {
                    let w = spatial[v + RADIUS - y][u + RADIUS - x] * s * s;
                    sum += w * other;
                    total += w;
                }
            }
        }
        // The pixel itself always has weight.
        sum / total
    })
}

/// Half the resolution: the mean of what belongs to the nearest surface in each block of 2x2.
///
/// Goes with `k.scaled(0.5, 0.5)`; an odd last row or column is left out.
pub(crate) fn halved(depth: &Image<f32>, k: &Intrinsics) -> Image<f32> {
    let width = depth.width();
    let px = depth.pixels();
    Image::from_fn(width / 2, depth.height() / 2, |x, y| {
        let at = 2 * y * width + 2 * x;
        let block = [px[at], px[at + 1], px[at + width], px[at + width + 1]];
        let near = block.iter().copied().filter(|&z| z > 0.0).fold(f32::INFINITY, f32::min);
        if near.is_infinite() {
            return 0.0;
        }
        let step = largest_step(near, k);
        let same = block.iter().filter(|&&z| z > 0.0 && z - near <= step);
        let (sum, count) = same.fold((0.0, 0.0), |(s, n), z| (s + z, n + 1.0));
        sum / count
    })
}

/// Depth at a point between pixels, with its derivatives along u and v (metres per pixel).
///
/// `None` unless all four pixels around it are on one surface.
#[inline]
pub(crate) fn interpolated(depth: &Image<f32>, u: f32, v: f32, k: &Intrinsics) -> Option<[f32; 3]> {
    let (width, height) = depth.size();
    // False for NaN, and before the conversion to integers, so that infinity can't overflow.
    let inside = u >= 0.0 && v >= 0.0 && u + 1.0 < width as f32 && v + 1.0 < height as f32;
    if !inside {
        return None;
    }
    let (x, y) = (u as usize, v as usize);
    let at = y * width + x;
    let px = depth.pixels();
    let [a, b, c, d] = [px[at], px[at + 1], px[at + width], px[at + width + 1]];
    let (low, high) = (a.min(b).min(c.min(d)), a.max(b).max(c.max(d)));
    // Every pixel by itself: `min` and `max` pass over NaN.
    let all = [a, b, c, d].iter().all(|z| *z > 0.0);
    if !all || high - low > 1.5 * largest_step(low, k) {
        return None;
    }
    let (fu, fv) = (u - x as f32, v - y as f32);
    let (top, bottom) = (a + fu * (b - a), c + fu * (d - c));
    let du = (1.0 - fv) * (b - a) + fv * (d - c);
    Some([top + fv * (bottom - top), du, bottom - top])
}

#[cfg(test)]
mod tests {
    use super::*;

    const K: Intrinsics = Intrinsics { fx: 500.0, fy: 500.0, cx: 10.0, cy: 10.0 };

    #[test]
    fn surfaces_are_not_mixed() {
        let step = Image::from_fn(20, 20, |x, _| if x < 10 { 0.5 } else { 0.7 });
        assert!(bilateral(&step).pixels().iter().zip(step.pixels()).all(|(a, b)| (a - b).abs() < 1e-6));
        let half = halved(&Image::from_fn(20, 20, |x, _| if x < 9 { 0.5 } else { 0.7 }), &K);
        assert_eq!(half.size(), (10, 10));
        assert_eq!((half[(3, 3)], half[(4, 3)]), (0.5, 0.5));
        assert!((half[(5, 3)] - 0.7).abs() < 1e-6);
        assert_eq!(interpolated(&step, 9.5, 3.0, &K), None);
        assert!(interpolated(&step, 8.5, 3.0, &K).is_some());
        let mut flying = step.clone();
        flying[(10, 5)] = 0.6;
        flying[(0, 0)] = 0.0;
        let cleaned = without_flying(&flying, &K);
        assert_eq!((cleaned[(10, 5)], cleaned[(0, 0)], cleaned[(9, 5)]), (0.0, 0.0, 0.5));
    }

    #[test]
    fn a_plane_is_interpolated_exactly() {
        let plane = Image::from_fn(8, 8, |x, y| 0.5 + 0.001 * x as f32 - 0.002 * y as f32);
        let [z, du, dv] = interpolated(&plane, 2.25, 3.5, &K).unwrap();
        assert!((z - (0.5 + 0.00225 - 0.007)).abs() < 1e-6);
        assert!((du - 0.001).abs() < 1e-6 && (dv + 0.002).abs() < 1e-6);
        for (u, v) in [(-0.1, 1.0), (7.0, 1.0), (f32::NAN, 1.0), (1.0, f32::INFINITY)] {
            assert_eq!(interpolated(&plane, u, v, &K), None);
        }
    }
}
