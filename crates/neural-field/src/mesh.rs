//! The field's surface as a mesh.

use crate::field::TrainedField;
use marching_cubes::{SparseGrid, TriMesh};

/// Most lattice points of an extraction; the spacing grows when more would be needed.
const MAX_POINTS: usize = 20_000_000;

impl TrainedField {
    /// The zero level set where it was observed, with normals (along the distance's gradient) and colours (seen
    /// along the inward normal), in the object frame, metres.
    ///
    /// Only space within about a truncation distance of measured points is searched, and only what a frame has looked at
    /// from outside is kept: no walls appear at the border of the occupied space or inside the object, and parts never
    /// seen stay open. `spacing` is the edge of a
    /// cell in metres; the mesh is empty if it is not positive and finite.
    pub fn extract_mesh(&self, spacing: f32) -> TriMesh {
        let size = self.support().voxel_size();
        let boxes = self.support().voxels().map(|lo| (lo, lo.map(|v| v + size)));
        let Some(grid) = SparseGrid::covering(boxes, spacing, MAX_POINTS) else { return TriMesh::default() };
        let points = grid.points();
        let mut values = vec![f32::NAN; points.len()];
        self.sdf(&points, &mut values);
        let mut mesh = grid.extract(&values, 0.0);
        self.paint(&mut mesh);
        self.drop_unseen(&mut mesh);
        mesh
    }

    pub(crate) fn paint(&self, mesh: &mut TriMesh) {
        let n = mesh.vertices.len();
        let (mut sdf, mut normals) = (vec![0.0; n], vec![[0.0f32; 3]; n]);
        self.sdf_and_gradient(&mesh.vertices, &mut sdf, &mut normals);
        for g in &mut normals {
            let length = g.iter().map(|c| c * c).sum::<f32>().sqrt();
            *g = if length > 0.0 && length.is_finite() { g.map(|c| c / length) } else { [0.0, 0.0, 1.0] };
        }
        let dirs: Vec<[f32; 3]> = normals.iter().map(|g| g.map(|c| -c)).collect();
        let mut colors = vec![[0.0f32; 3]; n];
        self.color(&mesh.vertices, &dirs, &mut colors);
        mesh.normals = normals;
        mesh.colors = colors.iter().map(|c| c.map(|v| (v * 255.0).round() as u8)).collect();
    }
}
