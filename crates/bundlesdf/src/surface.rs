//! The observed surface: points for the segmentation to compare a new frame with, and the mesh of the field.

use std::collections::HashSet;

use marching_cubes::TriMesh;
use mask_tracker::SurfacePoint;
use neural_field::TrainedField;

use crate::{
    pool::MemoryPool,
    rigid::{moved_point, moved_vector},
};

/// Spacing of the fused points (metres).
const SPACING: f32 = 0.004;

/// The sample points of all keyframes in the object frame, at most one per voxel and facing direction.
pub(crate) fn fused_surface(pool: &MemoryPool) -> Vec<SurfacePoint> {
    let mut seen = HashSet::new();
    let mut surface = Vec::new();
    for keyframe in pool.keyframes() {
        for (p, n) in &keyframe.observation.samples {
            let position = moved_point(&keyframe.obj_from_cam, *p);
            let normal = moved_vector(&keyframe.obj_from_cam, *n);
            let voxel = position.map(|v| (v / SPACING).floor() as i32);
            let octant = normal.map(|v| v > 0.0);
            if seen.insert((voxel, octant)) {
                surface.push(SurfacePoint { position, normal });
            }
        }
    }
    surface
}

/// The field's surface where it was seen (`spacing`: edge of a cell, metres). An object of which two parts were seen and
/// not what joins them comes in two pieces.
pub(crate) fn field_surface(field: &TrainedField, spacing: f32) -> TriMesh {
    /// Pieces of fewer triangles are noise.
    const SPECK: usize = 20;
    let mut mesh = field.extract_mesh(spacing);
    mesh.remove_small_components(SPECK);
    mesh
}
