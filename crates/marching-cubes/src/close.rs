//! Welding, and closing holes.

use crate::TriMesh;
use crate::mesh::{norm, sub};
use std::collections::HashMap;

/// Most rings of triangles between a hole's rim and its middle.
const RINGS: usize = 48;
/// Sweeps of smoothing over the new vertices.
const SWEEPS: usize = 120;

impl TriMesh {
    /// Gives vertices of equal position one number and drops triangles that repeat a vertex. The attributes of the
    /// first vertex at a position stay. Returns how many vertices went.
    pub fn weld(&mut self) -> usize {
        let before = self.vertices.len();
        let mut first: HashMap<[u32; 3], u32> = HashMap::with_capacity(before);
        // Adding zero turns -0.0 into 0.0.
        let target: Vec<u32> = (0u32..)
            .zip(&self.vertices)
            .map(|(i, p)| *first.entry(p.map(|v| (v + 0.0).to_bits())).or_insert(i))
            .collect();
        self.triangles.retain_mut(|t| {
            if t.iter().any(|&i| i as usize >= before) {
                return false;
            }
            *t = t.map(|i| target[i as usize]);
            t[0] != t[1] && t[1] != t[2] && t[2] != t[0]
        });
        self.drop_unused_vertices();
        before - self.vertices.len()
    }

    /// The mesh with every hole closed by a smooth membrane: watertight, if the mesh is an oriented surface with
    /// borders. Vertices where several sheets touch are split, and triangles that would be the third at an edge are
    /// dropped. Colours run from the rim into the membrane; normals (when present) are computed anew.
    #[must_use]
    pub fn closed(&self) -> TriMesh {
        let mut mesh = self.clone();
        mesh.drop_surplus_triangles();
        mesh.split_touching_sheets();
        let colored = mesh.has_colors();
        for rim in mesh.rims() {
            mesh.span(&rim, colored);
        }
        if self.has_normals() {
            mesh.compute_normals();
        }
        mesh
    }

    /// The borders of the surface as loops of vertices, in the direction of their triangles.
    #[must_use]
    pub fn rims(&self) -> Vec<Vec<u32>> {
        let edges = self.half_edges();
        let mut next: HashMap<u32, u32> = HashMap::new();
        let mut starts = Vec::new();
        for t in &self.triangles {
            for k in 0..3 {
                let (a, b) = (t[k], t[(k + 1) % 3]);
                if !edges.contains_key(&(b, a)) {
                    next.insert(a, b);
                    starts.push(a);
                }
            }
        }
        let mut rims = Vec::new();
        for start in starts {
            let mut rim = Vec::new();
            let mut at = start;
            while let Some(to) = next.remove(&at) {
                rim.push(at);
                at = to;
            }
            // A chain that doesn't end where it began is no border of a surface.
            if rim.len() > 2 && at == start {
                rims.push(rim);
            }
        }
        rims
    }

    fn half_edges(&self) -> HashMap<(u32, u32), usize> {
        let mut edges = HashMap::with_capacity(3 * self.triangles.len());
        for (f, t) in self.triangles.iter().enumerate() {
            for k in 0..3 {
                edges.insert((t[k], t[(k + 1) % 3]), f);
            }
        }
        edges
    }

    /// Keeps the first triangle on each side of every edge.
    fn drop_surplus_triangles(&mut self) {
        let count = self.vertices.len();
        let mut taken: HashMap<(u32, u32), ()> = HashMap::with_capacity(3 * self.triangles.len());
        self.triangles.retain(|t| {
            let sides = [(t[0], t[1]), (t[1], t[2]), (t[2], t[0])];
            let proper = t.iter().all(|&i| (i as usize) < count) && sides.iter().all(|(a, b)| a != b);
            let free = proper && sides.iter().all(|side| !taken.contains_key(side));
            if free {
                taken.extend(sides.map(|side| (side, ())));
            }
            free
        });
    }

    /// Gives every fan of triangles around a vertex a vertex of its own.
    fn split_touching_sheets(&mut self) {
        let (normals, colors) = (self.has_normals(), self.has_colors());
        let mut faces_of = vec![Vec::new(); self.vertices.len()];
        for (f, t) in self.triangles.iter().enumerate() {
            t.iter().for_each(|&v| faces_of[v as usize].push(f));
        }
        for (v, faces) in faces_of.iter().enumerate() {
            let v = v as u32;
            for fan in fans(&self.triangles, v, faces).into_iter().skip(1) {
                let copy = self.vertices.len() as u32;
                self.vertices.push(self.vertices[v as usize]);
                if normals {
                    self.normals.push(self.normals[v as usize]);
                }
                if colors {
                    self.colors.push(self.colors[v as usize]);
                }
                for f in fan {
                    self.triangles[f] = self.triangles[f].map(|i| if i == v { copy } else { i });
                }
            }
        }
    }

    /// Closes one hole.
    fn span(&mut self, rim: &[u32], colored: bool) {
        if let &[a, b, c] = rim {
            self.triangles.push([c, b, a]);
            return;
        }
        let n = rim.len();
        let points: Vec<[f64; 3]> = rim.iter().map(|&i| self.vertices[i as usize].map(f64::from)).collect();
        let middle: [f64; 3] = std::array::from_fn(|k| points.iter().map(|p| p[k]).sum::<f64>() / n as f64);
        let radius = points.iter().map(|p| norm(sub(*p, middle))).sum::<f64>() / n as f64;
        let edge = (0..n).map(|i| norm(sub(points[(i + 1) % n], points[i]))).sum::<f64>() / n as f64;
        let rings = if edge > 0.0 { (radius / edge).round().clamp(1.0, RINGS as f64) as usize } else { 1 };
        let mut patch = Patch { first: self.vertices.len() as u32, ..Patch::default() };
        let mut outer = rim.to_vec();
        for ring in 1..rings {
            let scale = 1.0 - ring as f64 / rings as f64;
            let count = ((n as f64 * scale).round() as usize).max(3);
            let inner: Vec<u32> = (0..count)
                .map(|i| {
                    let at = i as f64 * n as f64 / count as f64;
                    let (a, b) = (at as usize % n, (at as usize + 1) % n);
                    let rest = at.fract();
                    let p = |k: usize| points[a][k] + rest * (points[b][k] - points[a][k]);
                    patch.add(std::array::from_fn(|k| middle[k] + scale * (p(k) - middle[k])))
                })
                .collect();
            stitch(&outer, &inner, &mut patch.triangles);
            outer = inner;
        }
        let tip = patch.add(middle);
        for i in 0..outer.len() {
            patch.triangles.push([outer[(i + 1) % outer.len()], outer[i], tip]);
        }
        patch.relax(&self.vertices);
        self.vertices.extend(patch.points.iter().map(|p| p.map(|v| v as f32)));
        self.triangles.extend_from_slice(&patch.triangles);
        if colored {
            let sum: [f32; 3] = std::array::from_fn(|k| {
                rim.iter().map(|&i| f32::from(self.colors[i as usize][k])).sum::<f32>() / n as f32
            });
            patch.points.fill(sum.map(f64::from));
            let known: Vec<[f32; 3]> = self.colors.iter().map(|c| c.map(f32::from)).collect();
            patch.relax(&known);
            self.colors.extend(patch.points.iter().map(|c| c.map(|v| v.round().clamp(0.0, 255.0) as u8)));
        }
    }
}

/// New vertices and triangles that span a hole.
#[derive(Default)]
struct Patch {
    /// Number of the first new vertex.
    first: u32,
    points: Vec<[f64; 3]>,
    triangles: Vec<[u32; 3]>,
}

impl Patch {
    fn add(&mut self, point: [f64; 3]) -> u32 {
        self.points.push(point);
        self.first + self.points.len() as u32 - 1
    }

    /// Moves every new point towards the mean of its neighbours, over and over: a membrane that hangs from the rim.
    /// `known` are the values at the vertices that existed before.
    fn relax(&mut self, known: &[[f32; 3]]) {
        let mut around: Vec<Vec<u32>> = vec![Vec::new(); self.points.len()];
        for t in &self.triangles {
            for k in 0..3 {
                for other in [t[(k + 1) % 3], t[(k + 2) % 3]] {
                    if let Some(list) = t[k].checked_sub(self.first).and_then(|i| around.get_mut(i as usize))
                        && !list.contains(&other)
                    {
                        list.push(other);
                    }
                }
            }
        }
        for _ in 0..SWEEPS {
            for i in 0..self.points.len() {
                let mut sum = [0.0; 3];
                for &other in &around[i] {
                    let p = match other.checked_sub(self.first) {
                        Some(new) => self.points[new as usize],
                        None => known[other as usize].map(f64::from),
                    };
                    sum = std::array::from_fn(|k| sum[k] + p[k]);
                }
                let n = around[i].len().max(1) as f64;
                self.points[i] = sum.map(|v| v / n);
            }
        }
    }
}

/// Triangles between a loop and one inside it, both in the direction in which the surface runs along its border; the
/// inner loop becomes the border.
fn stitch(outer: &[u32], inner: &[u32], triangles: &mut Vec<[u32; 3]>) {
    let (n, m) = (outer.len(), inner.len());
    let (mut i, mut j) = (0, 0);
    while i < n || j < m {
        if j == m || (i < n && (i + 1) * m <= (j + 1) * n) {
            triangles.push([outer[(i + 1) % n], outer[i % n], inner[j % m]]);
            i += 1;
        } else {
            triangles.push([outer[i % n], inner[j % m], inner[(j + 1) % m]]);
            j += 1;
        }
    }
}

/// The triangles around `v`, grouped by common edges at `v`, first triangle first.
fn fans(triangles: &[[u32; 3]], v: u32, faces: &[usize]) -> Vec<Vec<usize>> {
    let mut left: Vec<usize> = faces.to_vec();
    let mut fans = Vec::new();
    while !left.is_empty() {
        let mut fan = vec![left.remove(0)];
        let mut at = 0;
        while let Some(&f) = fan.get(at) {
            let t = triangles[f];
            let (joined, rest): (Vec<usize>, Vec<usize>) =
                left.iter().partition(|&&g| triangles[g].iter().any(|&w| w != v && t.contains(&w)));
            fan.extend(joined);
            left = rest;
            at += 1;
        }
        fans.push(fan);
    }
    fans
}
