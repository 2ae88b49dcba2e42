//! Walking a ray through the octree.

use crate::VoxelOctree;

/// A ray in cell coordinates, with what the walk needs precomputed per axis.
struct GridRay {
    origin: [f64; 3],
    dir: [f64; 3],
    /// Parameter of the plane at coordinate `k` is `k * slope + offset`; infinite for an axis the ray is parallel to.
    slope: [f64; 3],
    offset: [f64; 3],
    /// All ones for an axis along which the ray ascends, else zero.
    ascends: [i32; 3],
    t_start: f64,
    t_end: f64,
}

impl GridRay {
    /// `None` when the ray misses the grid within its range or is not a ray.
    fn new(octree: &VoxelOctree, origin: [f32; 3], dir: [f32; 3], t_min: f32, t_max: f32) -> Option<Self> {
        let finite = |v: [f32; 3]| v.iter().all(|c| c.is_finite());
        if !finite(origin) || !finite(dir) || dir == [0.0; 3] {
            return None;
        }
        let scale = 1.0 / octree.voxel_size;
        let origin = std::array::from_fn(|a| (f64::from(origin[a]) - octree.origin[a]) * scale);
        let dir = dir.map(|d| f64::from(d) * scale);
        let mut ray = Self {
            origin,
            dir,
            slope: [0.0; 3],
            offset: [f64::INFINITY; 3],
            ascends: [0; 3],
            t_start: f64::from(t_min.max(f32::MIN)),
            t_end: f64::from(t_max.min(f32::MAX)),
        };
        for a in 0..3 {
            let extent = octree.dims[a] as f64;
            if dir[a] == 0.0 {
                if !(origin[a] >= 0.0 && origin[a] < extent) {
                    return None;
                }
                continue;
            }
            ray.slope[a] = 1.0 / dir[a];
            ray.offset[a] = -origin[a] * ray.slope[a];
            ray.ascends[a] = if dir[a] > 0.0 { -1 } else { 0 };
            let (near, far) = (ray.offset[a], extent * ray.slope[a] + ray.offset[a]);
            ray.t_start = ray.t_start.max(near.min(far));
            ray.t_end = ray.t_end.min(near.max(far));
        }
        // `max` and `min` drop a NaN, so it is looked for in the arguments.
        let ranged = !t_min.is_nan() && !t_max.is_nan() && ray.t_start < ray.t_end;
        ranged.then_some(ray)
    }

    /// Parameter at which the ray is on the plane at coordinate `k` of an axis.
    #[inline]
    fn plane(&self, axis: usize, k: i32) -> f64 {
        f64::from(k) * self.slope[axis] + self.offset[axis]
    }

    /// Cell coordinate along one axis at parameter `t`, limited to `lo..=hi`. Truncation is floor: `lo >= 0`.
    #[inline]
    fn cell(&self, axis: usize, t: f64, lo: i32, hi: i32) -> i32 {
        ((self.origin[axis] + t * self.dir[axis]) as i32).clamp(lo, hi)
    }
}

impl VoxelOctree {
    /// Parameter intervals `[t_in, t_out]` in which `origin + t * dir` is inside occupied voxels and
    /// `t_min <= t <= t_max`.
    ///
    /// `out` is cleared first and reused; the intervals in it are sorted, disjoint, of positive length, and touching
    /// ones are merged. `t` counts lengths of `dir`, which need not be a unit vector: with the camera ray
    /// `[(u - cx) / fx, (v - cy) / fy, 1]` it is the depth. The result is empty for a ray that misses, for a zero
    /// or non-finite `dir` or `origin`, a NaN bound, or `t_min >= t_max`; infinite bounds are allowed, the result is finite.
    pub fn intervals(
        &self,
        origin: [f32; 3],
        dir: [f32; 3],
        t_min: f32,
        t_max: f32,
        out: &mut Vec<[f32; 2]>,
    ) {
        out.clear();
        let Some(ray) = GridRay::new(self, origin, dir, t_min, t_max) else { return };
        let mut walk = Walk {
            cell: std::array::from_fn(|a| ray.cell(a, ray.t_start, 0, self.dims[a] as i32 - 1)),
            t: ray.t_start,
            entered: None,
            out,
        };
        while (0..3).all(|a| walk.cell[a] >= 0 && walk.cell[a] < self.dims[a] as i32) && walk.t < ray.t_end {
            let (size, voxels) = self.block_around(walk.cell.map(|c| c as usize));
            if voxels == 0 || voxels == u64::MAX {
                walk.cross_block(&ray, size, voxels != 0);
            } else {
                walk.cross_brick(&ray, voxels);
            }
        }
        walk.note(false, walk.t.min(ray.t_end));
    }
}

/// Where a walk along a ray is.
struct Walk<'a> {
    cell: [i32; 3],
    /// Parameter at which the ray entered the cell.
    t: f64,
    /// Parameter at which the ray entered the occupied voxels that it is in.
    entered: Option<f64>,
    out: &'a mut Vec<[f32; 2]>,
}

impl Walk<'_> {
    /// Begins or ends an interval at `t` where occupancy changes.
    #[inline]
    fn note(&mut self, occupied: bool, t: f64) {
        if occupied {
            self.entered.get_or_insert(t);
        } else if let Some(start) = self.entered.take() {
            push(self.out, start, t);
        }
    }

    /// Leaves a block whose voxels are all alike in one step.
    #[inline]
    fn cross_block(&mut self, ray: &GridRay, size: i32, occupied: bool) {
        self.note(occupied, self.t);
        let low = self.cell.map(|c| c & -size);
        // The plane through which the ray leaves the block along each axis.
        let leave: [i32; 3] = std::array::from_fn(|a| low[a] + (size & ray.ascends[a]));
        let at: [f64; 3] = std::array::from_fn(|a| ray.plane(a, leave[a]));
        let axis = least(at);
        // Rounding may place a plane slightly behind: the parameter never runs backwards.
        self.t = at[axis].max(self.t);
        for a in 0..3 {
            // Within the block, and never back against the ray.
            let (lo, hi) =
                if ray.ascends[a] != 0 { (self.cell[a], low[a] + size - 1) } else { (low[a], self.cell[a]) };
            self.cell[a] = ray.cell(a, self.t, lo, hi);
        }
        // Ascending, the next cell starts at the plane; descending, it ends there.
        self.cell[axis] = leave[axis] - 1 - ray.ascends[axis];
    }

    /// Goes voxel by voxel until the ray leaves the brick or ends.
    #[inline]
    fn cross_brick(&mut self, ray: &GridRay, voxels: u64) {
        let mut cell = self.cell;
        let mut at: [f64; 3] = std::array::from_fn(|a| ray.plane(a, cell[a] - ray.ascends[a]));
        loop {
            let voxel = cell[0] & 3 | (cell[1] & 3) << 2 | (cell[2] & 3) << 4;
            self.note(voxels >> voxel & 1 != 0, self.t);
            let axis = least(at);
            self.t = at[axis].max(self.t);
            // One step: +1 ascending, -1 descending.
            let next = cell[axis] - 1 - 2 * ray.ascends[axis];
            let inside = (next ^ cell[axis]) & !3 == 0;
            cell[axis] = next;
            if !inside || self.t >= ray.t_end {
                break;
            }
            at[axis] = ray.plane(axis, next - ray.ascends[axis]);
        }
        self.cell = cell;
    }
}

/// Axis of the least of three parameters.
#[inline]
fn least(at: [f64; 3]) -> usize {
    let first = usize::from(at[1] < at[0]);
    if at[2] < at[first] { 2 } else { first }
}

/// Appends an interval, or extends the last one when rounding to `f32` makes them touch.
fn push(out: &mut Vec<[f32; 2]>, start: f64, end: f64) {
    let (start, end) = (start as f32, end as f32);
    match out.last_mut() {
        Some(last) if start <= last[1] => last[1] = last[1].max(end),
        _ if start < end => out.push([start, end]),
        _ => {}
    }
}
