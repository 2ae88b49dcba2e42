//! Triangle meshes by reference.

/// A triangle mesh: vertices in metres, triangles as vertex indices. Triangles with an index out of range are
/// ignored everywhere.
#[derive(Clone, Copy, Debug)]
pub struct MeshRef<'a> {
    /// Vertex positions, metres.
    pub vertices: &'a [[f64; 3]],
    /// Vertex indices of each triangle.
    pub triangles: &'a [[u32; 3]],
}

impl<'a> MeshRef<'a> {
    /// A mesh of these vertices (metres) and triangles.
    pub fn new(vertices: &'a [[f64; 3]], triangles: &'a [[u32; 3]]) -> Self {
        Self { vertices, triangles }
    }

    /// The corners of a triangle; `None` when one of them does not exist or is not finite.
    pub(crate) fn corners(&self, triangle: &[u32; 3]) -> Option<[[f64; 3]; 3]> {
        let corner =
            |i: u32| self.vertices.get(i as usize).copied().filter(|p| p.iter().all(|c| c.is_finite()));
        Some([corner(triangle[0])?, corner(triangle[1])?, corner(triangle[2])?])
    }
}

/// The triangles whose entry in `keep` is true, in order. Entries that `keep` lacks count as false.
pub fn keep_faces(triangles: &[[u32; 3]], keep: &[bool]) -> Vec<[u32; 3]> {
    triangles.iter().zip(keep).filter(|(_, keep)| **keep).map(|(t, _)| *t).collect()
}
