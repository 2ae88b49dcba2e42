//! A body to look at: a mesh with a solid texture.

use crate::atlas::Atlas;
use crate::{Error, Gloss, Shape, Texture};
use marching_cubes::TriMesh;
use std::sync::{Arc, OnceLock};

/// A body: its outer surface, and its colour as a function of the surface point.
#[derive(Clone, Debug)]
pub struct Object {
    mesh: TriMesh,
    texture: Texture,
    shape: Option<Shape>,
    gloss: Option<Gloss>,
    closed: bool,
    atlas: OnceLock<Option<Arc<Atlas>>>,
}

impl Object {
    /// Extracts the surface of `shape` on a grid of `voxel` metres; vertices lie on the surface to second order in
    /// the voxel's size, normals are the gradient of the distance, colours are the texture's.
    ///
    /// # Errors
    /// When the shape is empty or has no finite extent, or the grid would have more than 100 million nodes.
    pub fn from_shape(shape: Shape, texture: Texture, voxel: f32) -> Result<Self, Error> {
        let mut mesh = crate::surface::extract(&shape, voxel)?;
        mesh.normals = mesh.vertices.iter().map(|&v| shape.normal(v, 0.5 * voxel)).collect();
        Ok(Self { shape: Some(shape), closed: true, ..Self::from_mesh(mesh, texture) })
    }

    /// A body from a mesh of its own frame (metres). Missing normals are computed; the vertices get the texture's
    /// colours.
    pub fn from_mesh(mut mesh: TriMesh, texture: Texture) -> Self {
        if mesh.normals.len() != mesh.vertices.len() {
            mesh.compute_normals();
        }
        mesh.colors = mesh
            .vertices
            .iter()
            .zip(&mesh.normals)
            .map(|(&v, &n)| texture.color(v, n).map(|c| (c * 255.0).round().clamp(0.0, 255.0) as u8))
            .collect();
        Self { mesh, texture, shape: None, gloss: None, closed: false, atlas: OnceLock::new() }
    }

    /// A body from a mesh that is known to be closed and counter-clockwise from outside.
    pub(crate) fn from_closed(mesh: TriMesh, texture: Texture) -> Self {
        Self { closed: true, ..Self::from_mesh(mesh, texture) }
    }

    /// The same body with a shine of its own in place of [`crate::Light::specular`].
    #[must_use]
    pub fn with_gloss(self, gloss: Gloss) -> Self {
        Self { gloss: Some(gloss), ..self }
    }

    /// The same surface with another texture.
    #[must_use]
    pub fn with_texture(&self, texture: &Texture) -> Self {
        let (shape, gloss, closed) = (self.shape.clone(), self.gloss, self.closed);
        Self { shape, gloss, closed, ..Self::from_mesh(self.mesh.clone(), texture.clone()) }
    }

    /// The true surface in the object's frame, metres, with vertex normals and colours.
    pub fn mesh(&self) -> &TriMesh {
        &self.mesh
    }

    /// The texture: the renderer evaluates it at every pixel, or, on meshes of small triangles, at twice the
    /// density of the vertices and interpolates.
    pub fn texture(&self) -> &Texture {
        &self.texture
    }

    /// The solid that the mesh was extracted from, if it was.
    pub fn shape(&self) -> Option<&Shape> {
        self.shape.as_ref()
    }

    /// The body's own shine, if it has one.
    pub fn gloss(&self) -> Option<Gloss> {
        self.gloss
    }

    pub(crate) fn is_closed(&self) -> bool {
        self.closed
    }

    /// The texture's colours over all triangles, where the triangles are small enough.
    pub(crate) fn atlas(&self) -> Option<&Atlas> {
        self.atlas.get_or_init(|| Atlas::bake(&self.mesh, &self.texture).map(Arc::new)).as_deref()
    }
}
