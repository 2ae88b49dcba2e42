//! What can go wrong with a description.

use rgbd_io::Intrinsics;

/// A scene that can't be built.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The shape has no extent to put a grid around.
    #[error("the shape is empty or not finite; give it at least one part of positive size")]
    EmptyShape,
    /// The grid for the surface would not fit.
    #[error(
        "a voxel of {voxel} m needs a grid of {nodes:.0} nodes; use a larger voxel (1 to 3 mm suits hand-held objects)"
    )]
    Voxel {
        /// Edge length asked for, metres.
        voxel: f32,
        /// Grid nodes it would take.
        nodes: f64,
    },
    /// Not a camera.
    #[error(
        "the intrinsics {0:?} are not usable; focal lengths must be positive and all four numbers finite"
    )]
    Intrinsics(Intrinsics),
    /// Nothing to render into.
    #[error("an image of {width} x {height} pixels is empty; use at least one pixel")]
    EmptyImage {
        /// Pixels per row.
        width: usize,
        /// Rows.
        height: usize,
    },
}
