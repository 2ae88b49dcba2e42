//! Sparse voxel octrees: occupied intervals along rays and the sample depths to spend on them.
//!
//! A field that is trained or rendered along rays should spend its samples where the surface can be. BundleSDF
//! (section 3.4) bounds them by an octree of occupied voxels around the fused point cloud: a ray gets the
//! parameter intervals inside occupied voxels, and its samples are spread over those intervals only.
//!
//! ```
//! use octree_sampler::{VoxelOctree, sampling};
//!
//! // Two points half a metre apart, 2 cm voxels, dilated by one voxel: two cubes of 27 voxels.
//! let octree = VoxelOctree::from_points(&[[0.01, 0.01, 0.01], [0.01, 0.01, 0.51]], 0.02, 1).unwrap();
//! assert_eq!(octree.len(), 54);
//!
//! let (mut intervals, mut depths) = (Vec::new(), Vec::new());
//! octree.intervals([0.01, 0.01, -1.0], [0.0, 0.0, 1.0], 0.0, 10.0, &mut intervals);
//! assert_eq!(intervals.len(), 2);
//! assert!((intervals[0][0] - 0.98).abs() < 1e-6 && (intervals[0][1] - 1.04).abs() < 1e-6);
//!
//! sampling::stratified(&intervals, 8, || 0.5, &mut depths); // a real caller draws from its generator
//! assert_eq!(depths.len(), 8);
//! assert!(depths.iter().all(|t| intervals.iter().any(|i| i[0] <= *t && *t <= i[1])));
//! ```
//!
//! Design: occupancy is stored as a pyramid of 4x4x4 bit masks (an octree with every other level left out: one
//! `u64` answers two octree levels) over the tight box of the points. A ray walks cells as Amanatides and Woo do
//! (1987), but leaves an empty block of 16 or 4 voxels a side in one step. Each step leaves its block through a
//! face whose parameter is computed afresh, not accumulated, and moves at least one cell along the ray, so a walk
//! ends after at most as many steps as the grid has cells along its three axes, whatever the numbers are.

mod bitset;
mod octree;
pub mod sampling;
mod traverse;

pub use octree::{MAX_CELLS_PER_AXIS, MAX_DILATION, VoxelOctree};

#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
