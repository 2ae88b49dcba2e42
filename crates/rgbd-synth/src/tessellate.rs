//! Meshes of simple bodies, made directly.

use marching_cubes::TriMesh;

/// A cone from the origin to `(0, 0, length)` with round ends of radii `a` and `b` (metres), with normals.
pub(crate) fn rounded_cone(length: f32, a: f32, b: f32) -> TriMesh {
    const AROUND: u32 = 24;
    const CAP: u32 = 6;
    let quarter = std::f32::consts::FRAC_PI_2;
    // Rings from pole to pole: centre along the axis, radius of the ball, latitude.
    let mut rings = Vec::new();
    for i in 0..=CAP {
        rings.push((0.0, a, -quarter + quarter * i as f32 / CAP as f32));
    }
    for i in 0..=CAP {
        rings.push((length, b, quarter * i as f32 / CAP as f32));
    }
    let mut mesh = TriMesh::default();
    for &(z, r, latitude) in &rings {
        for j in 0..AROUND {
            let angle = std::f32::consts::TAU * j as f32 / AROUND as f32;
            let n = [latitude.cos() * angle.cos(), latitude.cos() * angle.sin(), latitude.sin()];
            mesh.vertices.push([r * n[0], r * n[1], z + r * n[2]]);
            mesh.normals.push(n);
        }
    }
    for i in 0..rings.len() as u32 - 1 {
        for j in 0..AROUND {
            let k = (j + 1) % AROUND;
            let [p, q, r, s] = [i * AROUND + j, i * AROUND + k, (i + 1) * AROUND + j, (i + 1) * AROUND + k];
            mesh.triangles.push([p, q, s]);
            mesh.triangles.push([p, s, r]);
        }
    }
    mesh
}

/// A box around the origin with half the edge lengths `half` (metres), each face with its own vertices.
pub(crate) fn cuboid(half: [f32; 3]) -> TriMesh {
    let mut mesh = TriMesh::default();
    for axis in 0..3 {
        for sign in [-1.0f32, 1.0] {
            let first = mesh.vertices.len() as u32;
            let (j, k) = ((axis + 1) % 3, (axis + 2) % 3);
            for (a, b) in [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)] {
                let mut v = [0.0; 3];
                v[axis] = sign * half[axis];
                // Mirrored on one side, so that all faces are counter-clockwise from outside.
                v[j] = a * half[j] * sign;
                v[k] = b * half[k];
                let mut n = [0.0; 3];
                n[axis] = sign;
                mesh.vertices.push(v);
                mesh.normals.push(n);
            }
            mesh.triangles.push([first, first + 1, first + 2]);
            mesh.triangles.push([first, first + 2, first + 3]);
        }
    }
    mesh
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bodies_are_counter_clockwise_from_outside() {
        for mesh in [rounded_cone(0.1, 0.02, 0.01), cuboid([0.1, 0.2, 0.3])] {
            assert!(mesh.signed_volume() > 0.0);
            for t in &mesh.triangles {
                let [a, b, c] = t.map(|v| nalgebra::Vector3::from(mesh.vertices[v as usize]));
                let flat = (b - a).cross(&(c - a));
                let outwards: nalgebra::Vector3<f32> =
                    t.iter().map(|&v| nalgebra::Vector3::from(mesh.normals[v as usize])).sum();
                assert!(flat.norm() < 1e-10 || flat.dot(&outwards) > 0.0);
            }
        }
    }
}
