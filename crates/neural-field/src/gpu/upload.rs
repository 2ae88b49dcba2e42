//! A round's frames, candidate rays and occupancy as the sampling kernel reads them.

use crate::rays::RingKind;
use crate::round::Round;
use octree_sampler::VoxelOctree;

/// Place of a frame in a list that it is not in.
const NOWHERE: u32 = u32::MAX;

/// What is sent once a round.
#[derive(Debug)]
pub(crate) struct Upload {
    /// Per frame with surface rays, then per frame with ring rays: frame, first candidate, candidates, unused.
    pub(crate) frames: Vec<u32>,
    /// Per frame its place in either list.
    pub(crate) slots: Vec<u32>,
    /// Direction and distance, colour and cosine, depth of the object at every candidate; a ring ray's limit stands for the
    /// distance, negative where the ray is empty, and its clearance for the depth.
    pub(crate) candidates: Vec<f32>,
    /// A mask of 64 voxels per brick of 4x4x4, in two words.
    pub(crate) occupancy: Vec<u32>,
    /// Minimum corner and voxel size, metres.
    pub(crate) origin: [f32; 4],
    /// Voxels along each axis.
    pub(crate) dims: [u32; 3],
    /// Bricks along each axis.
    pub(crate) bricks: [u32; 3],
    /// Columns of the rotation and the translation of every frame, padded to four numbers.
    pub(crate) poses: Vec<f32>,
}

impl Upload {
    pub(crate) fn new(round: &Round) -> Self {
        let sampler = &round.sampler;
        let (mut frames, mut candidates) = (Vec::new(), Vec::new());
        let mut slots = vec![NOWHERE; 2 * round.frames.len()];
        for (slot, &f) in sampler.surface_frames.iter().enumerate() {
            let rays = &sampler.rays()[f].surface;
            frames.extend([f as u32, (candidates.len() / 12) as u32, rays.dir.len() as u32, 0]);
            slots[2 * f] = slot as u32;
            for i in 0..rays.dir.len() {
                let ([x, y, z], [r, g, b]) = (rays.dir[i], rays.color[i]);
                candidates.extend([x, y, z, rays.distance[i], r, g, b, rays.cosine[i]]);
                candidates.extend([rays.depth[i], 0.0, 0.0, 0.0]);
            }
        }
        for (slot, &f) in sampler.ring_frames.iter().enumerate() {
            let rays = &sampler.rays()[f].ring;
            frames.extend([f as u32, (candidates.len() / 12) as u32, rays.dir.len() as u32, 0]);
            slots[2 * f + 1] = slot as u32;
            for i in 0..rays.dir.len() {
                let [x, y, z] = rays.dir[i];
                let limit = if rays.kind[i] == RingKind::Empty { -rays.limit[i] } else { rays.limit[i] };
                candidates.extend([x, y, z, limit, 0.0, 0.0, 0.0, 0.0, rays.clearance[i], 0.0, 0.0, 0.0]);
            }
        }
        let poses = round.corrections.ray_poses::<f32>();
        let poses = poses.iter().flat_map(|p| {
            let column = |a: usize| [p.rotation[0][a], p.rotation[1][a], p.rotation[2][a], 0.0];
            let [x, y, z] = p.translation;
            [column(0), column(1), column(2), [x, y, z, 0.0]].into_iter().flatten()
        });
        let octree = &sampler.volume().octree;
        let (origin, dims) = extent(octree);
        let bricks = dims.map(|d| d.div_ceil(4));
        Self {
            frames,
            slots,
            candidates,
            occupancy: masks(octree, origin, bricks),
            origin,
            dims,
            bricks,
            poses: poses.collect(),
        }
    }
}

/// Minimum corner with the voxel size, and voxels along each axis.
fn extent(octree: &VoxelOctree) -> ([f32; 4], [u32; 3]) {
    let (lo, hi) = octree.bounds();
    let size = octree.voxel_size();
    let dims = std::array::from_fn(|a| (((hi[a] - lo[a]) / size).round() as u32).max(1));
    ([lo[0], lo[1], lo[2], size], dims)
}

fn masks(octree: &VoxelOctree, origin: [f32; 4], bricks: [u32; 3]) -> Vec<u32> {
    let mut masks = vec![0; 2 * bricks.iter().product::<u32>() as usize];
    for corner in octree.voxels() {
        let cell: [u32; 3] = std::array::from_fn(|a| ((corner[a] - origin[a]) / origin[3]).round() as u32);
        let [bx, by, bz] = cell.map(|c| c / 4);
        let brick = ((bz * bricks[1] + by) * bricks[0] + bx) as usize;
        let bit = cell[0] % 4 + cell[1] % 4 * 4 + cell[2] % 4 * 16;
        masks[2 * brick + (bit / 32) as usize] |= 1 << (bit % 32);
    }
    masks
}
