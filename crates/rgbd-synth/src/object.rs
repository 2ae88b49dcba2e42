//! A body to look at: a mesh with a solid texture.

use crate::{Error, Shape, Texture};
use marching_cubes::TriMesh;

/// A body: its outer surface, and its colour as a function of the surface point.
#[derive(Clone, Debug)]
pub struct Object {
    mesh: TriMesh,
    texture: Texture,
    shape: Option<Shape>,
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
        Ok(Self { shape: Some(shape), ..Self::from_mesh(mesh, texture) })
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
        Self { mesh, texture, shape: None }
    }

    /// The true surface in the object's frame, metres, with vertex normals and colours.
    pub fn mesh(&self) -> &TriMesh {
        &self.mesh
    }

    /// The texture that the renderer evaluates at every pixel.
    pub fn texture(&self) -> &Texture {
        &self.texture
    }

    /// The solid that the mesh was extracted from, if it was.
    pub fn shape(&self) -> Option<&Shape> {
        self.shape.as_ref()
    }
}
