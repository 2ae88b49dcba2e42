//! The pixels that a mesh covers, and the line around them.

use marching_cubes::TriMesh;
use nalgebra::Isometry3;
use rgbd_io::{Intrinsics, Mask};

/// 255 wherever the mesh projects; triangles that reach behind the camera are left out.
pub(super) fn silhouette(
    mesh: &TriMesh,
    cam_from_obj: &Isometry3<f64>,
    intrinsics: &Intrinsics,
    (width, height): (usize, usize),
) -> Mask {
    let mut mask = Mask::filled(width, height, 0);
    let pixels: Vec<Option<[f64; 2]>> = mesh
        .vertices
        .iter()
        .map(|v| intrinsics.project(crate::rigid::moved_point(cam_from_obj, *v).map(f64::from)))
        .collect();
    for triangle in &mesh.triangles {
        let corner = |i: u32| pixels.get(i as usize).copied().flatten();
        if let [Some(a), Some(b), Some(c)] = triangle.map(corner) {
            fill(&mut mask, [a, b, c]);
        }
    }
    mask
}

/// Fills the pixels whose centre lies in the triangle, and those that its corners fall on: a triangle smaller than
/// a pixel still covers something.
fn fill(mask: &mut Mask, [a, b, c]: [[f64; 2]; 3]) {
    let (width, height) = mask.size();
    let inside = |v: f64, size: usize| v.clamp(0.0, size as f64) as usize;
    let low = |i: usize| a[i].min(b[i]).min(c[i]);
    let high = |i: usize| a[i].max(b[i]).max(c[i]);
    let area = cross(a, b, c);
    let row_width = width;
    let columns = inside(low(0).ceil(), width)..inside(high(0).floor() + 1.0, width);
    for y in inside(low(1).ceil(), height)..inside(high(1).floor() + 1.0, height) {
        for x in columns.clone() {
            let p = [x as f64, y as f64];
            let signs = [cross(a, b, p), cross(b, c, p), cross(c, a, p)];
            if signs.iter().all(|s| s * area >= 0.0) {
                mask.pixels_mut()[y * row_width + x] = 255;
            }
        }
    }
    for p in [a, b, c] {
        let (x, y) = (p[0].round(), p[1].round());
        if x >= 0.0 && y >= 0.0 && (x as usize) < width && (y as usize) < height {
            mask.pixels_mut()[y as usize * row_width + x as usize] = 255;
        }
    }
}

fn cross(a: [f64; 2], b: [f64; 2], p: [f64; 2]) -> f64 {
    (b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0])
}

/// How much of each pixel belongs to a soft line of about two pixels along the border of the mask, 0 to 255.
pub(super) fn outline(mask: &Mask) -> Mask {
    let (width, height) = mask.size();
    let at = |x: usize, dx: isize, y: usize, dy: isize| {
        // Outside of the image it goes on as at its border, so that no line runs along that.
        let x = x.saturating_add_signed(dx).min(width - 1);
        let y = y.saturating_add_signed(dy).min(height - 1);
        u32::from(mask.row(y)[x] != 0)
    };
    Mask::from_fn(width, height, |x, y| {
        let mut covered = 0;
        for dy in -1..=1 {
            for dx in -1..=1 {
                covered += at(x, dx, y, dy);
            }
        }
        // 0 and 9 of 9 are inside and outside; halfway is the line's middle.
        let off = (covered as f32 / 9.0 - 0.5).abs() * 2.0;
        ((1.0 - off) * 1.9 * 255.0).clamp(0.0, 255.0) as u8
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_triangle_covers_its_pixels_and_no_others() {
        let mut mask = Mask::filled(20, 20, 0);
        fill(&mut mask, [[2.0, 2.0], [10.0, 2.0], [2.0, 10.0]]);
        for y in 0..20 {
            for x in 0..20 {
                let inside = x >= 2 && y >= 2 && x + y <= 12;
                assert_eq!(mask.row(y)[x] != 0, inside, "{x} {y}");
            }
        }
    }

    #[test]
    fn far_outside_and_not_finite_is_harmless() {
        let mut mask = Mask::filled(8, 8, 0);
        fill(&mut mask, [[-1e12, -5.0], [1e12, -4.0], [3.0, -1.0]]);
        fill(&mut mask, [[f64::NAN, 1.0], [2.0, f64::INFINITY], [3.0, 3.0]]);
        assert!(mask.pixels().iter().filter(|p| **p != 0).count() <= 64);
    }

    #[test]
    fn the_outline_of_a_full_image_is_empty() {
        assert!(outline(&Mask::filled(9, 9, 255)).pixels().iter().all(|p| *p == 0));
        let half = Mask::from_fn(9, 9, |x, _| if x < 4 { 255 } else { 0 });
        let line = outline(&half);
        assert!(line.row(4)[3] > 100 && line.row(4)[4] > 100 && line.row(4)[0] == 0 && line.row(4)[8] == 0);
    }
}
