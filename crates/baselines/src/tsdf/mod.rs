//! Truncated signed distances of an object, fused from masked depth and colour.
//!
//! Curless and Levoy, *A volumetric method for building complex models from range images*, SIGGRAPH 1996: each voxel
//! holds the weighted mean of the distances that the views measured along their rays. Only blocks of 8x8x8 voxels near
//! a surface exist (Nießner et al., *Real-time 3D reconstruction at scale using voxel hashing*, 2013); as the object
//! has a bound, a dense table of blocks takes the place of the hash.

mod integrate;
mod mesh;
mod raycast;

use crate::rigid::{add, scale};
pub use integrate::DepthView;

/// Voxels along a block's edge.
const SIDE: i32 = 8;
/// Voxels of a block.
const BLOCK: usize = 512;
/// Blocks along an edge of the table, at most.
const MAX_TABLE: i32 = 160;
const EMPTY: u32 = u32::MAX;
/// Colour of a voxel that was only seen to be empty.
const NO_COLOR: [f32; 3] = [-1.0; 3];

/// Resolution and bounds of a [`TsdfVolume`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TsdfOptions {
    /// Edge of a voxel, metres.
    pub voxel_m: f32,
    /// Distances are cut off at plus and minus this, metres; at least two voxels.
    pub truncation_m: f32,
    /// The mean forgets beyond this weight, so that the model can follow.
    pub max_weight: f32,
    /// The volume is the cube of this half edge around the origin, metres, rounded up to whole blocks (at most 640 voxels).
    pub radius_m: f32,
    /// No more than this many blocks of 8x8x8 voxels (10 KiB each); surface beyond them is left out.
    pub max_blocks: usize,
}

impl Default for TsdfOptions {
    fn default() -> Self {
        Self { voxel_m: 0.002, truncation_m: 0.01, max_weight: 64.0, radius_m: 0.3, max_blocks: 20_000 }
    }
}

/// A sparse volume of truncated signed distances (metres, positive outside) with colour, in the object's frame.
///
/// Voxels are centred on the whole multiples of [`TsdfOptions::voxel_m`]. Options that are no positive numbers give a
/// volume that stays empty.
#[derive(Clone, Debug)]
pub struct TsdfVolume {
    options: TsdfOptions,
    inverse_voxel: f32,
    /// The table has `2 * half` blocks along an edge and its middle at the origin.
    half: i32,
    table: Vec<u32>,
    coords: Vec<[i32; 3]>,
    /// 512 values a block, x fastest.
    distance: Vec<f32>,
    /// 0 = not observed.
    weight: Vec<f32>,
    color: Vec<[f32; 3]>,
}

impl TsdfVolume {
    /// An empty volume.
    pub fn new(options: TsdfOptions) -> Self {
        let usable = [options.voxel_m, options.truncation_m, options.max_weight, options.radius_m]
            .iter()
            .all(|v| *v > 0.0 && v.is_finite());
        let half = if usable {
            (options.radius_m / (options.voxel_m * SIDE as f32)).ceil().clamp(1.0, (MAX_TABLE / 2) as f32)
        } else {
            0.0
        } as i32;
        let options =
            TsdfOptions { truncation_m: options.truncation_m.max(2.0 * options.voxel_m), ..options };
        Self {
            options,
            inverse_voxel: 1.0 / options.voxel_m,
            half,
            table: vec![EMPTY; (8 * half * half * half) as usize],
            coords: Vec::new(),
            distance: Vec::new(),
            weight: Vec::new(),
            color: Vec::new(),
        }
    }

    /// The options in force.
    pub fn options(&self) -> &TsdfOptions {
        &self.options
    }

    /// Number of blocks of 8x8x8 voxels in use.
    pub fn blocks(&self) -> usize {
        self.coords.len()
    }

    /// Where block `b` is or would be in the table; `None` outside the bound.
    #[inline(always)]
    fn table_index(&self, b: [i32; 3]) -> Option<usize> {
        let n = 2 * self.half;
        let [x, y, z] = b.map(|c| c.wrapping_add(self.half));
        let inside = (0..n).contains(&x) && (0..n).contains(&y) && (0..n).contains(&z);
        inside.then_some(((z * n + y) * n + x) as usize)
    }

    /// Number of block `b`, if it is in use.
    #[inline(always)]
    fn block(&self, b: [i32; 3]) -> Option<usize> {
        let block = self.table[self.table_index(b)?];
        (block != EMPTY).then_some(block as usize)
    }

    /// Place of voxel `c` in the arrays, if its block is in use.
    #[inline(always)]
    fn slot(&self, c: [i32; 3]) -> Option<usize> {
        let block = self.block(c.map(|v| v >> 3))?;
        Some(block * BLOCK + ((c[2] & 7) << 6 | (c[1] & 7) << 3 | (c[0] & 7)) as usize)
    }

    /// The eight voxels around `p` and their interpolation weights; those of weight 0 need not be observed.
    #[inline]
    fn corners(&self, p: [f32; 3]) -> Option<([usize; 8], [f32; 8])> {
        // Mesh vertices and lattice points lie on voxels but for rounding: they must not ask for the voxel beyond.
        const SNAP: f32 = 1e-3;
        let q = p.map(|v| v * self.inverse_voxel);
        if !q.iter().all(|v| v.abs() < 1e6) {
            return None;
        }
        let mut base = [0_i32; 3];
        let mut part = [0.0_f32; 3];
        for a in 0..3 {
            let floor = (q[a] + SNAP).floor();
            base[a] = floor as i32;
            let f = q[a] - floor;
            part[a] = if f < SNAP { 0.0 } else { f };
        }
        let [fx, fy, fz] = part;
        let (gx, gy, gz) = (1.0 - fx, 1.0 - fy, 1.0 - fz);
        let weights = [
            gx * gy * gz,
            fx * gy * gz,
            gx * fy * gz,
            fx * fy * gz,
            gx * gy * fz,
            fx * gy * fz,
            gx * fy * fz,
            fx * fy * fz,
        ];
        let slots = if base.iter().all(|v| v & 7 != 7) {
            let first = self.slot(base)?;
            let slots = [0, 1, 8, 9, 64, 65, 72, 73].map(|o| first + o);
            let observed = slots.iter().zip(&weights).all(|(&s, &w)| w == 0.0 || self.weight[s] > 0.0);
            if !observed {
                return None;
            }
            slots
        } else {
            let mut slots = [0; 8];
            for (i, slot) in slots.iter_mut().enumerate() {
                if weights[i] == 0.0 {
                    continue;
                }
                let i = i as i32;
                *slot = self.slot([base[0] + (i & 1), base[1] + (i >> 1 & 1), base[2] + (i >> 2)])?;
                if self.weight[*slot] <= 0.0 {
                    return None;
                }
            }
            slots
        };
        Some((slots, weights))
    }

    /// Signed distance at `p` (object frame, metres), between minus and plus the truncation, by trilinear
    /// interpolation; `None` where a voxel around it was not observed.
    #[inline]
    pub fn sample(&self, p: [f32; 3]) -> Option<f32> {
        let (slots, weights) = self.corners(p)?;
        Some(slots.iter().zip(&weights).map(|(&s, &w)| w * self.distance[s]).sum())
    }

    /// Colour at `p` (object frame, metres); `None` where a voxel around it was not observed, or none is near a
    /// surface.
    pub fn color(&self, p: [f32; 3]) -> Option<[u8; 3]> {
        let (slots, weights) = self.corners(p)?;
        let (mut sum, mut total) = ([0.0; 3], 0.0);
        for (&slot, &w) in slots.iter().zip(&weights) {
            let color = self.color[slot];
            if w > 0.0 && color != NO_COLOR {
                sum = add(sum, scale(color, w));
                total += w;
            }
        }
        (total > 0.0).then(|| sum.map(|c| (c / total).round().clamp(0.0, 255.0) as u8))
    }

    /// Gradient of the distance at `p` (object frame) by central differences over two voxels: about of length 1 and
    /// outwards near a surface. `None` where a voxel was not observed.
    pub fn gradient(&self, p: [f32; 3]) -> Option<[f32; 3]> {
        let h = self.options.voxel_m;
        let mut gradient = [0.0; 3];
        for a in 0..3 {
            let (mut before, mut after) = (p, p);
            before[a] -= h;
            after[a] += h;
            gradient[a] = (self.sample(after)? - self.sample(before)?) / (2.0 * h);
        }
        Some(gradient)
    }

    /// Calls `f(centre, distance, weight)` for each observed voxel within `band` metres of the surface, of whose
    /// coordinates every `stride`-th is taken. The order is that in which the blocks came to be.
    pub(crate) fn near_surface(&self, band: f32, stride: usize, mut f: impl FnMut([f32; 3], f32, f32)) {
        let stride = stride.clamp(1, 8);
        for (block, coord) in self.coords.iter().enumerate() {
            for z in (0..8).step_by(stride) {
                for y in (0..8).step_by(stride) {
                    for x in (0..8).step_by(stride) {
                        let slot = block * BLOCK + (z << 6 | y << 3 | x);
                        if self.weight[slot] > 0.0 && self.distance[slot].abs() < band {
                            let voxel =
                                [coord[0] * 8 + x as i32, coord[1] * 8 + y as i32, coord[2] * 8 + z as i32];
                            let centre = voxel.map(|v| v as f32 * self.options.voxel_m);
                            f(centre, self.distance[slot], self.weight[slot]);
                        }
                    }
                }
            }
        }
    }
}
