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

/// Unwraps `mesh` onto one page.
pub(super) fn unwrap(mesh: &TriMesh, options: &TextureOptions) -> Result<Layout, TextureError> {
    let input = MeshInput::new(&mesh.vertices, mesh.triangles.as_flattened());
    let size = options.size as u32;
    let settings = Options {
        density: Density::Auto { page_size: size },
        padding: options.padding as u32,
        ..Options::default()
    };
    let atlas = uvunwrap::generate(&[input], &settings).map_err(|e| TextureError::Unwrap(e.to_string()))?;
    if atlas.page_count > 1 {
        let problem = format!("{} charts don't fit one page", atlas.chart_count);
        return Err(TextureError::Unwrap(problem));
    }
    let page = [atlas.width, atlas.height].map(|texels| texels as f32 / size as f32);
    let output = atlas.meshes.into_iter().next().unwrap_or_default();
    let (triangles, _) = output.indices.as_chunks::<3>();
    Ok(Layout {
        uvs: output.vertices.iter().map(|v| [v.uv[0] * page[0], v.uv[1] * page[1]]).collect(),
        source: output.vertices.iter().map(|v| v.xref).collect(),
        triangles: triangles.to_vec(),
        charts: atlas.chart_count as usize,
        utilisation: f64::from(atlas.utilization) * f64::from(page[0] * page[1]),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::texture::raster::cover;

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
