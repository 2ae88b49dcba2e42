//! A frame of the object's own: its oriented bounding box centred, z up.

use marching_cubes::TriMesh;
use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};
use serde::Serialize;

use crate::draw::OrientedBox;

/// The content of `canonical.json`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct CanonicalFrame {
    /// Row-major 4x4, object coordinates to canonical coordinates, metres.
    pub canonical_from_obj: [[f64; 4]; 4],
    /// Edges of the box along x, y and z, metres; it is centred on the origin.
    pub extents_m: [f64; 3],
}

/// The canonical frame of a mesh in the object frame; `None` without vertices.
///
/// The box is the smallest found by a search over rotations. z runs along the edge that differs most from the other
/// two: along a bottle, across a plate. Its sign is that of "up" in the first camera's image, and where that doesn't
/// tell, it points to the first camera. x runs along the longer of the other two edges, to the right in the first
/// camera's image.
#[must_use]
pub fn canonical_frame(mesh: &TriMesh) -> Option<CanonicalFrame> {
    let around = OrientedBox::around(&mesh.vertices)?;
    let [across, other, up] = roles(&around.size);
    let axis = |k: usize| around.obj_from_box.rotation * Vector3::ith(k, 1.0);
    // The object frame has the axes of the first camera: x right, y down, z forward.
    let z = signed(axis(up), -Vector3::y(), -Vector3::z());
    let x = signed(axis(across), Vector3::x(), -Vector3::z());
    let rows = Matrix3::from_rows(&[x.transpose(), z.cross(&x).transpose(), z.transpose()]);
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rows));
    let pose = Isometry3::from_parts(Translation3::from(-(rotation * around.centre().coords)), rotation);
    let m = pose.to_homogeneous();
    Some(CanonicalFrame {
        canonical_from_obj: std::array::from_fn(|r| std::array::from_fn(|c| m[(r, c)])),
        extents_m: [across, other, up].map(|k| around.size[k]),
    })
}

/// Which edges of the box become x, y and z.
fn roles(size: &Vector3<f64>) -> [usize; 3] {
    let mut order = [0, 1, 2];
    order.sort_unstable_by(|&a, &b| size[b].total_cmp(&size[a]));
    let [long, middle, short] = order;
    let is_flat = size[long] * size[short] < size[middle] * size[middle];
    if is_flat { [long, middle, short] } else { [middle, short, long] }
}

/// `a` or its opposite, along `wanted`, or along `otherwise` where that doesn't tell.
fn signed(a: Vector3<f64>, wanted: Vector3<f64>, otherwise: Vector3<f64>) -> Vector3<f64> {
    let along = if a.dot(&wanted).abs() > 0.1 { a.dot(&wanted) } else { a.dot(&otherwise) };
    if along < 0.0 { -a } else { a }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cuboid(half: [f32; 3], pose: &Isometry3<f64>) -> TriMesh {
        let mesh = marching_cubes::extract_fn([40; 3], [-0.2; 3], 0.4 / 39.0, 0.0, |p| {
            (0..3).map(|k| p[k].abs() - half[k]).fold(f32::NEG_INFINITY, f32::max)
        });
        mesh.transformed(|p| (pose * nalgebra::Point3::from(p.map(f64::from))).coords.cast().into())
    }

    #[test]
    fn a_box_stands_up_again_however_it_lay() {
        for (half, extents) in
            [([0.05, 0.15, 0.08], [0.16, 0.10, 0.30]), ([0.15, 0.03, 0.14], [0.30, 0.28, 0.06])]
        {
            for turn in [[0.3, 0.2, 0.1], [1.0, -0.7, 2.0], [0.0, 0.0, 0.0]] {
                let pose = Isometry3::new(Vector3::new(0.3, -0.1, 0.7), Vector3::from(turn));
                let mesh = cuboid(half, &pose);
                let frame = canonical_frame(&mesh).unwrap();
                for (a, b) in frame.extents_m.iter().zip(extents) {
                    assert!((a - b).abs() < 0.004, "{:?} {extents:?}", frame.extents_m);
                }
                let moved = mesh.transformed_by(&frame.canonical_from_obj);
                let (low, high) = moved.bounds().unwrap();
                for k in 0..3 {
                    assert!((low[k] + high[k]).abs() < 1e-3, "centred");
                    assert!((f64::from(high[k] - low[k]) - frame.extents_m[k]).abs() < 2e-3);
                }
                // A rotation, not a reflection: volume stays positive.
                assert!((moved.signed_volume() - mesh.signed_volume()).abs() < 1e-6);
            }
        }
    }

    #[test]
    fn up_is_up_in_the_first_image() {
        let frame = canonical_frame(&cuboid([0.04, 0.12, 0.05], &Isometry3::identity())).unwrap();
        // Canonical z against the object frame's y, which points down in the image.
        assert!(frame.canonical_from_obj[2][1] < -0.99, "{:?}", frame.canonical_from_obj);
        assert!(canonical_frame(&TriMesh::default()).is_none());
    }
}
