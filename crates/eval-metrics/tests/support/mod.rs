//! Meshes with known surfaces.

/// A box centred at the origin, each side split into `n`² squares, welded per side; edge lengths in metres.
pub(crate) fn cuboid(size: [f64; 3], n: u32) -> (Vec<[f64; 3]>, Vec<[u32; 3]>) {
    let (mut vertices, mut triangles) = (Vec::new(), Vec::new());
    for axis in 0..3 {
        let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
        for side in [-0.5, 0.5] {
            let base = vertices.len() as u32;
            for i in 0..=n {
                for j in 0..=n {
                    let mut p = [0.0; 3];
                    p[axis] = side * size[axis];
                    p[u] = (f64::from(i) / f64::from(n) - 0.5) * size[u];
                    p[v] = (f64::from(j) / f64::from(n) - 0.5) * size[v];
                    vertices.push(p);
                }
            }
            for i in 0..n {
                for j in 0..n {
                    let a = base + i * (n + 1) + j;
                    let (b, c, d) = (a + n + 1, a + n + 2, a + 1);
                    triangles.extend([[a, b, c], [a, c, d]]);
                }
            }
        }
    }
    (vertices, triangles)
}
