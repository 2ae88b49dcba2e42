//! The surface as a mesh.

use super::{BLOCK, SIDE, TsdfVolume};
use marching_cubes::{SparseGrid, TriMesh};

/// Lattice points of an extraction, at most.
const MAX_POINTS: usize = 1 << 26;
/// Pieces of fewer triangles are noise.
const MIN_TRIANGLES: usize = 20;

impl TsdfVolume {
    /// The zero level set as a mesh in the object's frame, with normals and colours, by marching cubes on a lattice of
    /// `spacing_m` metres. Open where nothing was observed.
    ///
    /// The spacing is kept between half a voxel, below which there is no more detail, and one voxel, above which cells
    /// would reach out of the observed band. One that needs more than 67 million points is doubled until it does not. Empty for an empty volume or a spacing that is no positive number.
    pub fn mesh(&self, spacing_m: f32) -> TriMesh {
        if self.coords.is_empty() || !(spacing_m > 0.0 && spacing_m.is_finite()) {
            return TriMesh::default();
        }
        let voxel = self.options.voxel_m;
        let mut spacing = spacing_m.clamp(0.5 * voxel, voxel);
        let grid = loop {
            match SparseGrid::covering(self.surface_boxes(), spacing, MAX_POINTS) {
                Some(grid) => break grid,
                None if spacing < self.options.radius_m => spacing *= 2.0,
                None => return TriMesh::default(),
            }
        };
        let values: Vec<f32> = grid.points().iter().map(|&p| self.sample(p).unwrap_or(f32::NAN)).collect();
        let mut mesh = grid.extract(&values, 0.0);
        mesh.remove_small_components(MIN_TRIANGLES);
        mesh.compute_normals();
        mesh.colors = mesh.vertices.iter().map(|&p| self.color(p).unwrap_or([128; 3])).collect();
        mesh
    }

    /// Corners of the blocks through which the surface may pass, with the cells that lead to the next block.
    fn surface_boxes(&self) -> impl Iterator<Item = ([f32; 3], [f32; 3])> {
        let edge = self.options.voxel_m * SIDE as f32;
        let observed = self.distance.chunks_exact(BLOCK).zip(self.weight.chunks_exact(BLOCK));
        self.coords.iter().zip(observed).filter_map(move |(coord, (distance, weight))| {
            let near =
                distance.iter().zip(weight).any(|(d, w)| *w > 0.0 && *d < 0.99 * self.options.truncation_m);
            near.then(|| (coord.map(|c| c as f32 * edge), coord.map(|c| (c + 1) as f32 * edge)))
        })
    }
}
