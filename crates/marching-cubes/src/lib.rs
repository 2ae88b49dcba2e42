//! Watertight marching cubes from dense and sparse grids, with simplification, hole closing and PLY/OBJ/STL files.
//!
//! A signed distance field sampled on a lattice is turned into the triangle mesh of one of its level sets
//! (Lorensen and Cline 1987). The original table leaves holes where neighbouring cells disagree about a face, and
//! naive sparse extraction closes the mesh off at the border of what was sampled. Here a closed field gives a
//! closed, oriented manifold, and a cell with a missing corner gives nothing at all.
//!
//! ```
//! use marching_cubes::extract_fn;
//!
//! // A sphere of radius 0.4 on a lattice of 33^3 points over the unit cube.
//! let sphere = |p: [f32; 3]| p.map(|v| (v - 0.5) * (v - 0.5)).iter().sum::<f32>().sqrt() - 0.4;
//! let mut mesh = extract_fn([33; 3], [0.0; 3], 1.0 / 32.0, 0.0, sphere);
//! mesh.compute_normals();
//! assert!(mesh.is_watertight());
//! assert!((mesh.signed_volume() - 0.268).abs() < 0.002);
//!
//! let mut file = Vec::new(); // any `std::io::Write`
//! marching_cubes::write_ply(&mesh, &mut file)?;
//! # Ok::<(), std::io::Error>(())
//! ```
//!
//! Design: the table of 256 cases is derived, not listed. Each face of a cell turns its four corner signs into
//! directed segments by one rule; both cells at a face therefore see the same segments, reversed. Segments chain
//! into loops, and loops are triangulated without a diagonal inside a face, so no edge can gain a third triangle.
//! One vertex is made for each lattice edge that the surface crosses, found with bit operations on 64 signs at a
//! time, so vertices are shared by construction and nothing is welded afterwards.
//!
//! What follows extraction keeps the surface a manifold: [`TriMesh::largest_component`], [`TriMesh::closed`] for holes,
//! and [`TriMesh::simplified`], which collapses edges by quadric error.

mod close;
mod components;
mod dense;
mod mesh;
mod quadric;
mod read;
mod simplify;
mod sparse;
mod table;
mod write;

pub use dense::{extract_dense, extract_fn};
pub use mesh::TriMesh;
pub use read::{PlyError, read_ply};
pub use sparse::SparseGrid;
pub use write::{write_obj, write_ply, write_ply_with, write_stl};

#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
