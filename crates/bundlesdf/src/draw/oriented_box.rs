//! The smallest box around an object.

use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};

/// A box in the object frame.
#[derive(Clone, Debug, PartialEq)]
pub struct OrientedBox {
    /// Maps the box's coordinates, with their origin in its middle, to the object frame.
    pub obj_from_box: Isometry3<f64>,
    /// Lengths of its edges (metres).
    pub size: Vector3<f64>,
}

impl OrientedBox {
    /// The box of (nearly) least volume around points in metres: local search over rotations from the axes of the
    /// object frame and from the principal axes. `None` without finite points.
    #[must_use]
    pub fn around(points: &[[f32; 3]]) -> Option<Self> {
        let extremes = extremes(points);
        let middle = extremes.iter().sum::<Vector3<f64>>() / extremes.len().max(1) as f64;
        let scatter: Matrix3<f64> = extremes.iter().map(|p| (p - middle) * (p - middle).transpose()).sum();
        let mut axes = scatter.symmetric_eigen().eigenvectors;
        if axes.determinant() < 0.0 {
            axes.column_mut(2).neg_mut();
        }
        let starts = [Rotation3::identity(), Rotation3::from_matrix_unchecked(axes)];
        let (box_from_obj, _) = starts
            .into_iter()
            .map(|start| shrink(&extremes, start.into()))
            .min_by(|a, b| a.1.total_cmp(&b.1))?;
        let (low, high) = extent(&extremes, &box_from_obj)?;
        let obj_from_box = box_from_obj.inverse();
        let centre = Translation3::from(obj_from_box * ((low + high) / 2.0));
        Some(Self { obj_from_box: Isometry3::from_parts(centre, obj_from_box), size: high - low })
    }

    /// The middle of the box.
    #[must_use]
    pub fn centre(&self) -> Point3<f64> {
        self.obj_from_box.translation.vector.into()
    }

    /// The twelve edges, and whether each belongs to a face that is turned towards `camera` (object frame).
    #[must_use]
    pub fn edges(&self, camera: &Point3<f64>) -> Vec<([Point3<f64>; 2], bool)> {
        let half = self.size / 2.0;
        let eye = self.obj_from_box.inverse_transform_point(camera);
        let faces = |axis: usize, side: f64| eye[axis] * side > half[axis];
        let mut edges = Vec::with_capacity(12);
        for along in 0..3 {
            let (u, v) = ((along + 1) % 3, (along + 2) % 3);
            for (su, sv) in [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)] {
                let end = |s: f64| {
                    let mut p = Point3::origin();
                    (p[along], p[u], p[v]) = (s * half[along], su * half[u], sv * half[v]);
                    self.obj_from_box * p
                };
                edges.push(([end(-1.0), end(1.0)], faces(u, su) || faces(v, sv)));
            }
        }
        edges
    }
}

/// The `i`-th of `n` directions spread evenly over the sphere (a Fibonacci lattice).
pub(crate) fn direction(i: usize, n: usize) -> Vector3<f64> {
    let golden = std::f64::consts::PI * (3.0 - 5.0_f64.sqrt());
    let z = 1.0 - (2.0 * i as f64 + 1.0) / n as f64;
    let (sin, cos) = (golden * i as f64).sin_cos();
    let radius = (1.0 - z * z).max(0.0).sqrt();
    Vector3::new(radius * cos, radius * sin, z)
}

/// The points that lie furthest out in some direction: the box around them is the box around all.
fn extremes(points: &[[f32; 3]]) -> Vec<Vector3<f64>> {
    const DIRECTIONS: usize = 400;
    let finite: Vec<Vector3<f64>> = points
        .iter()
        .map(|p| Vector3::from(*p).cast::<f64>())
        .filter(|p| p.iter().all(|v| v.is_finite()))
        .collect();
    let mut chosen: Vec<Vector3<f64>> = (0..DIRECTIONS)
        .filter_map(|i| {
            let direction = direction(i, DIRECTIONS);
            finite.iter().copied().max_by(|a, b| a.dot(&direction).total_cmp(&b.dot(&direction)))
        })
        .collect();
    chosen.dedup();
    chosen
}

/// Turns the box in ever smaller steps while that makes it smaller; answers `box_from_obj` and the volume.
fn shrink(points: &[Vector3<f64>], start: UnitQuaternion<f64>) -> (UnitQuaternion<f64>, f64) {
    let volume = |r: &UnitQuaternion<f64>| {
        // A flat object has no volume: the floor keeps its outline small too.
        extent(points, r).map_or(f64::INFINITY, |(low, high)| (high - low).map(|v| v + 1e-4).product())
    };
    let (mut best, mut least) = (start, volume(&start));
    let mut step = 20_f64.to_radians();
    while step > 0.2_f64.to_radians() {
        let turned = (0..6).map(|i| {
            let axis = Vector3::ith_axis(i % 3);
            UnitQuaternion::from_axis_angle(&axis, if i < 3 { step } else { -step }) * best
        });
        let next = turned.map(|r| (volume(&r), r)).min_by(|a, b| a.0.total_cmp(&b.0));
        match next {
            Some((smaller, rotation)) if smaller < least * (1.0 - 1e-6) => {
                (best, least) = (rotation, smaller)
            }
            _ => step /= 2.0,
        }
    }
    (best, least)
}

fn extent(points: &[Vector3<f64>], rotation: &UnitQuaternion<f64>) -> Option<(Vector3<f64>, Vector3<f64>)> {
    let matrix = rotation.to_rotation_matrix();
    let first = matrix * points.first()?;
    Some(points.iter().fold((first, first), |(low, high), p| {
        let p = matrix * p;
        (low.inf(&p), high.sup(&p))
    }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_turned_box_is_found_again() {
        let turned = Rotation3::from_euler_angles(0.4, -0.9, 1.3);
        let mut points = Vec::new();
        for i in 0..1000 {
            let grid = [i % 10, i / 10 % 10, i / 100].map(|v| f64::from(v) / 9.0 - 0.5);
            let p = turned * Vector3::new(0.2 * grid[0], 0.1 * grid[1], 0.05 * grid[2]);
            points.push((p + Vector3::new(0.01, 0.02, 0.03)).cast::<f32>().into());
        }
        let found = OrientedBox::around(&points).unwrap();
        let mut size: Vec<f64> = found.size.iter().copied().collect();
        size.sort_by(f64::total_cmp);
        for (found, exact) in size.iter().zip([0.05, 0.1, 0.2]) {
            assert!((found - exact).abs() < 0.002, "{size:?}");
        }
        assert!((found.centre() - Point3::new(0.01, 0.02, 0.03)).norm() < 0.001);
    }

    #[test]
    fn nothing_has_no_box_and_a_point_has_one() {
        assert_eq!(OrientedBox::around(&[]), None);
        assert_eq!(OrientedBox::around(&[[f32::NAN; 3]]), None);
        assert!(OrientedBox::around(&[[0.1, 0.2, 0.3]]).unwrap().size.norm() < 1e-9);
    }

    #[test]
    fn from_a_corner_nine_edges_are_visible_from_the_front_four_from_inside_none() {
        let unit = OrientedBox { obj_from_box: Isometry3::identity(), size: Vector3::repeat(1.0) };
        let visible = |p: [f64; 3]| unit.edges(&p.into()).iter().filter(|(_, v)| *v).count();
        assert_eq!(visible([3.0, 3.0, 3.0]), 9);
        assert_eq!(visible([0.0, 0.0, 3.0]), 4);
        assert_eq!(visible([0.0; 3]), 0);
    }
}
