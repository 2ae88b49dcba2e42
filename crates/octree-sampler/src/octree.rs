//! The voxel octree: building it from points and asking it for occupancy.

use crate::bitset::{GridBits, ones};

/// Upper bound on voxels along each axis, dilation included. A cloud that needs more gets coarser voxels.
pub const MAX_CELLS_PER_AXIS: usize = 512;

/// Upper bound on the dilation radius in voxels; a larger request is lowered to it.
pub const MAX_DILATION: u32 = 64;

/// Sparse occupancy of voxels over the tight box around a point cloud.
///
/// Three levels of 4x4x4 masks: a block of 16 voxels a side knows which of its 64 bricks hold anything, a brick of
/// 4 voxels a side knows which of its 64 voxels are occupied. Voxels are half open, `[corner, corner + size)`, and
/// lie on the lattice of multiples of [`voxel_size`](Self::voxel_size).
#[derive(Clone, Debug)]
pub struct VoxelOctree {
    pub(crate) voxel_size: f64,
    /// Minimum corner of cell (0, 0, 0).
    pub(crate) origin: [f64; 3],
    /// Cells along each axis.
    pub(crate) dims: [usize; 3],
    /// Blocks along each axis.
    block_dims: [usize; 3],
    /// One mask of bricks a block, blocks x fastest.
    blocks: Vec<u64>,
    /// 64 masks of voxels a block.
    bricks: Vec<u64>,
    len: usize,
}

impl VoxelOctree {
    /// Occupies the voxel of every finite point and its 26-neighbourhood up to `dilation` voxels away.
    ///
    /// `points` and `voxel_size` share one unit (metres). Points with a coordinate that is not finite are skipped;
    /// `None` when none is left or `voxel_size` is not a positive finite number. The voxel size is doubled until
    /// the dilated cloud fits [`MAX_CELLS_PER_AXIS`] and until it is well above the resolution of `f32` at the
    /// cloud's distance from zero, so memory stays under 20 MiB however far an outlier lies: remove outliers
    /// first, and read the result's [`voxel_size`](Self::voxel_size). `dilation` counts voxels of that final size.
    #[must_use]
    pub fn from_points(points: &[[f32; 3]], voxel_size: f32, dilation: u32) -> Option<Self> {
        if !(voxel_size > 0.0 && voxel_size.is_finite()) {
            return None;
        }
        let (lo, hi) = finite_bounds(points)?;
        let dilation = dilation.min(MAX_DILATION) as usize;
        let reach = (0..3).fold(0.0f64, |m, a| m.max(lo[a].abs()).max(hi[a].abs()));
        let cells = |size: f64| {
            (0..3).map(|a| (hi[a] / size).floor() - (lo[a] / size).floor()).fold(0.0, f64::max) + 1.0
        };
        let room = (MAX_CELLS_PER_AXIS - 2 * dilation) as f64;
        let mut size = f64::from(voxel_size);
        while size < reach * f64::from(f32::EPSILON) * 8.0 || cells(size) > room {
            size *= 2.0;
        }

        let first = lo.map(|v| (v / size).floor());
        let origin = first.map(|f| (f - dilation as f64) * size);
        let inner: [usize; 3] = std::array::from_fn(|a| ((hi[a] / size).floor() - first[a]) as usize + 1);
        let dims = inner.map(|n| n + 2 * dilation);
        let mut bits = GridBits::new(dims);
        for point in finite(points) {
            bits.set(std::array::from_fn(|a| {
                let cell = (f64::from(point[a]) / size).floor() - first[a];
                (cell as usize).min(inner[a] - 1) + dilation
            }));
        }
        bits.dilate(dilation);
        Some(Self::from_bits(size, origin, dims, &bits))
    }

    fn from_bits(voxel_size: f64, origin: [f64; 3], dims: [usize; 3], bits: &GridBits) -> Self {
        let block_dims = dims.map(|n| n.div_ceil(16));
        let count = block_dims[0] * block_dims[1] * block_dims[2];
        let mut octree = Self {
            voxel_size,
            origin,
            dims,
            block_dims,
            blocks: vec![0; count],
            bricks: vec![0; 64 * count],
            len: 0,
        };
        for cell in bits.iter() {
            let (block, brick, voxel) = octree.address(cell);
            octree.blocks[block] |= 1 << brick;
            octree.bricks[64 * block + brick] |= 1 << voxel;
            octree.len += 1;
        }
        octree
    }

    /// Block, brick within the block and voxel within the brick of a cell.
    #[inline]
    fn address(&self, [x, y, z]: [usize; 3]) -> (usize, usize, usize) {
        let block = (x >> 4) + self.block_dims[0] * ((y >> 4) + self.block_dims[1] * (z >> 4));
        let brick = (x >> 2 & 3) | (y >> 2 & 3) << 2 | (z >> 2 & 3) << 4;
        (block, brick, (x & 3) | (y & 3) << 2 | (z & 3) << 4)
    }

    /// Side length in cells (16 or 4) of the largest aligned block around a cell about which one mask tells all, and
    /// that mask: 0 for a block without occupied voxels, else the voxels of a brick. The cell must be in the grid.
    #[inline]
    pub(crate) fn block_around(&self, cell: [usize; 3]) -> (i32, u64) {
        let (block, brick, _) = self.address(cell);
        if self.blocks[block] == 0 { (16, 0) } else { (4, self.bricks[64 * block + brick]) }
    }

    /// Side length of a voxel, in the unit of the points. A power of two times the size asked for.
    #[must_use]
    pub fn voxel_size(&self) -> f32 {
        self.voxel_size as f32
    }

    /// Number of occupied voxels.
    #[must_use]
    pub fn len(&self) -> usize {
        self.len
    }

    /// Never true for an octree made by [`from_points`](Self::from_points).
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Minimum and maximum corner of the tight box around the occupied voxels.
    #[must_use]
    pub fn bounds(&self) -> ([f32; 3], [f32; 3]) {
        (self.corner([0; 3]), self.corner(self.dims))
    }

    /// Whether a point lies in an occupied voxel. False for a point that is not finite.
    #[must_use]
    pub fn contains(&self, p: [f32; 3]) -> bool {
        let cell: [f64; 3] = std::array::from_fn(|a| (f64::from(p[a]) - self.origin[a]) / self.voxel_size);
        if !(0..3).all(|a| cell[a] >= 0.0 && cell[a] < self.dims[a] as f64) {
            return false;
        }
        let (block, brick, voxel) = self.address(cell.map(|c| c as usize));
        self.bricks[64 * block + brick] >> voxel & 1 != 0
    }

    /// Minimum corners of the occupied voxels, block by block in a fixed order.
    pub fn voxels(&self) -> impl Iterator<Item = [f32; 3]> + '_ {
        let [bx, by, _] = self.block_dims;
        let spread = |i: usize| [i & 3, i >> 2 & 3, i >> 4];
        self.blocks.iter().enumerate().flat_map(move |(block, &bricks)| {
            let b = [block % bx, block / bx % by, block / (bx * by)];
            ones(bricks).flat_map(move |brick| {
                let c = spread(brick);
                ones(self.bricks[64 * block + brick]).map(move |voxel| {
                    let v = spread(voxel);
                    self.corner(std::array::from_fn(|a| 16 * b[a] + 4 * c[a] + v[a]))
                })
            })
        })
    }

    fn corner(&self, cell: [usize; 3]) -> [f32; 3] {
        std::array::from_fn(|a| (self.origin[a] + cell[a] as f64 * self.voxel_size) as f32)
    }
}

fn finite(points: &[[f32; 3]]) -> impl Iterator<Item = &[f32; 3]> {
    points.iter().filter(|p| p.iter().all(|v| v.is_finite()))
}

fn finite_bounds(points: &[[f32; 3]]) -> Option<([f64; 3], [f64; 3])> {
    let mut bounds = None;
    for p in finite(points) {
        let p = p.map(f64::from);
        let (lo, hi) = bounds.get_or_insert((p, p));
        for a in 0..3 {
            lo[a] = lo[a].min(p[a]);
            hi[a] = hi[a].max(p[a]);
        }
    }
    bounds
}
