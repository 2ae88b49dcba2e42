//! From signed distances to a mesh.

use crate::{Error, Shape};
use marching_cubes::TriMesh;
use rayon::prelude::*;

/// More nodes than any sensible object needs.
const MOST_NODES: f64 = 1e8;

/// The surface of `shape` on a grid of `voxel` metres.
pub(crate) fn extract(shape: &Shape, voxel: f32) -> Result<TriMesh, Error> {
    let (low, high) = shape.bounds().ok_or(Error::EmptyShape)?;
    let extent: [f64; 3] = std::array::from_fn(|k| f64::from(high[k]) - f64::from(low[k]));
    if !extent.iter().all(|e| e.is_finite() && *e > 0.0) {
        return Err(Error::EmptyShape);
    }
    let counts = extent.map(|e| (e / f64::from(voxel)).ceil() + 5.0);
    let nodes: f64 = counts.iter().product();
    // Written so that a NaN fails it.
    if !(voxel > 0.0 && nodes <= MOST_NODES) {
        return Err(Error::Voxel { voxel, nodes });
    }
    // Two voxels of air around the shape close the surface.
    let origin = low.map(|v| v - 2.0 * voxel);
    let counts = counts.map(|c| c as usize);
    let slice = counts[0] * counts[1];
    let mut values = vec![0.0f32; slice * counts[2]];
    values.par_chunks_mut(slice).enumerate().for_each(|(k, values)| {
        for (i, value) in values.iter_mut().enumerate() {
            let node = [i % counts[0], i / counts[0], k];
            *value = shape.distance(std::array::from_fn(|a| origin[a] + node[a] as f32 * voxel));
        }
    });
    Ok(marching_cubes::extract_dense(counts, &values, origin, voxel, 0.0))
}
