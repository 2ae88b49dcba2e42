//! How far the normals of a reconstruction are off.

use crate::{MeshRef, nearest::PointIndex, sampling::oriented_samples};
use nalgebra::{Isometry3, Vector3};

/// Points on either surface.
const SAMPLES: usize = 99_999;

/// Median angle (radians) between the normals of a reconstruction, at points spread evenly over it, and the true ones at
/// the nearest points of the true surface. Both meshes are counter-clockwise seen from outside.
///
/// `pred`, `gt`, `gt_from_pred`: as for [`score_mesh`](crate::score_mesh). What lies further than `reach` (metres) from
/// the true surface has no counterpart and doesn't count. `None` when nothing counts.
pub fn normal_error(
    pred: MeshRef<'_>,
    gt: MeshRef<'_>,
    gt_from_pred: &Isometry3<f64>,
    reach: f64,
) -> Option<f64> {
    let truth = oriented_samples(gt, SAMPLES, 0);
    let points: Vec<[f64; 3]> = truth.iter().map(|(p, _)| *p).collect();
    let index = PointIndex::new(&points)?;
    let angle = |(p, n): ([f64; 3], Vector3<f64>)| {
        let (nearest, distance) = index.nearest(&(gt_from_pred * nalgebra::Point3::from(p)).into())?;
        (distance <= reach).then(|| (gt_from_pred.rotation * n).angle(&truth[nearest].1))
    };
    let mut angles: Vec<f64> = oriented_samples(pred, SAMPLES, 1).into_iter().filter_map(angle).collect();
    let middle = angles.len() / 2;
    (!angles.is_empty()).then(|| *angles.select_nth_unstable_by(middle, f64::total_cmp).1)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A square metre in the plane z = 0 with the normal `z`, as a fan of triangles around its middle, which is `height`
    /// above it.
    fn roof(height: f64) -> (Vec<[f64; 3]>, Vec<[u32; 3]>) {
        let corners = [[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]];
        let vertices = corners.into_iter().chain([[0.0, 0.0, height]]).collect();
        (vertices, vec![[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    }

    #[test]
    fn the_slope_of_a_roof_is_its_error_against_a_plane() {
        let (flat, steep) = (roof(0.0), roof(0.05));
        let error = |a: &(Vec<[f64; 3]>, Vec<[u32; 3]>), motion: &Isometry3<f64>, reach: f64| {
            normal_error(MeshRef::new(&a.0, &a.1), MeshRef::new(&flat.0, &flat.1), motion, reach)
        };
        let still = Isometry3::identity();
        assert!(error(&flat, &still, 0.01).unwrap() < 1e-7);
        let slope = (0.05f64 / 0.5).atan();
        assert!((error(&steep, &still, 0.1).unwrap() - slope).abs() < 1e-6);
        // Turned with the plane it is the plane again; turned over its normals point the wrong way.
        let turned = Isometry3::rotation(Vector3::z() * 0.7);
        assert!((error(&steep, &turned, 0.5).unwrap() - slope).abs() < 1e-6);
        let over = Isometry3::rotation(Vector3::x() * std::f64::consts::PI);
        assert!((error(&flat, &over, 0.01).unwrap() - std::f64::consts::PI).abs() < 1e-6);
        // Out of reach.
        assert_eq!(error(&flat, &Isometry3::translation(0.0, 0.0, 0.2), 0.1), None);
        let empty = MeshRef::new(&[], &[]);
        assert_eq!(normal_error(empty, empty, &still, 1.0), None);
    }
}
