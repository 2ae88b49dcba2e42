//! Depth clean-up on the object's crop: edge-safe smoothing, organised cloud, normals, grazing filter.

use rgbd_io::{Image, Intrinsics, Mask};

/// Standard deviation of a structured-light or time-of-flight depth reading at depth `z` (metres): the axial model of
/// Nguyen, Izadi and Lovell, "Modeling Kinect Sensor Noise", 3DIMPVT 2012.
#[must_use]
pub fn depth_sigma(z: f64) -> f64 {
    0.0012 + 0.0019 * (z - 0.4) * (z - 0.4)
}

/// Averages every masked reading with pairs of masked neighbours on opposite sides (a 5x5 window, Gaussian weights)
/// whose middle is within `gate` metres of it.
///
/// Whole pairs leave a slope as it is. Single neighbours would not at the rim of the mask, where the surface turns away
/// and those on one side are missing: it would come nearer by millimetres, on the left and on the right, and an object
/// that turns would seem to turn less. Only readings inside the mask take part, so that an occluder's depth doesn't bleed
/// into the object's rim; the gate grows with the square of the depth as the sensor's noise does. Readings outside the
/// mask become `0`.
pub(crate) fn smooth(depth: &Image<f32>, mask: &Mask, gate: f32) -> Image<f32> {
    const RADIUS: usize = 2;
    const SPATIAL: [f32; 3] = [1.0, 0.8825, 0.6065];
    let (width, height) = depth.size();
    // With a border of nothing, so that every pixel has all neighbours.
    let stride = width + 2 * RADIUS;
    let mut masked = vec![0.0_f32; stride * (height + 2 * RADIUS)];
    for y in 0..height {
        let start = (y + RADIUS) * stride + RADIUS;
        for ((out, d), m) in masked[start..start + width].iter_mut().zip(depth.row(y)).zip(mask.row(y)) {
            *out = if *m != 0 { *d } else { 0.0 };
        }
    }
    let mut smoothed = Vec::with_capacity(width * height);
    let (mut sums, mut weights, mut gates) =
        (vec![0.0_f32; width], vec![0.0_f32; width], vec![0.0_f32; width]);
    for y in 0..height {
        let at = (y + RADIUS) * stride + RADIUS;
        let centre = &masked[at..at + width];
        sums.copy_from_slice(centre);
        weights.fill(1.0);
        gates.iter_mut().zip(centre).for_each(|(g, c)| *g = gate * (c * c).max(0.5));
        for dy in 0..=RADIUS {
            // One of each two opposite offsets.
            let first = if dy == 0 { 1 } else { -(RADIUS as isize) };
            for dx in first..=RADIUS as isize {
                let (back, ahead) = ((at - dy * stride).wrapping_add_signed(-dx), at + dy * stride);
                let ahead = ahead.wrapping_add_signed(dx);
                let weight = SPATIAL[dy] * SPATIAL[dx.unsigned_abs()];
                let pairs = masked[back..back + width].iter().zip(&masked[ahead..ahead + width]);
                let out = sums.iter_mut().zip(&mut weights);
                for (((a, b), (c, gate)), (sum, total)) in pairs.zip(centre.iter().zip(&gates)).zip(out) {
                    let middle = 0.5 * (a + b);
                    let near = (middle - c).abs() <= *gate;
                    let w = if (*a > 0.0) & (*b > 0.0) & near { 2.0 * weight } else { 0.0 };
                    *sum += w * middle;
                    *total += w;
                }
            }
        }
        smoothed.extend(sums.iter().zip(&weights).zip(centre).map(
            |((sum, total), c)| {
                if *c > 0.0 { sum / total } else { 0.0 }
            },
        ));
    }
    Image::from_vec(width, height, smoothed).unwrap_or_else(|| Image::filled(width, height, 0.0))
}

/// The organised cloud: camera-frame points in metres, all zero where depth is missing.
pub(crate) fn cloud(depth: &Image<f32>, k: &Intrinsics) -> Image<[f32; 3]> {
    let (rx, ry) = ((1.0 / k.fx) as f32, (1.0 / k.fy) as f32);
    let (cx, cy) = (k.cx as f32, k.cy as f32);
    Image::from_fn(depth.width(), depth.height(), |x, y| {
        let z = depth[(x, y)];
        if z > 0.0 { [(x as f32 - cx) * rx * z, (y as f32 - cy) * ry * z, z] } else { [0.0; 3] }
    })
}

/// Unit normals towards the camera from central differences two pixels wide, one-sided at rims; zero where a
/// neighbour is missing or jumps by more than 2 cm.
pub(crate) fn normals(points: &Image<[f32; 3]>) -> Image<[f32; 3]> {
    const STEP: usize = 2;
    const JUMP: f32 = 0.02;
    let (width, height) = points.size();
    let neighbour = |x: Option<usize>, y: Option<usize>, centre: [f32; 3]| -> Option<[f32; 3]> {
        let p = *points.get(x?, y?)?;
        (p[2] > 0.0 && (p[2] - centre[2]).abs() <= JUMP).then_some(p)
    };
    let tangent = |before: Option<[f32; 3]>, centre: [f32; 3], after: Option<[f32; 3]>| match (before, after)
    {
        (Some(a), Some(b)) => Some(sub(b, a)),
        (Some(a), None) => Some(sub(centre, a)),
        (None, Some(b)) => Some(sub(b, centre)),
        (None, None) => None,
    };
    Image::from_fn(width, height, |x, y| {
        let p = points[(x, y)];
        if p[2] <= 0.0 {
            return [0.0; 3];
        }
        let (sx, sy) = (Some(x), Some(y));
        let du = tangent(neighbour(x.checked_sub(STEP), sy, p), p, neighbour(Some(x + STEP), sy, p));
        let dv = tangent(neighbour(sx, y.checked_sub(STEP), p), p, neighbour(sx, Some(y + STEP), p));
        let (Some(du), Some(dv)) = (du, dv) else { return [0.0; 3] };
        let n = cross(dv, du);
        let length = dot(n, n).sqrt();
        if length <= f32::MIN_POSITIVE {
            return [0.0; 3];
        }
        let towards_camera = if dot(n, p) > 0.0 { -1.0 / length } else { 1.0 / length };
        [n[0] * towards_camera, n[1] * towards_camera, n[2] * towards_camera]
    })
}

/// Drops depth, points and normals where the surface is seen at less than `grazing_deg` degrees.
pub(crate) fn drop_grazing(
    depth: &mut Image<f32>,
    points: &mut Image<[f32; 3]>,
    normals: &mut Image<[f32; 3]>,
    grazing_deg: f32,
) {
    let limit = grazing_deg.to_radians().sin();
    for ((d, p), n) in depth.pixels_mut().iter_mut().zip(points.pixels_mut()).zip(normals.pixels_mut()) {
        let range = dot(*p, *p).sqrt();
        if *d > 0.0 && dot(*n, *n) > 0.0 && -dot(*n, *p) < limit * range {
            *d = 0.0;
            *p = [0.0; 3];
            *n = [0.0; 3];
        }
    }
}

pub(crate) fn sub(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

pub(crate) fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn cross(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

#[cfg(test)]
mod tests {
    use super::*;

    const K: Intrinsics = Intrinsics { fx: 100.0, fy: 120.0, cx: 15.5, cy: 15.5 };

    /// Depth of the plane `n . p = d` through every pixel.
    fn plane(n: [f64; 3], d: f64) -> Image<f32> {
        Image::from_fn(32, 32, |x, y| {
            let ray = K.unproject(x as f64, y as f64, 1.0);
            (d / (n[0] * ray[0] + n[1] * ray[1] + n[2] * ray[2])) as f32
        })
    }

    #[test]
    fn normals_of_a_tilted_plane_are_its_normal_everywhere() {
        let n = [0.3_f64, -0.2, -0.9327379];
        let normals = normals(&cloud(&plane(n, -0.5), &K));
        for p in normals.pixels() {
            for i in 0..3 {
                assert!((f64::from(p[i]) - n[i]).abs() < 1e-3, "{p:?}");
            }
        }
    }

    #[test]
    fn smoothing_keeps_a_step_edge_and_ignores_what_is_outside_the_mask() {
        let depth = Image::from_fn(20, 5, |x, _| if x < 10 { 0.5 } else { 0.6 });
        let all = Image::filled(20, 5, 255);
        for (smoothed, exact) in smooth(&depth, &all, 0.01).pixels().iter().zip(depth.pixels()) {
            assert!((smoothed - exact).abs() < 1e-6);
        }
        let left = Image::from_fn(20, 5, |x, _| if x < 9 { 255 } else { 0 });
        let close = Image::from_fn(20, 5, |x, _| if x < 9 { 0.5 } else { 0.504 });
        let smoothed = smooth(&close, &left, 0.01);
        assert!((smoothed[(8, 2)] - 0.5).abs() < 1e-6);
        assert_eq!(smoothed[(9, 2)], 0.0);
    }

    #[test]
    fn smoothing_leaves_a_slope_as_it_is_up_to_the_rim_of_the_mask() {
        let slope = plane([0.94, 0.0, -0.3411], -0.2);
        let mask =
            Image::from_fn(32, 32, |x, y| u8::from((6..20).contains(&x) && (3 + x / 4..25).contains(&y)));
        let smoothed = smooth(&slope, &mask, 0.01);
        for (k, m) in mask.pixels().iter().enumerate() {
            let (got, exact) = (smoothed.pixels()[k], slope.pixels()[k]);
            if *m == 0 {
                assert_eq!(got, 0.0);
                continue;
            }
            // A plane is not quite linear in the pixel: the middle of two neighbours bends away from it.
            let bend = 0.5 * (slope.pixels()[k - 2] + slope.pixels()[k + 2]) - exact;
            let step = (slope.pixels()[k + 1] - exact).abs();
            assert!(bend.abs() < 0.2 * step, "what a lopsided mean would do is much more");
            assert!((got - exact).abs() < bend.abs() + 1e-5, "{k}: {got} {exact}");
        }
    }

    #[test]
    fn smoothing_reduces_noise_on_a_plane_threefold() {
        let mut state = 1_u32;
        let noisy = Image::from_fn(60, 60, |_, _| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            0.7 + 0.002 * ((state >> 8) as f32 / 8_388_608.0 - 1.0)
        });
        let spread = |image: &Image<f32>| {
            let n = image.pixels().len() as f32;
            (image.pixels().iter().map(|d| (d - 0.7) * (d - 0.7)).sum::<f32>() / n).sqrt()
        };
        let smoothed = smooth(&noisy, &Image::filled(60, 60, 1), 0.01);
        assert!(spread(&smoothed) < spread(&noisy) / 3.0, "{} {}", spread(&smoothed), spread(&noisy));
    }

    #[test]
    fn grazing_surface_is_dropped_and_frontal_surface_kept() {
        for (n, kept) in [([0.0, 0.0, -1.0], true), ([0.9987, 0.0, -0.05], false)] {
            let mut depth = Image::filled(32, 32, 0.5);
            let mut points = cloud(&depth, &K);
            let mut normals = Image::filled(32, 32, n);
            let centre = (15, 15);
            drop_grazing(&mut depth, &mut points, &mut normals, 10.0);
            assert_eq!(depth[centre] > 0.0, kept);
            assert_eq!(points[centre][2] > 0.0, kept);
            assert_eq!(normals[centre] != [0.0; 3], kept);
        }
    }
}
