//! From a mesh to charts on a square.

use marching_cubes::TriMesh;
use uvunwrap::{Density, MeshInput, Options};

use super::{TextureError, TextureOptions};

/// A mesh laid out on the unit square.
pub(super) struct Layout {
    /// Per vertex; from the upper left corner.
    pub(super) uvs: Vec<[f32; 2]>,
    /// The mesh's triangles in their order, naming the vertices of the layout.
    pub(super) triangles: Vec<[u32; 3]>,
    /// The mesh's vertex that each vertex was made from.
    pub(super) source: Vec<u32>,
    pub(super) charts: usize,
    pub(super) utilisation: f64,
}

/// Most faces that are unwrapped at once: the time for a chart grows faster than its size, and a face more or less
/// in a chart changes nothing.
const BLOCK: usize = 10_000;

/// Unwraps `mesh` onto one page.
pub(super) fn unwrap(mesh: &TriMesh, options: &TextureOptions) -> Result<Layout, TextureError> {
    let blocks = blocks(mesh, (0..mesh.triangles.len()).collect());
    let faces = |block: &Vec<usize>| block.iter().map(|&i| mesh.triangles[i]).collect::<Vec<_>>();
    let faces: Vec<Vec<[u32; 3]>> = blocks.iter().map(faces).collect();
    let inputs: Vec<_> =
        faces.iter().map(|faces| MeshInput::new(&mesh.vertices, faces.as_flattened())).collect();
    let size = options.size as u32;
    let settings = Options {
        density: Density::Auto { page_size: size },
        padding: options.padding as u32,
        ..Options::default()
    };
    let atlas = uvunwrap::generate(&inputs, &settings).map_err(|e| TextureError::Unwrap(e.to_string()))?;
    if atlas.page_count > 1 {
        let problem = format!("{} charts don't fit one page", atlas.chart_count);
        return Err(TextureError::Unwrap(problem));
    }
    let page = [atlas.width, atlas.height].map(|texels| texels as f32 / size as f32);
    let mut layout = Layout {
        uvs: Vec::new(),
        triangles: vec![[0; 3]; mesh.triangles.len()],
        source: Vec::new(),
        charts: atlas.chart_count as usize,
        utilisation: f64::from(atlas.utilization) * f64::from(page[0] * page[1]),
    };
    for (block, output) in blocks.iter().zip(&atlas.meshes) {
        let first = layout.uvs.len() as u32;
        layout.uvs.extend(output.vertices.iter().map(|v| [v.uv[0] * page[0], v.uv[1] * page[1]]));
        layout.source.extend(output.vertices.iter().map(|v| v.xref));
        for (&face, t) in block.iter().zip(output.indices.as_chunks::<3>().0) {
            layout.triangles[face] = t.map(|i| first + i);
        }
    }
    Ok(layout)
}

/// The faces in blocks of at most [`BLOCK`], each in one place: halved along the longest edge of their box until they
/// are small enough.
fn blocks(mesh: &TriMesh, mut faces: Vec<usize>) -> Vec<Vec<usize>> {
    if faces.len() <= BLOCK {
        faces.sort_unstable();
        return vec![faces];
    }
    // Three times the middle of a face.
    let at = |face: &usize, axis: usize| {
        mesh.triangles[*face].iter().map(|&i| mesh.vertices[i as usize][axis]).sum::<f32>()
    };
    let extent = |axis: usize| {
        let ends = faces
            .iter()
            .map(|f| at(f, axis))
            .fold((f32::INFINITY, f32::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)));
        ends.1 - ends.0
    };
    let axis = (1..3).fold(0, |best, axis| if extent(axis) > extent(best) { axis } else { best });
    let middle = faces.len() / 2;
    faces.select_nth_unstable_by(middle, |a, b| at(a, axis).total_cmp(&at(b, axis)).then(a.cmp(b)));
    let rest = faces.split_off(middle);
    let mut all = blocks(mesh, faces);
    all.extend(blocks(mesh, rest));
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::raster::cover;

    #[test]
    fn a_large_mesh_is_cut_into_blocks_that_hold_every_face_once() {
        let mesh = marching_cubes::extract_fn([90; 3], [-1.0; 3], 2.0 / 89.0, 0.0, |p| {
            p.iter().map(|v| v * v).sum::<f32>().sqrt() - 0.9
        });
        assert!(mesh.triangles.len() > 2 * BLOCK);
        let blocks = blocks(&mesh, (0..mesh.triangles.len()).collect());
        assert!(blocks.iter().all(|b| b.len() <= BLOCK && b.len() > BLOCK / 3));
        let mut faces = blocks.concat();
        faces.sort_unstable();
        assert!(faces.into_iter().eq(0..mesh.triangles.len()));
        let layout = unwrap(&mesh, &TextureOptions { size: 512, ..TextureOptions::default() }).unwrap();
        for (t, original) in layout.triangles.iter().zip(&mesh.triangles) {
            assert_eq!(t.map(|i| layout.source[i as usize]), *original);
        }
    }

    #[test]
    fn charts_keep_apart_and_no_texel_has_two_faces() {
        let mesh = marching_cubes::extract_fn([24; 3], [-1.0; 3], 2.0 / 23.0, 0.0, |p| {
            p.iter().map(|v| v * v).sum::<f32>().sqrt() - 0.7
        });
        let options = TextureOptions { size: 512, ..TextureOptions::default() };
        let layout = unwrap(&mesh, &options).unwrap();
        assert_eq!(layout.triangles.len(), mesh.triangles.len());
        for (t, original) in layout.triangles.iter().zip(&mesh.triangles) {
            assert_eq!(t.map(|i| layout.source[i as usize]), *original);
        }
        assert!(layout.uvs.as_flattened().iter().all(|v| (0.0..=1.0).contains(v)));
        let mut hits = vec![0u8; 512 * 512];
        for t in &layout.triangles {
            let corners = t.map(|i| layout.uvs[i as usize].map(|v| f64::from(v) * 512.0 - 0.5));
            cover(corners, 512, 512, |x, y, w| {
                // Texels on an edge belong to both its faces.
                if w.iter().all(|w| *w > 1e-4) {
                    hits[y * 512 + x] += 1;
                }
            });
        }
        assert!(hits.iter().all(|&h| h <= 1));
        let used = hits.iter().filter(|&&h| h == 1).count() as f64 / hits.len() as f64;
        assert!((used - layout.utilisation).abs() < 0.05 && used > 0.4, "{used} {}", layout.utilisation);
    }
}
