//! How many pixels an object would cover if nothing was in front of it.

use nalgebra::{Isometry3, Point3};

use super::ModelMesh;
use crate::Intrinsics;

/// Pixels of an image of `size` whose centre sees the mesh.
pub(super) fn area(
    mesh: &ModelMesh,
    cam_from_obj: &Isometry3<f64>,
    k: &Intrinsics,
    size: (usize, usize),
) -> usize {
    let (width, height) = size;
    let mut covered = vec![false; width * height];
    let project = |v: &[f64; 3]| k.project((cam_from_obj * Point3::from(*v)).coords.into());
    let corners: Vec<Option<[f64; 2]>> = mesh.vertices.iter().map(project).collect();
    for t in &mesh.triangles {
        if let [Some(Some(a)), Some(Some(b)), Some(Some(c))] = t.map(|i| corners.get(i as usize)) {
            fill([*a, *b, *c], width, &mut covered);
        }
    }
    covered.into_iter().filter(|c| *c).count()
}

/// Marks the pixels inside a triangle, row by row.
fn fill(t: [[f64; 2]; 3], width: usize, covered: &mut [bool]) {
    let height = covered.len() / width.max(1);
    let (top, bottom) = t.iter().fold((f64::MAX, f64::MIN), |(a, b), p| (a.min(p[1]), b.max(p[1])));
    // Also false for NaN.
    let in_view = bottom >= 0.0 && top < height as f64;
    if !in_view {
        return;
    }
    for y in top.ceil().max(0.0) as usize..(bottom.floor() as usize).saturating_add(1).min(height) {
        let row = y as f64;
        let (mut left, mut right) = (f64::MAX, f64::MIN);
        for i in 0..3 {
            let ([x0, y0], [x1, y1]) = (t[i], t[(i + 1) % 3]);
            if (y0 <= row) != (y1 <= row) {
                let x = x0 + (row - y0) / (y1 - y0) * (x1 - x0);
                (left, right) = (left.min(x), right.max(x));
            }
        }
        if right >= 0.0 && left <= right {
            let (from, to) =
                (left.ceil().max(0.0) as usize, (right.floor() as usize).saturating_add(1).min(width));
            if let Some(pixels) = covered.get_mut(y * width + from.min(to)..y * width + to) {
                pixels.fill(true);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_square_covers_its_pixels() {
        let vertices = vec![[-0.1, -0.1, 0.0], [0.1, -0.1, 0.0], [0.1, 0.1, 0.0], [-0.1, 0.1, 0.0]];
        let mesh = ModelMesh { vertices, triangles: vec![[0, 1, 2], [0, 2, 3], [9, 0, 1]] };
        let k = Intrinsics { fx: 101.0, fy: 101.0, cx: 50.0, cy: 40.0 };
        let at = |x: f64, z: f64| area(&mesh, &Isometry3::translation(x, 0.0, z), &k, (100, 80));
        assert_eq!(at(0.0, 1.0), 21 * 21);
        // Half of it beyond the left edge; behind the camera; far away.
        assert_eq!(at(-50.0 / 101.0, 1.0), 11 * 21);
        assert_eq!(at(0.0, -1.0), 0);
        assert_eq!(at(1e12, 1.0), 0);
        assert_eq!(area(&mesh, &Isometry3::translation(f64::NAN, 0.0, 1.0), &k, (100, 80)), 0);
        assert_eq!(area(&mesh, &Isometry3::translation(0.0, 0.0, 1.0), &k, (0, 0)), 0);
        // A corner just in front of the camera lies farther out than pixels can be counted.
        let vertices = vec![[0.0, 0.0, 1.0], [-0.1, 0.0, 1.0], [0.1, 0.1, 1e-30]];
        let near = ModelMesh { vertices, triangles: vec![[0, 1, 2]] };
        assert!(area(&near, &Isometry3::identity(), &k, (100, 80)) > 100);
    }
}
