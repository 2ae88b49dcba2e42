//! Which pixel centres a triangle covers.

/// Tolerance of a triangle's edges, so that no pixel between two triangles is left out.
const SEAM: f64 = 1e-9;

/// Calls `visit(x, y, weights)` for every pixel centre (at integers) of a `width` x `height` image inside the
/// triangle; `weights` are barycentric, affine in the image.
pub(super) fn cover(
    corners: [[f64; 2]; 3],
    width: usize,
    height: usize,
    mut visit: impl FnMut(usize, usize, [f64; 3]),
) {
    let [a, b, c] = corners;
    let area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1]);
    let range = |k: usize, size: usize| {
        let (low, high) = (a[k].min(b[k]).min(c[k]), a[k].max(b[k]).max(c[k]));
        let last = size as f64 - 1.0;
        (low <= last && high >= 0.0).then(|| (low.max(0.0).ceil() as usize, high.min(last).floor() as usize))
    };
    // Written so that a NaN fails it.
    let sized = area.abs() > 1e-12;
    let (Some(columns), Some(rows)) = (range(0, width), range(1, height)) else { return };
    if !sized {
        return;
    }
    for y in rows.0..=rows.1 {
        let v = y as f64;
        for x in columns.0..=columns.1 {
            let u = x as f64;
            let side =
                |p: [f64; 2], q: [f64; 2]| ((q[0] - p[0]) * (v - p[1]) - (u - p[0]) * (q[1] - p[1])) / area;
            let weights = [side(b, c), side(c, a), side(a, b)];
            if weights.iter().all(|w| *w >= -SEAM) {
                visit(x, y, weights);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_triangles_cover_a_square_and_weights_are_linear() {
        let mut count = 0;
        let [a, b, c, d] = [[0.5, 0.5], [7.5, 0.5], [7.5, 5.5], [0.5, 5.5]];
        for corners in [[a, b, c], [a, c, d], [c, b, a]] {
            cover(corners, 20, 20, |x, y, w| {
                count += 1;
                for (k, p) in [x as f64, y as f64].into_iter().enumerate() {
                    let at: f64 = (0..3).map(|i| w[i] * corners[i][k]).sum();
                    assert!((at - p).abs() < 1e-9);
                }
            });
        }
        // 7 x 5 centres; the triangle given twice covers about half of them again.
        assert!((35 + 15..=35 + 20).contains(&count), "{count}");
    }

    #[test]
    fn outside_and_degenerate_triangles_cover_nothing() {
        for corners in [
            [[-5.0, -5.0], [-1.0, -5.0], [-1.0, -1.0]],
            [[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]],
            [[f64::NAN, 1.0], [2.0, 2.0], [3.0, 5.0]],
            [[50.0, 1.0], [60.0, 2.0], [55.0, 9.0]],
        ] {
            cover(corners, 10, 10, |_, _, _| panic!("covered"));
        }
    }
}
