//! A closed surface: what was never seen is bridged by the smoothest continuation of the distances around it.

use crate::field::TrainedField;
use marching_cubes::{TriMesh, extract_dense};

/// Most lattice points of an extraction; the spacing grows when more would be needed.
const MAX_POINTS: f32 = 2e7;
/// Cells around the observed space: the border is outside.
const MARGIN: f32 = 4.0;
/// Relaxation sweeps on each level but the coarsest.
const SWEEPS: usize = 12;
/// Sweeps on the coarsest level, which has this many points an axis at most.
const COARSE_SWEEPS: usize = 400;
const COARSE_POINTS: usize = 20;

impl TrainedField {
    /// The zero level set as [`extract_mesh`](Self::extract_mesh), but closed: watertight, its holes bridged where
    /// the object was never seen. Where it was seen the surface is the same.
    ///
    /// Distances of the observed space are continued by solving Laplace's equation, with "outside" all around (the
    /// idea of Davis et al., Filling holes in complex surfaces using volumetric diffusion, 3DPVT 2002). The mesh is
    /// empty when nothing was observed or `spacing` is not positive and finite.
    pub fn extract_closed_mesh(&self, spacing: f32) -> TriMesh {
        if !(spacing > 0.0 && spacing.is_finite()) {
            return TriMesh::default();
        }
        let (lo, hi) = self.support().bounds();
        let extent: [f32; 3] = std::array::from_fn(|a| hi[a] - lo[a]);
        let points = |h: f32| extent.map(|e| (e / h).ceil() + 2.0 * MARGIN + 1.0);
        let mut h = spacing;
        while points(h).iter().product::<f32>() > MAX_POINTS {
            h *= 1.1;
        }
        let dims = points(h).map(|n| n as usize);
        let origin = lo.map(|v| v - MARGIN * h);
        let mut lattice = self.observed(dims, origin, h);
        lattice.fill();
        let mut mesh = extract_dense(dims, &lattice.values, origin, h, 0.0).largest_component();
        self.paint(&mut mesh);
        mesh
    }

    /// Distances in truncation units, at most 1, where they were observed, and 1 on the border.
    fn observed(&self, dims: [usize; 3], origin: [f32; 3], h: f32) -> Lattice {
        let mut lattice = Lattice::new(dims);
        let [nx, ny, _] = dims;
        let mut places = Vec::new();
        let mut points = Vec::new();
        for i in 0..lattice.values.len() {
            let at = [i % nx, i / nx % ny, i / (nx * ny)];
            let p = std::array::from_fn(|a| origin[a] + h * at[a] as f32);
            if !lattice.known[i] && self.support().contains(p) {
                places.push(i);
                points.push(p);
            }
        }
        let mut sdf = vec![0.0; points.len()];
        self.sdf(&points, &mut sdf);
        let inverse = 1.0 / self.truncation() as f32;
        for (i, s) in places.into_iter().zip(sdf) {
            if s.is_finite() {
                lattice.values[i] = (s * inverse).clamp(-1.0, 1.0);
                lattice.known[i] = true;
            }
        }
        lattice
    }
}

/// A function on a box of points that is known on some of them, the border among these.
struct Lattice {
    dims: [usize; 3],
    values: Vec<f32>,
    known: Vec<bool>,
}

impl Lattice {
    /// One on the border, unknown within.
    fn new(dims: [usize; 3]) -> Self {
        let n = dims.iter().product();
        let mut lattice = Self { dims, values: vec![1.0; n], known: vec![true; n] };
        lattice.inner(|lattice, i| lattice.known[i] = false);
        lattice
    }

    /// Visits all points but those of the border.
    #[inline(always)]
    fn inner(&mut self, mut visit: impl FnMut(&mut Self, usize)) {
        let [nx, ny, nz] = self.dims;
        for z in 1..nz.saturating_sub(1) {
            for y in 1..ny.saturating_sub(1) {
                for x in 1..nx.saturating_sub(1) {
                    visit(self, x + nx * (y + ny * z));
                }
            }
        }
    }

    /// Continues what is known to all points, from coarse to fine.
    fn fill(&mut self) {
        let most = self.dims.iter().max().copied().unwrap_or(0);
        if most <= COARSE_POINTS {
            self.relax(COARSE_SWEEPS);
            return;
        }
        let mut coarse = self.halved();
        coarse.fill();
        let [nx, ny, _] = self.dims;
        let [cx, cy, _] = coarse.dims;
        self.inner(|fine, i| {
            if !fine.known[i] {
                let at = [i % nx, i / nx % ny, i / (nx * ny)];
                fine.values[i] = coarse.values[at[0] / 2 + cx * (at[1] / 2 + cy * (at[2] / 2))];
            }
        });
        self.relax(SWEEPS);
    }

    /// Means of what is known in blocks of eight points.
    fn halved(&self) -> Self {
        let mut coarse = Self::new(self.dims.map(|n| n.div_ceil(2)));
        let [nx, ny, nz] = self.dims;
        let [cx, cy, _] = coarse.dims;
        coarse.inner(|coarse, i| {
            let at = [i % cx, i / cx % cy, i / (cx * cy)].map(|c| 2 * c);
            let (mut sum, mut count) = (0.0, 0.0);
            for k in 0..8usize {
                let [x, y, z] = [at[0] + (k & 1), at[1] + (k >> 1 & 1), at[2] + (k >> 2)];
                let j = x + nx * (y + ny * z);
                if x < nx && y < ny && z < nz && self.known[j] {
                    sum += self.values[j];
                    count += 1.0;
                }
            }
            if count > 0.0 {
                coarse.values[i] = sum / count;
                coarse.known[i] = true;
            }
        });
        coarse
    }

    /// Gauss-Seidel sweeps of Laplace's equation on the unknown points.
    fn relax(&mut self, sweeps: usize) {
        let [nx, ny, _] = self.dims;
        let plane = nx * ny;
        for _ in 0..sweeps {
            self.inner(|l, i| {
                if !l.known[i] {
                    let v = &l.values;
                    let sum = v[i - 1] + v[i + 1] + v[i - nx] + v[i + nx] + v[i - plane] + v[i + plane];
                    l.values[i] = sum / 6.0;
                }
            });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_continuation_of_a_linear_function_is_linear() {
        // Known on two planes, and the border elsewhere made to agree: the solution between is the linear one.
        let n = 41;
        let mut l = Lattice::new([n; 3]);
        for i in 0..l.values.len() {
            let x = (i % n) as f32 / (n - 1) as f32;
            if l.known[i] {
                l.values[i] = x;
            }
        }
        // Coarse levels have a border of one; start from there and relax to the end.
        l.fill();
        l.relax(2000);
        for i in 0..l.values.len() {
            assert!((l.values[i] - (i % n) as f32 / (n - 1) as f32).abs() < 0.01);
        }
    }

    #[test]
    fn an_open_shell_is_bridged() {
        // Distances within two cells of a sphere whose top quarter is unknown.
        let n = 48;
        let mut l = Lattice::new([n; 3]);
        let centre = 23.5f32;
        for i in 0..l.values.len() {
            let p = [i % n, i / n % n, i / (n * n)].map(|c| c as f32 - centre);
            let s = (p[0] * p[0] + p[1] * p[1] + p[2] * p[2]).sqrt() - 15.0;
            if s.abs() < 2.5 && p[2] < 8.0 {
                l.values[i] = s / 2.5;
                l.known[i] = true;
            }
        }
        l.fill();
        let mesh = extract_dense([n; 3], &l.values, [0.0; 3], 1.0, 0.0).largest_component();
        assert!(mesh.is_watertight());
        assert_eq!(mesh.euler_characteristic(), 2);
        let top = mesh.vertices.iter().map(|v| v[2] - centre).fold(0.0, f32::max);
        assert!((6.0..15.5).contains(&top), "{top}");
    }
}
