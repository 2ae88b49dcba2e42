//! Models of objects: PLY (text and binary), OBJ, lists of points.

use rgbd_io::datasets::ModelMesh;

pub(crate) fn run(data: &[u8]) {
    let Ok(mesh) = ModelMesh::parse(data) else { return };
    assert!(!mesh.vertices.is_empty());
    assert!(mesh.vertices.iter().flatten().all(|v| v.is_finite()));
    assert!(mesh.triangles.iter().flatten().all(|i| (*i as usize) < mesh.vertices.len()));
    assert!(mesh.centroid().is_some());
}
