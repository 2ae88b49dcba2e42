//! The multi-resolution feature grid (Müller et al., Instant NGP, 2022, section 3): trilinear interpolation on a
//! few lattices, dense where they fit the table, hashed where they do not.

use crate::real::Real;

/// Features per lattice vertex. Fixed: a pair of vertices is then one 128-bit load.
pub(crate) const FEATURES: usize = 2;

/// Vertices of one lattice in memory; a multiple of it is allocated, and Adam updates whole groups.
pub(crate) const GROUP: usize = 8;

/// One lattice over the unit cube.
#[derive(Clone, Debug)]
pub(crate) struct Level {
    /// Vertices per axis.
    pub(crate) vertices: u32,
    /// Cells per unit; a point lies at `p * scale + 0.5` in vertex units (the half keeps the lattices of
    /// different levels from sharing vertices).
    pub(crate) scale: f64,
    /// Number of stored vertices.
    pub(crate) len: usize,
    pub(crate) hash_mask: Option<u32>,
}

impl Level {
    fn new(resolution: f64, log2_table: u32) -> Self {
        let scale = resolution - 1.0;
        let vertices = scale.ceil() as u32 + 2;
        let dense = (vertices as usize).pow(3);
        let table = 1usize << log2_table;
        if dense <= table {
            Self { vertices, scale, len: dense.next_multiple_of(GROUP), hash_mask: None }
        } else {
            Self { vertices, scale, len: table, hash_mask: Some((table - 1) as u32) }
        }
    }
}

/// The eight vertices around a point: rows along x for (y, z) = (0, 0), (1, 0), (0, 1), (1, 1).
pub(crate) struct Corners<R> {
    pub(crate) rows: [[usize; 2]; 4],
    pub(crate) frac: [R; 3],
}

/// Trilinear values at a point and their derivatives by position.
pub(crate) struct Interpolated<R> {
    pub(crate) value: [R; FEATURES],
    pub(crate) slope: [[R; 3]; FEATURES],
}

impl Level {
    /// Corners of the cell around `p`, a point of the unit cube (clamped to it).
    #[inline(always)]
    pub(crate) fn corners<R: Real>(&self, p: [R; 3]) -> Corners<R> {
        let scale = R::of(self.scale);
        let mut cell = [0u32; 3];
        let mut frac = [R::ZERO; 3];
        for a in 0..3 {
            let x = p[a] * scale + R::of(0.5);
            let i = x.trunc_int().clamp(0, self.vertices as i32 - 2);
            cell[a] = i as u32;
            frac[a] = x - R::of(f64::from(i));
        }
        let [x, y, z] = cell;
        let rows = match self.hash_mask {
            None => {
                let n = self.vertices as usize;
                let base = (z as usize * n + y as usize) * n + x as usize;
                [base, base + n, base + n * n, base + n * n + n].map(|r| [r, r + 1])
            }
            Some(mask) => {
                let (y0, y1) = (y.wrapping_mul(HASH_Y), (y + 1).wrapping_mul(HASH_Y));
                let (z0, z1) = (z.wrapping_mul(HASH_Z), (z + 1).wrapping_mul(HASH_Z));
                [y0 ^ z0, y1 ^ z0, y0 ^ z1, y1 ^ z1]
                    .map(|h| [((h ^ x) & mask) as usize, ((h ^ (x + 1)) & mask) as usize])
            }
        };
        Corners { rows, frac }
    }

    /// A row of the table: features of the two vertices, `[a0, a1, b0, b1]`.
    #[inline(always)]
    fn row<R: Real>(&self, table: &[R], [a, b]: [usize; 2]) -> [R; 4] {
        if self.hash_mask.is_none()
            && let Some(row) = table[FEATURES * a..].first_chunk::<4>()
        {
            return *row;
        }
        [table[2 * a], table[2 * a + 1], table[2 * b], table[2 * b + 1]]
    }

    /// Values and derivatives by the position in the unit cube.
    #[inline(always)]
    pub(crate) fn interpolate<R: Real>(&self, table: &[R], p: [R; 3]) -> Interpolated<R> {
        let Corners { rows, frac: [fx, fy, fz] } = self.corners(p);
        let r = rows.map(|row| self.row(table, row));
        let scale = R::of(self.scale);
        let mut rr = [R::ZERO; 4];
        let mut dy = [R::ZERO; 4];
        let mut dz = [R::ZERO; 4];
        for c in 0..4 {
            let (d0, d1) = (r[1][c] - r[0][c], r[3][c] - r[2][c]);
            let (y0, y1) = (r[0][c] + fy * d0, r[2][c] + fy * d1);
            dz[c] = y1 - y0;
            rr[c] = y0 + fz * dz[c];
            dy[c] = d0 + fz * (d1 - d0);
        }
        let along_x = |v: &[R; 4], f: usize| v[f] + fx * (v[2 + f] - v[f]);
        Interpolated {
            value: std::array::from_fn(|f| along_x(&rr, f)),
            slope: std::array::from_fn(|f| {
                [scale * (rr[2 + f] - rr[f]), scale * along_x(&dy, f), scale * along_x(&dz, f)]
            }),
        }
    }

    /// Mixed second derivatives `[d2/dxdy, d2/dxdz, d2/dydz]` of each feature (the pure ones are zero).
    #[inline(always)]
    pub(crate) fn mixed<R: Real>(&self, table: &[R], p: [R; 3]) -> [[R; 3]; FEATURES] {
        let Corners { rows, frac: [fx, fy, fz] } = self.corners(p);
        let r = rows.map(|row| self.row(table, row));
        let scale2 = R::of(self.scale * self.scale);
        std::array::from_fn(|f| {
            let dx = [0, 1, 2, 3].map(|i| r[i][2 + f] - r[i][f]);
            let xy = (dx[1] - dx[0]) + fz * ((dx[3] - dx[2]) - (dx[1] - dx[0]));
            let xz = (dx[2] - dx[0]) + fy * ((dx[3] - dx[1]) - (dx[2] - dx[0]));
            let twist = |c: usize| (r[3][c] - r[2][c]) - (r[1][c] - r[0][c]);
            let yz = twist(f) + fx * (twist(2 + f) - twist(f));
            [scale2 * xy, scale2 * xz, scale2 * yz]
        })
    }

    /// Adds to the vertices' gradients what a gradient `value` of the features at `p` and a gradient
    /// `v[f] * gamma[i]` of their derivatives amount to; marks the groups of vertices it touched.
    #[inline(always)]
    pub(crate) fn scatter<R: Real>(
        &self,
        p: [R; 3],
        value: [R; FEATURES],
        slope: Option<([R; 3], [R; FEATURES])>,
        grad: &mut [R],
        touched: &mut [u64],
    ) {
        let Corners { rows, frac: [fx, fy, fz] } = self.corners(p);
        let (gx, gy, gz) = (R::ONE - fx, R::ONE - fy, R::ONE - fz);
        let wyz = [gy * gz, fy * gz, gy * fz, fy * fz];
        let wx = [gx, fx];
        let scale = R::of(self.scale);
        for (i, row) in rows.iter().enumerate() {
            for (side, &entry) in row.iter().enumerate() {
                let w = wyz[i] * wx[side];
                let mut add: [R; FEATURES] = std::array::from_fn(|f| w * value[f]);
                if let Some((gamma, v)) = &slope {
                    let sign = |up: bool| if up { R::ONE } else { -R::ONE };
                    let (wy, wz) = (if i & 1 == 1 { fy } else { gy }, if i & 2 == 2 { fz } else { gz });
                    let dw = scale
                        * (gamma[0] * sign(side == 1) * wyz[i]
                            + gamma[1] * sign(i & 1 == 1) * wx[side] * wz
                            + gamma[2] * sign(i & 2 == 2) * wx[side] * wy);
                    for f in 0..FEATURES {
                        add[f] += dw * v[f];
                    }
                }
                let at = FEATURES * entry;
                grad[at] += add[0];
                grad[at + 1] += add[1];
                let group = entry / GROUP;
                touched[group / 64] |= 1 << (group % 64);
            }
        }
    }
}

const HASH_Y: u32 = 2_654_435_761;
const HASH_Z: u32 = 805_459_861;

/// All lattices with their tables (`FEATURES` numbers a vertex).
#[derive(Clone, Debug)]
pub(crate) struct Grid<R> {
    pub(crate) levels: Vec<Level>,
    pub(crate) tables: Vec<Vec<R>>,
}

impl<R: Real> Grid<R> {
    /// Lattices from `base` to `finest` cells a side in geometric steps, features uniform in +-`amplitude`.
    pub(crate) fn new(
        levels: usize,
        (base, finest): (u32, u32),
        log2_table: u32,
        amplitude: f64,
        seed: u64,
    ) -> Self {
        let growth = if levels > 1 {
            (f64::from(finest) / f64::from(base)).powf(1.0 / (levels - 1) as f64)
        } else {
            1.0
        };
        let levels: Vec<Level> = (0..levels)
            .map(|l| {
                // Powers of a rounded root: 128 must not become 127.99999.
                let r = f64::from(base) * growth.powi(l as i32);
                Level::new(if (r - r.round()).abs() < 1e-6 { r.round() } else { r }, log2_table)
            })
            .collect();
        let tables = levels
            .iter()
            .enumerate()
            .map(|(l, level)| {
                (0..level.len * FEATURES)
                    .map(|i| {
                        let h = mix(seed ^ mix(((l as u64) << 40) ^ i as u64));
                        R::of(((h >> 40) as f64 / (1u64 << 23) as f64 - 1.0) * amplitude)
                    })
                    .collect()
            })
            .collect();
        Self { levels, tables }
    }

    /// Number of encoded features, before padding.
    pub(crate) fn width(&self) -> usize {
        self.levels.len() * FEATURES
    }

    /// Encodes `lanes` points (`pos[axis * lanes + lane]`) into `enc[feature * lanes + lane]` and
    /// `jac[(feature * 3 + axis) * lanes + lane]`.
    #[inline(always)]
    pub(crate) fn encode(&self, pos: &[R], lanes: usize, enc: &mut [R], jac: &mut [R]) {
        for (l, (level, table)) in self.levels.iter().zip(&self.tables).enumerate() {
            for lane in 0..lanes {
                let p = [pos[lane], pos[lanes + lane], pos[2 * lanes + lane]];
                let at = level.interpolate(table, p);
                for f in 0..FEATURES {
                    let row = FEATURES * l + f;
                    enc[row * lanes + lane] = at.value[f];
                    for a in 0..3 {
                        jac[(row * 3 + a) * lanes + lane] = at.slope[f][a];
                    }
                }
            }
        }
    }
}

/// Finaliser of SplitMix64 (Steele et al. 2014): a 64-bit hash.
#[inline(always)]
pub(crate) fn mix(x: u64) -> u64 {
    let x = x.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    x ^ (x >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn online_lattices_are_dense_with_one_vertex_more_than_cells() {
        let grid = Grid::<f32>::new(4, (16, 128), 22, 1e-4, 0);
        let vertices: Vec<u32> = grid.levels.iter().map(|l| l.vertices).collect();
        assert_eq!(vertices, [17, 33, 65, 129]);
        assert!(grid.levels.iter().all(|l| l.hash_mask.is_none()));
    }

    #[test]
    fn lattices_beyond_the_table_are_hashed_evenly() {
        let grid = Grid::<f32>::new(16, (16, 256), 17, 1e-4, 0);
        let table = 1usize << 17;
        let hashed: Vec<&Level> = grid.levels.iter().filter(|l| l.hash_mask.is_some()).collect();
        assert!(grid.levels.len() == 16 && hashed.len() >= 5 && hashed.len() < 16);
        for level in hashed {
            assert!(level.len == table && (level.vertices as usize).pow(3) > table);
            // Vertices of one layer of cells: as many as there are of them, up to the collisions of a random hash.
            let mut used = std::collections::HashSet::new();
            let n = level.vertices as usize - 1;
            for i in 0..n * n {
                let p = [i % n, i / n, n / 2].map(|c| (c as f64 + 0.01 - 0.5) / level.scale);
                used.insert(level.corners(p).rows[0][0]);
            }
            let expected = table as f64 * (1.0 - (-((n * n) as f64) / table as f64).exp());
            assert!(used.len() as f64 > 0.9 * expected, "{} of {expected}", used.len());
        }
    }

    #[test]
    fn slopes_and_mixed_derivatives_match_differences() {
        for log2_table in [20, 8] {
            let grid = Grid::<f64>::new(2, (5, 9), log2_table, 1.0, 3);
            for (level, table) in grid.levels.iter().zip(&grid.tables) {
                let p = [0.313, 0.571, 0.847];
                let h = 1e-6;
                let at = level.interpolate(table, p);
                let mixed = level.mixed(table, p);
                for a in 0..3 {
                    let (mut lo, mut hi) = (p, p);
                    lo[a] -= h;
                    hi[a] += h;
                    let (l, u) = (level.interpolate(table, lo), level.interpolate(table, hi));
                    for f in 0..FEATURES {
                        let slope = (u.value[f] - l.value[f]) / (2.0 * h);
                        assert!((slope - at.slope[f][a]).abs() < 1e-6);
                        for (b, pair) in [(0, 1), (0, 2), (1, 2)].iter().enumerate() {
                            if pair.0 == a {
                                let second = (u.slope[f][pair.1] - l.slope[f][pair.1]) / (2.0 * h);
                                assert!((second - mixed[f][b]).abs() < 1e-6);
                            }
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn corners_of_the_cube_stay_in_the_table() {
        let grid = Grid::<f32>::new(3, (16, 64), 22, 1e-4, 0);
        for level in &grid.levels {
            for p in [[0.0; 3], [1.0; 3], [f32::NAN; 3], [-5.0, 7.0, 1e30]] {
                let c = level.corners(p);
                assert!(c.rows.iter().flatten().all(|&i| i < level.len));
            }
        }
    }
}
