//! Mass, centre of mass and inertia of a solid of even density.

use marching_cubes::TriMesh;
use nalgebra::{Matrix3, Vector3};
use serde::Serialize;

/// A rigid body's mass properties.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct MassProperties {
    /// Cubic metres.
    pub volume_m3: f64,
    /// Kilograms.
    pub mass_kg: f64,
    /// Metres, in the mesh's frame.
    pub center_of_mass_m: [f64; 3],
    /// Inertia tensor about the centre of mass, along the mesh's axes, kg m^2.
    pub inertia_kg_m2: [[f64; 3]; 3],
}

/// Mass properties of the solid that a watertight mesh (metres) encloses, at `density` kg/m^3; `None` when it
/// encloses no volume.
///
/// Sums over the tetrahedra between the triangles and a point inside.
#[must_use]
pub fn mass_properties(mesh: &TriMesh, density: f64) -> Option<MassProperties> {
    let (low, high) = mesh.bounds()?;
    let base = Vector3::from(low.map(f64::from)).lerp(&Vector3::from(high.map(f64::from)), 0.5);
    let corner = |i: u32| mesh.vertices.get(i as usize).map(|p| Vector3::from(p.map(f64::from)) - base);
    let (mut volume, mut first, mut second) = (0.0, Vector3::zeros(), Matrix3::zeros());
    for t in &mesh.triangles {
        let [Some(a), Some(b), Some(c)] = t.map(corner) else { continue };
        let v = a.dot(&b.cross(&c)) / 6.0;
        let sum = a + b + c;
        volume += v;
        first += v / 4.0 * sum;
        // Second moments of a tetrahedron with one corner in the origin.
        let squares = a * a.transpose() + b * b.transpose() + c * c.transpose();
        second += v / 20.0 * (squares + sum * sum.transpose());
    }
    // Written so that a NaN fails it.
    let solid = volume > 0.0 && density > 0.0 && density.is_finite();
    if !solid {
        return None;
    }
    let center = first / volume;
    let about_center = density * (second - volume * center * center.transpose());
    let inertia = Matrix3::identity() * about_center.trace() - about_center;
    Some(MassProperties {
        volume_m3: volume,
        mass_kg: density * volume,
        center_of_mass_m: (center + base).into(),
        inertia_kg_m2: std::array::from_fn(|r| std::array::from_fn(|c| inertia[(r, c)])),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_box_has_the_textbook_inertia_about_its_centre() {
        let (size, at) = ([0.1, 0.2, 0.3], [1.0, -2.0, 0.5]);
        let corner =
            |i: usize| std::array::from_fn(|k| (at[k] + size[k] * ((i >> k & 1) as f64 - 0.5)) as f32);
        let quads = [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6u32]];
        let mesh = TriMesh {
            vertices: (0..8).map(corner).collect(),
            triangles: quads.iter().flat_map(|q| [[q[0], q[1], q[2]], [q[0], q[2], q[3]]]).collect(),
            ..TriMesh::default()
        };
        assert!(mesh.is_watertight());
        let m = mass_properties(&mesh, 500.0).unwrap();
        assert!((m.mass_kg - 3.0).abs() < 1e-5, "{m:?}");
        for k in 0..3 {
            assert!((m.center_of_mass_m[k] - at[k]).abs() < 1e-6);
            let others: f64 = (0..3).filter(|i| *i != k).map(|i| size[i] * size[i]).sum();
            assert!((m.inertia_kg_m2[k][k] - 3.0 * others / 12.0).abs() < 1e-6, "{m:?}");
            assert!((0..3).all(|i| i == k || m.inertia_kg_m2[k][i].abs() < 1e-6));
        }
        let mut inside_out = mesh.clone();
        inside_out.triangles.iter_mut().for_each(|t| t.swap(0, 1));
        assert_eq!(mass_properties(&inside_out, 500.0), None);
        assert_eq!(mass_properties(&mesh, f64::NAN), None);
    }

    #[test]
    fn a_ball_off_the_origin_too() {
        let mesh = marching_cubes::extract_fn([60; 3], [-0.1; 3], 0.2 / 59.0, 0.0, |p| {
            ((p[0] - 0.01).powi(2) + p[1] * p[1] + p[2] * p[2]).sqrt() - 0.08
        });
        let m = mass_properties(&mesh, 1000.0).unwrap();
        let mass = 1000.0 * 4.0 / 3.0 * std::f64::consts::PI * 0.08f64.powi(3);
        assert!((m.mass_kg / mass - 1.0).abs() < 0.01);
        assert!((m.center_of_mass_m[0] - 0.01).abs() < 1e-5);
        for k in 0..3 {
            assert!((m.inertia_kg_m2[k][k] / (0.4 * mass * 0.0064) - 1.0).abs() < 0.01, "{m:?}");
        }
    }
}
