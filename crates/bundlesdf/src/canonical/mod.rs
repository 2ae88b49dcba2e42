//! A frame of the object's own: its oriented bounding box centred, z up.

use marching_cubes::TriMesh;
use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};
use serde::Serialize;

/// Directions whose farthest vertices stand for the mesh.
const DIRECTIONS: usize = 600;
/// Steps (degrees) of the search around a start.
const STEPS_DEG: [f64; 9] = [16.0, 8.0, 4.0, 2.0, 1.0, 0.5, 0.2, 0.1, 0.05];

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
    let points = extremes(mesh)?;
    let starts = (0..27).map(|i| {
        let angle = |k: u32| f64::from(i / 3u32.pow(k) % 3) * 30f64.to_radians();
        UnitQuaternion::from_euler_angles(angle(0), angle(1), angle(2))
    });
    let best = starts.map(|start| smallest_box(&points, start)).min_by(|a, b| a.0.total_cmp(&b.0))?.1;
    let rotation = upright(&best, &points);
    let [low, high] = span(&points, &rotation);
    let center = 0.5 * (low + high);
    let pose = Isometry3::from_parts(Translation3::from(-center), rotation);
    let m = pose.to_homogeneous();
    Some(CanonicalFrame {
        canonical_from_obj: std::array::from_fn(|r| std::array::from_fn(|c| m[(r, c)])),
        extents_m: (high - low).into(),
    })
}

/// The vertices farthest out, enough to measure boxes with.
fn extremes(mesh: &TriMesh) -> Option<Vec<Vector3<f64>>> {
    let vertices: Vec<_> = mesh.vertices.iter().map(|p| Vector3::from(p.map(f64::from))).collect();
    let farthest = |i: usize| {
        // A spiral of evenly spread directions.
        let z = 1.0 - 2.0 * (i as f64 + 0.5) / DIRECTIONS as f64;
        let (r, turn) = ((1.0 - z * z).sqrt(), i as f64 * 2.399_963_229_728_653);
        let direction = Vector3::new(r * turn.cos(), r * turn.sin(), z);
        (0..vertices.len())
            .max_by(|&a, &b| vertices[a].dot(&direction).total_cmp(&vertices[b].dot(&direction)))
    };
    let mut chosen: Vec<usize> = (0..DIRECTIONS).filter_map(farthest).collect();
    chosen.sort_unstable();
    chosen.dedup();
    (!chosen.is_empty()).then(|| chosen.into_iter().map(|i| vertices[i]).collect())
}

/// Lower and upper corner of the points' box in the rotated frame.
fn span(points: &[Vector3<f64>], rotation: &UnitQuaternion<f64>) -> [Vector3<f64>; 2] {
    let (mut low, mut high) = (Vector3::repeat(f64::INFINITY), Vector3::repeat(f64::NEG_INFINITY));
    for p in points {
        let q = rotation * p;
        low = low.inf(&q);
        high = high.sup(&q);
    }
    [low, high]
}

/// The smallest box near `start`: pattern search over small turns, ever finer.
fn smallest_box(points: &[Vector3<f64>], start: UnitQuaternion<f64>) -> (f64, UnitQuaternion<f64>) {
    let volume = |rotation: &UnitQuaternion<f64>| {
        let [low, high] = span(points, rotation);
        (high - low).product()
    };
    let (mut least, mut best) = (volume(&start), start);
    for step in STEPS_DEG {
        let mut improved = true;
        while improved {
            improved = false;
            for axis in [Vector3::x_axis(), Vector3::y_axis(), Vector3::z_axis()] {
                for sign in [1.0, -1.0] {
                    let turned = UnitQuaternion::from_axis_angle(&axis, sign * f64::to_radians(step)) * best;
                    let v = volume(&turned);
                    if v < least * (1.0 - 1e-9) {
                        (least, best, improved) = (v, turned, true);
                    }
                }
            }
        }
    }
    (least, best)
}

/// The box's rotation with its axes renamed and turned so that z is up.
fn upright(rotation: &UnitQuaternion<f64>, points: &[Vector3<f64>]) -> UnitQuaternion<f64> {
    let [low, high] = span(points, rotation);
    let extents = high - low;
    let mut order = [0, 1, 2];
    order.sort_unstable_by(|&a, &b| extents[b].total_cmp(&extents[a]));
    let [long, middle, short] = order;
    let is_flat = extents[long] * extents[short] < extents[middle] * extents[middle];
    let (up, across) = if is_flat { (short, long) } else { (long, middle) };
    let axis = |k: usize| -> Vector3<f64> { rotation.inverse() * Vector3::ith(k, 1.0) };
    // The object frame has the axes of the first camera: x right, y down, z forward.
    let signed = |a: Vector3<f64>, wanted: Vector3<f64>, otherwise: Vector3<f64>| {
        let along = if a.dot(&wanted).abs() > 0.1 { a.dot(&wanted) } else { a.dot(&otherwise) };
        if along < 0.0 { -a } else { a }
    };
    let z = signed(axis(up), -Vector3::y(), -Vector3::z());
    let x = signed(axis(across), Vector3::x(), -Vector3::z());
    let rows = Matrix3::from_rows(&[x.transpose(), z.cross(&x).transpose(), z.transpose()]);
    UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rows))
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
