//! Solid textures: colour as a function of the surface point, so that no texture coordinates are needed.

use crate::noise::{floor, fractal_noise, lattice, lattice_unit};

/// How a flat pattern is laid on a surface.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mapping {
    /// Unrolled around the y axis.
    Cylinder {
        /// Radius at which the pattern has its true width, micrometres (an integer keeps the type comparable).
        radius_um: u32,
    },
    /// Projected along the axis closest to the normal.
    Cube,
}

/// One pattern painted over the layers below it.
#[derive(Clone, Debug, PartialEq)]
pub struct Layer {
    /// What is painted.
    pub pattern: Pattern,
    /// RGB in `[0, 1]`.
    pub color: [f32; 3],
    /// Painted only where the point's y coordinate (metres) lies in this interval.
    pub band: Option<[f32; 2]>,
}

/// A pattern of a [`Layer`]: which points it covers. Lengths in metres.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub enum Pattern {
    /// Everything.
    Solid,
    /// Patches where multi-octave noise exceeds `threshold` (in `[0, 1]`).
    Patches {
        /// Size of the largest patches.
        scale: f32,
        /// Share of the noise range left uncovered.
        threshold: f32,
    },
    /// Wavy stripes.
    Stripes {
        /// Across the stripes; need not be of unit length.
        direction: [f32; 3],
        /// From stripe to stripe.
        period: f32,
        /// Covered share of a period.
        duty: f32,
        /// Amplitude of the waves.
        warp: f32,
    },
    /// Blocks of five by seven dots that look like print.
    Glyphs {
        /// Width of a glyph with its gap; the height is 1.4 of it.
        cell: f32,
        /// Share of the cells that hold a glyph.
        density: f32,
        /// How the page lies on the surface.
        mapping: Mapping,
    },
    /// Round spots.
    Speckle {
        /// Mean distance of the spots.
        cell: f32,
        /// Largest radius; must stay below half a cell.
        radius: f32,
    },
}

/// A solid texture: noise between the colours of a palette, with layers painted over it.
#[derive(Clone, Debug, PartialEq)]
pub struct Texture {
    /// Colours the ground blends through, RGB in `[0, 1]`.
    pub palette: Vec<[f32; 3]>,
    /// Size of the largest patches of the ground, metres.
    pub scale: f32,
    /// Octaves of the ground's noise.
    pub octaves: u32,
    /// Painted in this order.
    pub layers: Vec<Layer>,
    /// Chooses among textures of the same kind.
    pub seed: u32,
}

impl Texture {
    /// One colour everywhere.
    pub fn plain(color: [f32; 3]) -> Self {
        Self { palette: vec![color], scale: 1.0, octaves: 1, layers: Vec::new(), seed: 0 }
    }

    /// Colour (RGB in `[0, 1]`) at the surface point `p` (metres, object frame) with unit normal `n`.
    pub fn color(&self, p: [f32; 3], n: [f32; 3]) -> [f32; 3] {
        for layer in self.layers.iter().rev() {
            if layer.band.is_none_or(|[a, b]| p[1] >= a && p[1] <= b) && layer.pattern.covers(p, n, self.seed)
            {
                // A little of the ground's noise keeps painted areas from being flat.
                let shade = 0.88 + 0.24 * fractal_noise(p.map(|v| v / (0.3 * self.scale)), 2, self.seed ^ 77);
                return layer.color.map(|c| c * shade);
            }
        }
        self.ground(p)
    }

    fn ground(&self, p: [f32; 3]) -> [f32; 3] {
        let Some(&last) = self.palette.last() else { return [0.5; 3] };
        if self.palette.len() == 1 {
            return last;
        }
        // Noise crowds around one half: stretched so that the outer colours are seen too.
        let v = fractal_noise(p.map(|v| v / self.scale), self.octaves, self.seed);
        let v = ((v - 0.5) * 1.9 + 0.5).clamp(0.0, 1.0) * (self.palette.len() - 1) as f32;
        let i = (v as usize).min(self.palette.len() - 2);
        let t = (v - i as f32).clamp(0.0, 1.0);
        let (a, b) = (self.palette[i], self.palette[i + 1]);
        core::array::from_fn(|k| a[k] + (b[k] - a[k]) * t)
    }
}

impl Pattern {
    fn covers(&self, p: [f32; 3], n: [f32; 3], seed: u32) -> bool {
        match *self {
            Self::Solid => true,
            Self::Patches { scale, threshold } => {
                fractal_noise(p.map(|v| v / scale), 3, seed ^ 0x51) > threshold
            }
            Self::Stripes { direction: d, period, duty, warp } => {
                let along = (p[0] * d[0] + p[1] * d[1] + p[2] * d[2])
                    / (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt().max(1e-9);
                let wave = warp * (fractal_noise(p.map(|v| v / (2.0 * period)), 2, seed ^ 0x52) - 0.5);
                {
                    let s = (along + wave) / period;
                    s - (floor(s) as f32) < duty
                }
            }
            Self::Glyphs { cell, density, mapping } => glyph(unroll(p, n, mapping), cell, density, seed),
            Self::Speckle { cell, radius } => speckle(p, cell, radius, seed),
        }
    }
}

/// Page coordinates of a surface point and the number of the page it lies on.
fn unroll(p: [f32; 3], n: [f32; 3], mapping: Mapping) -> ([f32; 2], i32) {
    match mapping {
        Mapping::Cylinder { radius_um } => ([p[2].atan2(p[0]) * radius_um as f32 * 1e-6, p[1]], 0),
        Mapping::Cube => {
            let a = n.map(f32::abs);
            let k = if a[0] >= a[1] && a[0] >= a[2] {
                0
            } else {
                usize::from(a[1] >= a[2]) + usize::from(a[1] < a[2]) * 2
            };
            let page = 1 + k as i32 * 2 + i32::from(n[k] < 0.0);
            ([p[(k + 2) % 3], p[(k + 1) % 3]], page)
        }
    }
}

fn glyph(([u, v], page): ([f32; 2], i32), cell: f32, density: f32, seed: u32) -> bool {
    let (u, v) = (u / cell, v / (1.4 * cell));
    let (i, j) = (floor(u), floor(v));
    let (column, row) = (((u - i as f32) * 6.0) as u32, ((v - j as f32) * 8.0) as u32);
    if column >= 5 || row >= 7 || lattice_unit(i, j, page, seed ^ 0x61) > density {
        return false;
    }
    // Left-right symmetric dots read as letters more often than free ones.
    let bits = lattice(i, j, page, seed ^ 0x62);
    bits >> (row * 3 + column.min(4 - column)) & 1 == 1
}

fn speckle(p: [f32; 3], cell: f32, radius: f32, seed: u32) -> bool {
    let q = p.map(|v| v / cell);
    let i = q.map(floor);
    let unit = |salt: u32| lattice_unit(i[0], i[1], i[2], seed ^ salt);
    let r = (radius / cell * (0.35 + 0.65 * unit(0x71))).min(0.49);
    // The whole spot lies in its cell, so that no neighbour needs to be asked.
    let d: f32 = (0..3)
        .map(|k| {
            let center = r + (1.0 - 2.0 * r) * unit(0x72 + k as u32);
            (q[k] - i[k] as f32 - center).powi(2)
        })
        .sum();
    d < r * r
}
