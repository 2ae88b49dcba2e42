//! Quadric edge collapse (Garland and Heckbert, "Surface Simplification Using Quadric Error Metrics", 1997).

use crate::TriMesh;
use crate::mesh::{cross, dot, double_area_normal, norm, sub};
use crate::quadric::Quadric;
use std::cmp::Ordering;
use std::collections::BinaryHeap;

/// Weight of the planes that hold a border in place, next to those of the surface.
const BORDER: f64 = 10.0;
/// Least cosine between a triangle's normals before and after a collapse.
const TURN: f64 = 0.2;
/// Least ratio of a triangle's area to its longest edge squared that a collapse may leave, unless it was less before.
const FLAT: f64 = 0.01;
/// Pull towards the middle of the edge, per area: it places vertices on flat surface, where every place costs nothing.
const PULL: f64 = 1e-6;

impl TriMesh {
    /// The mesh with edges collapsed, cheapest first, until at most `faces` triangles are left or no collapse is
    /// possible without changing the topology: a closed manifold stays one, of the same genus, and borders stay
    /// borders. Colours are carried along, normals (when present) computed anew.
    ///
    /// Triangles that repeat or miss a vertex are dropped. The result is the same on every run.
    #[must_use]
    pub fn simplified(&self, faces: usize) -> TriMesh {
        let count = self.vertices.len();
        let proper = |t: &&[u32; 3]| {
            t[0] != t[1] && t[1] != t[2] && t[2] != t[0] && t.iter().all(|&i| (i as usize) < count)
        };
        let triangles: Vec<_> = self.triangles.iter().filter(proper).copied().collect();
        if triangles.len() <= faces {
            let mut mesh = TriMesh { triangles, ..self.clone() };
            mesh.drop_unused_vertices();
            return mesh;
        }
        let mut surface = Surface::new(self, triangles);
        surface.collapse(faces);
        surface.into_mesh(self)
    }
}

/// An edge that could be collapsed; out of date once a stamp differs.
struct Candidate {
    cost: f64,
    ends: [u32; 2],
    stamps: [u32; 2],
    position: [f64; 3],
}

/// The mesh while edges collapse. `faces_of` lists may name dead faces only between two steps of one collapse.
struct Surface {
    positions: Vec<[f64; 3]>,
    colors: Vec<[f32; 3]>,
    quadrics: Vec<Quadric>,
    border: Vec<bool>,
    stamps: Vec<u32>,
    faces_of: Vec<Vec<u32>>,
    triangles: Vec<[u32; 3]>,
    alive: Vec<bool>,
    left: usize,
    heap: BinaryHeap<Candidate>,
}

impl Surface {
    fn new(mesh: &TriMesh, triangles: Vec<[u32; 3]>) -> Self {
        let count = mesh.vertices.len();
        let mut faces_of = vec![Vec::new(); count];
        for (f, t) in triangles.iter().enumerate() {
            t.iter().for_each(|&v| faces_of[v as usize].push(f as u32));
        }
        let colors = if mesh.has_colors() {
            mesh.colors.iter().map(|c| c.map(f32::from)).collect()
        } else {
            vec![[0.0; 3]; count]
        };
        let mut surface = Self {
            positions: mesh.vertices.iter().map(|p| p.map(f64::from)).collect(),
            colors,
            quadrics: vec![Quadric::default(); count],
            border: vec![false; count],
            stamps: vec![0; count],
            faces_of,
            alive: vec![true; triangles.len()],
            left: triangles.len(),
            triangles,
            heap: BinaryHeap::new(),
        };
        surface.measure();
        surface
    }

    /// Quadrics of all vertices, and which lie on a border.
    fn measure(&mut self) {
        for f in 0..self.triangles.len() {
            let t = self.triangles[f];
            let corners = t.map(|v| self.positions[v as usize]);
            let normal = double_area_normal(&corners);
            let area = norm(normal);
            if area <= 0.0 {
                continue;
            }
            let n = normal.map(|v| v / area);
            for v in t {
                self.quadrics[v as usize].add(&Quadric::plane(n, corners[0], area));
            }
            for k in 0..3 {
                let (a, b) = (t[k], t[(k + 1) % 3]);
                if self.faces_at(a, b).count() != 1 {
                    continue;
                }
                let along = sub(self.positions[b as usize], self.positions[a as usize]);
                let across = cross(along, n);
                let length = norm(across);
                if length > 0.0 {
                    let wall = Quadric::plane(
                        across.map(|v| v / length),
                        self.positions[a as usize],
                        BORDER * length * length,
                    );
                    for v in [a, b] {
                        self.quadrics[v as usize].add(&wall);
                        self.border[v as usize] = true;
                    }
                }
            }
        }
    }

    /// Faces with the edge `a`-`b`.
    fn faces_at(&self, a: u32, b: u32) -> impl Iterator<Item = u32> + '_ {
        self.faces_of[a as usize].iter().copied().filter(move |&f| self.triangles[f as usize].contains(&b))
    }

    /// Vertices around `v`, in order of number.
    fn neighbours(&self, v: u32) -> Vec<u32> {
        let mut ring: Vec<u32> = self.faces_of[v as usize]
            .iter()
            .flat_map(|&f| self.triangles[f as usize])
            .filter(|&w| w != v)
            .collect();
        ring.sort_unstable();
        ring.dedup();
        ring
    }

    fn push(&mut self, a: u32, b: u32) {
        let (i, j) = (a as usize, b as usize);
        let (p, q) = (self.positions[i], self.positions[j]);
        let middle: [f64; 3] = std::array::from_fn(|k| 0.5 * (p[k] + q[k]));
        let mut sum = self.quadrics[i].clone();
        sum.add(&self.quadrics[j]);
        let mut pulled = sum.clone();
        pulled.add(&Quadric::point(middle, PULL * sum.weight()));
        let reach = norm(sub(p, q));
        let best = pulled.minimum().filter(|m| norm(sub(*m, middle)) <= reach);
        let choices = [best, Some(middle), Some(p), Some(q)];
        let choice = choices
            .into_iter()
            .flatten()
            .map(|c| (pulled.at(c).max(0.0), c))
            .min_by(|a, b| a.0.total_cmp(&b.0));
        if let Some((cost, position)) = choice {
            let stamps = [self.stamps[i], self.stamps[j]];
            self.heap.push(Candidate { cost, ends: [a, b], stamps, position });
        }
    }

    fn collapse(&mut self, faces: usize) {
        for v in 0..self.positions.len() as u32 {
            for w in self.neighbours(v).into_iter().filter(|&w| w > v) {
                self.push(v, w);
            }
        }
        while self.left > faces {
            let Some(candidate) = self.heap.pop() else { break };
            let [a, b] = candidate.ends;
            let fresh = candidate.stamps == [self.stamps[a as usize], self.stamps[b as usize]];
            if fresh && self.keeps_topology(a, b) && self.keeps_shape(a, b, candidate.position) {
                self.merge(a, b, candidate.position);
            }
        }
    }

    /// The link condition (Dey et al. 1999): the rings of both ends meet only in the corners across the edge.
    fn keeps_topology(&self, a: u32, b: u32) -> bool {
        let shared: Vec<u32> = self.faces_at(a, b).collect();
        let is_border_edge = shared.len() == 1;
        if shared.is_empty() || shared.len() > 2 {
            return false;
        }
        if !is_border_edge && self.border[a as usize] && self.border[b as usize] {
            return false;
        }
        let (ring_a, ring_b) = (self.neighbours(a), self.neighbours(b));
        let common = ring_a.iter().filter(|v| ring_b.binary_search(v).is_ok()).count();
        if common != shared.len() {
            return false;
        }
        // A lone triangle, and two triangles that would fall onto each other.
        let far_sides = |v: u32| -> Vec<[u32; 2]> {
            let others = self.faces_of[v as usize].iter().filter(|f| !shared.contains(f));
            let mut sides: Vec<_> = others.map(|&f| side_across(self.triangles[f as usize], v)).collect();
            sides.sort_unstable();
            sides
        };
        let (sides_a, sides_b) = (far_sides(a), far_sides(b));
        !(sides_a.is_empty() && sides_b.is_empty())
            && sides_a.iter().all(|side| sides_b.binary_search(side).is_err())
    }

    /// No triangle around the edge may turn over or become a sliver.
    fn keeps_shape(&self, a: u32, b: u32, position: [f64; 3]) -> bool {
        [(a, b), (b, a)].into_iter().all(|(v, other)| {
            self.faces_of[v as usize].iter().all(|&f| {
                let t = self.triangles[f as usize];
                if t.contains(&other) {
                    return true;
                }
                let before = t.map(|w| self.positions[w as usize]);
                let after = t.map(|w| if w == v { position } else { self.positions[w as usize] });
                let (n, m) = (double_area_normal(&before), double_area_normal(&after));
                let shape = |c: &[[f64; 3]; 3], n: [f64; 3]| {
                    let longest = (0..3).map(|k| {
                        let e = sub(c[k], c[(k + 1) % 3]);
                        dot(e, e)
                    });
                    norm(n) / longest.fold(f64::MIN_POSITIVE, f64::max)
                };
                let sliver = shape(&after, m) < FLAT.min(0.5 * shape(&before, n));
                !sliver && (norm(n) <= 0.0 || dot(n, m) > TURN * norm(n) * norm(m))
            })
        })
    }

    /// Moves `b` into `a`.
    fn merge(&mut self, a: u32, b: u32, position: [f64; 3]) {
        let (i, j) = (a as usize, b as usize);
        let along = sub(self.positions[j], self.positions[i]);
        let length = dot(along, along);
        let t = if length > 0.0 { dot(sub(position, self.positions[i]), along) / length } else { 0.5 };
        let t = t.clamp(0.0, 1.0) as f32;
        self.colors[i] =
            std::array::from_fn(|k| self.colors[i][k] + t * (self.colors[j][k] - self.colors[i][k]));
        self.positions[i] = position;
        let other = std::mem::take(&mut self.quadrics[j]);
        self.quadrics[i].add(&other);
        self.border[i] |= self.border[j];
        self.stamps[i] += 1;
        self.stamps[j] += 1;
        for f in std::mem::take(&mut self.faces_of[j]) {
            let t = self.triangles[f as usize];
            if t.contains(&a) {
                self.alive[f as usize] = false;
                self.left -= 1;
                for v in t {
                    self.faces_of[v as usize].retain(|&g| g != f);
                }
            } else {
                self.triangles[f as usize] = t.map(|v| if v == b { a } else { v });
                self.faces_of[i].push(f);
            }
        }
        for w in self.neighbours(a) {
            self.push(a.min(w), a.max(w));
        }
    }

    fn into_mesh(self, source: &TriMesh) -> TriMesh {
        let alive = self.triangles.iter().zip(&self.alive).filter(|(_, alive)| **alive);
        let mut mesh = TriMesh {
            triangles: alive.map(|(t, _)| *t).collect(),
            vertices: self.positions.iter().map(|p| p.map(|v| v as f32)).collect(),
            ..TriMesh::default()
        };
        if source.has_colors() {
            mesh.colors = self.colors.iter().map(|c| c.map(|v| v.round().clamp(0.0, 255.0) as u8)).collect();
        }
        mesh.drop_unused_vertices();
        if source.has_normals() {
            mesh.compute_normals();
        }
        mesh
    }
}

/// The side of a triangle that doesn't touch `v`, smaller vertex first.
fn side_across(triangle: [u32; 3], v: u32) -> [u32; 2] {
    let [a, b] = match triangle {
        [a, b, c] if a == v => [b, c],
        [a, b, c] if b == v => [a, c],
        [a, b, _] => [a, b],
    };
    [a.min(b), a.max(b)]
}

impl PartialEq for Candidate {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl Eq for Candidate {}

impl PartialOrd for Candidate {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Candidate {
    /// The cheapest is the greatest, for the heap; equal ones by number.
    fn cmp(&self, other: &Self) -> Ordering {
        other.cost.total_cmp(&self.cost).then_with(|| other.ends.cmp(&self.ends))
    }
}
