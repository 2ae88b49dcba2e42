//! Where the object is: the fused cloud's main cluster, the cube of the field around it, and its occupancy.

use crate::config::FieldConfig;
use crate::frame::FieldImages;
use nalgebra::Isometry3;
use octree_sampler::VoxelOctree;
use std::collections::HashMap;
use std::sync::Arc;

/// Points per frame that enter the fused cloud.
const POINTS_PER_FRAME: usize = 6000;

/// The cube in which the field lives and the occupied part of it, metres in the object frame.
#[derive(Clone, Debug)]
pub(crate) struct Volume {
    pub(crate) center: [f64; 3],
    pub(crate) edge: f64,
    pub(crate) octree: VoxelOctree,
}

impl Volume {
    /// Fuses the frames' masked depth under the given poses; `None` without any.
    pub(crate) fn build(
        frames: &[Arc<FieldImages>],
        poses: &[Isometry3<f64>],
        config: &FieldConfig,
    ) -> Option<Self> {
        let cloud = fuse(frames, poses);
        let voxel = config.voxel_size.min(typical_extent(&cloud)? / 12.0).max(1e-6);
        let cloud = largest_cluster(&cloud, voxel);
        let (lo, hi) = bounds(&cloud)?;
        let extent = (0..3).map(|a| hi[a] - lo[a]).fold(0.0, f64::max);
        let octree = VoxelOctree::from_points(&cloud, voxel as f32, 1)?;
        Some(Self {
            center: std::array::from_fn(|a| 0.5 * (lo[a] + hi[a])),
            // Room for the dilated occupancy, also when one flat view is all there is.
            edge: (extent * config.volume_scale).max(extent + 4.0 * f64::from(octree.voxel_size())),
            octree,
        })
    }
}

/// Occupied voxels of the frames' main cluster, as [`Volume::build`] makes them but of a given size.
pub(crate) fn occupancy(
    frames: &[Arc<FieldImages>],
    poses: &[Isometry3<f64>],
    voxel: f32,
) -> Option<VoxelOctree> {
    let cloud = fuse(frames, poses);
    VoxelOctree::from_points(&largest_cluster(&cloud, f64::from(voxel)), voxel, 1)
}

fn fuse(frames: &[Arc<FieldImages>], poses: &[Isometry3<f64>]) -> Vec<[f32; 3]> {
    let mut cloud = Vec::new();
    for (frame, pose) in frames.iter().zip(poses) {
        frame.points(pose, POINTS_PER_FRAME, &mut cloud);
    }
    cloud.retain(|p| p.iter().all(|v| v.is_finite()));
    cloud
}

/// Largest distance along an axis between the 5th and 95th percentile of the coordinates.
fn typical_extent(cloud: &[[f32; 3]]) -> Option<f64> {
    if cloud.is_empty() {
        return None;
    }
    let spread = (0..3).map(|a| {
        let mut v: Vec<f32> = cloud.iter().map(|p| p[a]).collect();
        v.sort_unstable_by(f32::total_cmp);
        f64::from(v[(v.len() - 1) * 95 / 100]) - f64::from(v[(v.len() - 1) * 5 / 100])
    });
    Some(spread.fold(0.0, f64::max))
}

fn bounds(cloud: &[[f32; 3]]) -> Option<([f64; 3], [f64; 3])> {
    let first = cloud.first()?.map(f64::from);
    Some(cloud.iter().fold((first, first), |(lo, hi), p| {
        (
            std::array::from_fn(|a| lo[a].min(f64::from(p[a]))),
            std::array::from_fn(|a| hi[a].max(f64::from(p[a]))),
        )
    }))
}

/// The points of the largest set of voxels connected over faces, edges or corners: drops what a bad mask let in.
fn largest_cluster(cloud: &[[f32; 3]], voxel: f64) -> Vec<[f32; 3]> {
    let key = |p: &[f32; 3]| p.map(|v| (f64::from(v) / voxel).floor().clamp(-1e9, 1e9) as i32);
    let mut index: HashMap<[i32; 3], u32> = HashMap::new();
    let mut cells: Vec<([i32; 3], usize)> = Vec::new();
    for p in cloud {
        let k = key(p);
        let i = *index.entry(k).or_insert_with(|| {
            cells.push((k, 0));
            (cells.len() - 1) as u32
        });
        cells[i as usize].1 += 1;
    }
    let mut label = vec![u32::MAX; cells.len()];
    let (mut best, mut best_size) = (0u32, 0usize);
    let mut stack = Vec::new();
    for start in 0..cells.len() {
        if label[start] != u32::MAX {
            continue;
        }
        let name = start as u32;
        let mut size = 0;
        label[start] = name;
        stack.push(start);
        while let Some(i) = stack.pop() {
            let (k, count) = cells[i];
            size += count;
            for n in 0..27 {
                let near = [k[0] + n % 3 - 1, k[1] + n / 3 % 3 - 1, k[2] + n / 9 - 1];
                if let Some(&j) = index.get(&near)
                    && label[j as usize] == u32::MAX
                {
                    label[j as usize] = name;
                    stack.push(j as usize);
                }
            }
        }
        if size > best_size {
            (best, best_size) = (name, size);
        }
    }
    cloud.iter().filter(|p| index.get(&key(p)).is_some_and(|&i| label[i as usize] == best)).copied().collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn far_clusters_are_dropped() {
        let mut cloud: Vec<[f32; 3]> = (0..1000).map(|i| [i as f32 * 1e-4, 0.0, 0.0]).collect();
        cloud.extend((0..100).map(|i| [5.0, i as f32 * 1e-4, 0.0]));
        let kept = largest_cluster(&cloud, 0.01);
        assert_eq!(kept.len(), 1000);
        assert!(typical_extent(&[]).is_none());
    }
}
