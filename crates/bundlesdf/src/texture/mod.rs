//! A texture for a mesh from the frames that saw it.
//!
//! The mesh is unwrapped into an atlas. The light that falls on the object is estimated from how the views' colours
//! change while it turns, and taken out. Every texel mixes the views that show it about as well as the best one, with
//! weights that change smoothly over the surface, so that no seam is left. What no view saw is filled from its
//! surroundings.

mod align;
mod atlas;
mod blend;
mod color;
mod fill;
mod light;
mod paint;
mod polynomial;
mod render;
mod sample;
mod still_light;
mod view;

use marching_cubes::TriMesh;
use nalgebra::Isometry3;
use rgbd_io::{Image, Intrinsics, Mask};

use light::Light;

pub use render::Rendering;

/// Surface points that light and corrections of the poses are estimated from.
const POINTS: usize = 12_000;

/// A frame that saw the object.
#[derive(Clone, Debug)]
pub struct View {
    /// RGB colour.
    pub color: Image<[u8; 3]>,
    /// z-depth in metres, `0` = missing; of the colour's size.
    pub depth: Image<f32>,
    /// The object's pixels; of the colour's size.
    pub mask: Mask,
    /// The camera.
    pub intrinsics: Intrinsics,
    /// Pose: camera coordinates to object coordinates, metres.
    pub obj_from_cam: Isometry3<f64>,
}

/// How a texture is made.
#[derive(Clone, Debug, PartialEq)]
pub struct TextureOptions {
    /// Texels per side of the square texture.
    pub size: usize,
    /// Texels of margin around each chart, at least; charts lie twice as far apart.
    pub padding: usize,
    /// Correct the views' poses, by a few millimetres at most, so that their images agree on the surface.
    pub align: bool,
}

impl Default for TextureOptions {
    fn default() -> Self {
        Self { size: 2048, padding: 3, align: true }
    }
}

/// Why a texture can't be made.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum TextureError {
    /// Nothing to paint.
    #[error("the mesh has no triangles; track more of the object before exporting it")]
    EmptyMesh,
    /// Nothing to paint with.
    #[error("there is no view to take colour from; give at least one keyframe")]
    NoViews,
    /// A view's images differ in size, or its intrinsics or pose aren't numbers.
    #[error("view {0} is unusable: colour, depth and mask must have one size, camera and pose be finite")]
    View(usize),
    /// A size that can't be had.
    #[error("a texture of {0} texels a side can't be made; use 64 to 8192")]
    Size(usize),
    /// From the unwrapping.
    #[error("the mesh can't be unwrapped ({0}); simplify it with --faces, or use a larger texture")]
    Unwrap(String),
}

/// A mesh with texture coordinates and its texture.
#[derive(Clone, Debug, PartialEq)]
pub struct TexturedMesh {
    /// Positions, metres; repeated along the seams of the atlas.
    pub positions: Vec<[f32; 3]>,
    /// Unit normals.
    pub normals: Vec<[f32; 3]>,
    /// Texture coordinates: `(0, 0)` is the upper left corner of the image, `(1, 1)` its lower right one.
    pub uvs: Vec<[f32; 2]>,
    /// Vertex numbers, counter-clockwise from outside.
    pub triangles: Vec<[u32; 3]>,
    /// For each vertex the vertex of the mesh that it was made from.
    pub source: Vec<u32>,
    /// RGB, no texel left empty.
    pub texture: Image<[u8; 3]>,
    /// RGB at the vertices of the mesh that was given.
    pub vertex_colors: Vec<[u8; 3]>,
    /// What was found on the way.
    pub stats: TextureStats,
}

/// The texture in numbers.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize)]
pub struct TextureStats {
    /// Pieces of the atlas.
    pub charts: usize,
    /// Share of the texels that show surface.
    pub utilisation: f64,
    /// Share of the surface's texels whose colour comes from a view.
    pub observed: f64,
    /// Factors on red, green and blue that each view's colours were multiplied by.
    pub gains: Vec<[f32; 3]>,
    /// How far each view's pose was corrected (millimetres, at the object's middle).
    pub shifts_mm: Vec<f64>,
}

/// Paints `mesh` (object frame, metres) with what `views` saw of it.
///
/// The method: an atlas; the light as a spherical polynomial of the normal (after Basri and Jacobs, "Lambertian
/// Reflectance and Linear Subspaces", PAMI 2003); a last photometric correction of the poses; visibility by a depth
/// buffer of the mesh and the measured depth; per-view gains by least squares over what several views saw; and a mean of
/// the views, weighted by angle, resolution, sharpness, depth residual and distance from the mask's border, in which views
/// of other colours than most have no part (after Callieri et al., "Masked photo blending", Computers & Graphics 2008).
/// The result is the object's own colour up to one factor, as far as the object turned in the light: shading that every
/// view shows stays.
///
/// # Errors
/// When mesh, views or size can't be used, see [`TextureError`].
pub fn bake(mesh: &TriMesh, views: &[View], options: &TextureOptions) -> Result<TexturedMesh, TextureError> {
    if !(64..=8192).contains(&options.size) {
        return Err(TextureError::Size(options.size));
    }
    if views.is_empty() {
        return Err(TextureError::NoViews);
    }
    if let Some(bad) = views.iter().position(|v| !v.is_usable()) {
        return Err(TextureError::View(bad));
    }
    // Vertices keep their numbers, so that what the caller knows of them still holds.
    let mut mesh = mesh.clone();
    let count = mesh.vertices.len();
    mesh.triangles.retain(|t| t.iter().all(|&i| (i as usize) < count));
    if mesh.triangles.is_empty() {
        return Err(TextureError::EmptyMesh);
    }
    if !mesh.has_normals() {
        mesh.compute_normals();
    }
    let layout = atlas::unwrap(&mesh, options)?;
    let mut prepared = view::prepare(&mesh, views);
    let mut shifts_mm = vec![0.0; views.len()];
    let points = sample::spread(&mesh, POINTS);
    let mut light = Light::estimate(&points, &prepared);
    if options.align {
        let corrections = align::corrections(&points, &prepared, &light);
        prepared = view::prepare_corrected(&mesh, views, &corrections);
        shifts_mm = corrections.iter().map(|c| shift_mm(&mesh, c)).collect();
        light = Light::estimate(&points, &prepared);
    }
    let vertices = sample::vertices(&mesh);
    let mut sightings = sample::sightings(&vertices, &prepared);
    light.remove(&vertices, &prepared, &mut sightings);
    let gains = color::gains(&sightings, views.len());
    color::apply(&mut sightings, &gains);
    color::drop_outliers(&mut sightings);
    let colors = color::vertex_colors(&mesh, &sightings);
    let scene = paint::Scene {
        mesh: &mesh,
        views: &prepared,
        sightings: &sightings,
        weights: blend::weights(&sightings),
        fill: &colors,
    };
    let (texture, observed) = paint::paint(&scene, &layout, options.size);
    Ok(TexturedMesh {
        positions: layout.source.iter().map(|&i| mesh.vertices[i as usize]).collect(),
        normals: layout.source.iter().map(|&i| mesh.normals[i as usize]).collect(),
        uvs: layout.uvs,
        triangles: layout.triangles,
        source: layout.source,
        texture,
        vertex_colors: colors.iter().map(|c| color::to_bytes(*c)).collect(),
        stats: TextureStats {
            charts: layout.charts,
            utilisation: layout.utilisation,
            observed,
            gains,
            shifts_mm,
        },
    })
}

/// How far a motion moves the middle of the mesh's box.
fn shift_mm(mesh: &TriMesh, motion: &Isometry3<f64>) -> f64 {
    let (low, high) = mesh.bounds().unwrap_or_default();
    let middle = nalgebra::Point3::from(std::array::from_fn(|k| 0.5 * f64::from(low[k] + high[k])));
    1e3 * (motion * middle - middle).norm()
}

impl View {
    fn is_usable(&self) -> bool {
        !self.color.is_empty()
            && self.color.size() == self.depth.size()
            && self.color.size() == self.mask.size()
            && self.intrinsics.is_valid()
            && self.obj_from_cam.to_homogeneous().iter().all(|v| v.is_finite())
    }
}
