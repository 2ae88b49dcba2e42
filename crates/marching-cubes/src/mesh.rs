//! The triangle mesh and what can be measured on it.

/// Triangle mesh with optional attributes per vertex.
///
/// `normals` and `colors` are either empty or as long as `vertices`; with any other length they are ignored.
/// Triangles that name a vertex which does not exist are ignored by every measure.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TriMesh {
    /// Positions.
    pub vertices: Vec<[f32; 3]>,
    /// Vertex numbers, counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
    /// Unit normals, or empty.
    pub normals: Vec<[f32; 3]>,
    /// Red, green, blue, or empty.
    pub colors: Vec<[u8; 3]>,
}

impl TriMesh {
    /// Whether there are normals for every vertex.
    #[must_use]
    pub fn has_normals(&self) -> bool {
        !self.normals.is_empty() && self.normals.len() == self.vertices.len()
    }

    /// Whether there are colours for every vertex.
    #[must_use]
    pub fn has_colors(&self) -> bool {
        !self.colors.is_empty() && self.colors.len() == self.vertices.len()
    }

    /// Corner positions of a triangle; `None` when it names a missing vertex.
    pub(crate) fn corners(&self, triangle: &[u32; 3]) -> Option<[[f64; 3]; 3]> {
        let at = |i: u32| Some(self.vertices.get(i as usize)?.map(f64::from));
        Some([at(triangle[0])?, at(triangle[1])?, at(triangle[2])?])
    }

    /// Minimum and maximum corner of the box around all vertices; `None` without vertices.
    #[must_use]
    pub fn bounds(&self) -> Option<([f32; 3], [f32; 3])> {
        let first = *self.vertices.first()?;
        Some(self.vertices.iter().fold((first, first), |(lo, hi), p| {
            (std::array::from_fn(|a| lo[a].min(p[a])), std::array::from_fn(|a| hi[a].max(p[a])))
        }))
    }

    /// Surface area.
    #[must_use]
    pub fn area(&self) -> f64 {
        self.triangles
            .iter()
            .filter_map(|t| self.corners(t))
            .map(|c| 0.5 * norm(double_area_normal(&c)))
            .sum()
    }

    /// Enclosed volume, positive when triangles face outwards. It means a volume only for a closed mesh.
    #[must_use]
    pub fn signed_volume(&self) -> f64 {
        // Tetrahedra from a point near the mesh lose less to rounding than from a far origin.
        let Some(base) = self.vertices.first().map(|v| v.map(f64::from)) else { return 0.0 };
        let tetrahedra = self.triangles.iter().filter_map(|t| self.corners(t)).map(|[a, b, c]| {
            let (a, b, c) = (sub(a, base), sub(b, base), sub(c, base));
            dot(a, cross(b, c)) / 6.0
        });
        tetrahedra.sum()
    }

    /// Whether the mesh is a closed, oriented surface: every edge has exactly two triangles, which run along it in
    /// opposite directions. False for an empty mesh, and when a triangle repeats or misses a vertex.
    #[must_use]
    pub fn is_watertight(&self) -> bool {
        let count = self.vertices.len();
        let proper = |t: &[u32; 3]| {
            t[0] != t[1] && t[1] != t[2] && t[2] != t[0] && t.iter().all(|&i| (i as usize) < count)
        };
        if self.triangles.is_empty() || !self.triangles.iter().all(proper) {
            return false;
        }
        let mut edges: Vec<u64> = self
            .triangles
            .iter()
            .flat_map(|t| [(t[0], t[1]), (t[1], t[2]), (t[2], t[0])])
            // Smaller vertex, larger vertex, and the direction in the lowest bit.
            .map(|(a, b)| u64::from(a.min(b)) << 33 | u64::from(a.max(b)) << 1 | u64::from(a > b))
            .collect();
        edges.sort_unstable();
        let (pairs, rest) = edges.as_chunks::<2>();
        // An edge used once, thrice, or twice in one direction cannot fill pairs of this form.
        rest.is_empty() && pairs.iter().all(|[a, b]| a & 1 == 0 && *b == a + 1)
    }

    /// Sets vertex normals to the area-weighted mean of the adjacent triangles' normals. A vertex without a triangle
    /// of positive area gets a zero normal.
    pub fn compute_normals(&mut self) {
        let mut sums = vec![[0.0f64; 3]; self.vertices.len()];
        for t in &self.triangles {
            let Some(corners) = self.corners(t) else { continue };
            let n = double_area_normal(&corners);
            for &i in t {
                for a in 0..3 {
                    sums[i as usize][a] += n[a];
                }
            }
        }
        self.normals = sums
            .into_iter()
            .map(|n| {
                let length = norm(n);
                if length > 0.0 && length.is_finite() { n.map(|v| (v / length) as f32) } else { [0.0; 3] }
            })
            .collect();
    }

    /// The mesh with `map` applied to every position. Normals, when present, are computed anew.
    #[must_use]
    pub fn transformed(&self, map: impl FnMut([f32; 3]) -> [f32; 3]) -> TriMesh {
        let mut mesh = self.clone();
        mesh.vertices = self.vertices.iter().copied().map(map).collect();
        if self.has_normals() {
            mesh.compute_normals();
        }
        mesh
    }

    /// The mesh under an affine map given as a row-major 4x4 matrix (the last row is taken as 0 0 0 1), for example
    /// a pose `a_from_b` that takes a mesh in frame b to frame a. Normals turn with it; a reflection reverses the
    /// triangles so that they still face outwards.
    #[must_use]
    pub fn transformed_by(&self, matrix: &[[f64; 4]; 4]) -> TriMesh {
        let row = |r: usize| [matrix[r][0], matrix[r][1], matrix[r][2]];
        // Normals map with the inverse transpose, up to scale the cofactors; their sign follows the determinant.
        let cofactors = [cross(row(1), row(2)), cross(row(2), row(0)), cross(row(0), row(1))];
        let sign = if dot(row(0), cofactors[0]) < 0.0 { -1.0 } else { 1.0 };
        let mut mesh = self.clone();
        for p in &mut mesh.vertices {
            let q = p.map(f64::from);
            *p = std::array::from_fn(|r| (dot(row(r), q) + matrix[r][3]) as f32);
        }
        for n in &mut mesh.normals {
            let m = cofactors.map(|c| sign * dot(c, n.map(f64::from)));
            let length = norm(m);
            *n = if length > 0.0 { m.map(|v| (v / length) as f32) } else { [0.0; 3] };
        }
        if sign < 0.0 {
            mesh.triangles.iter_mut().for_each(|t| t.swap(1, 2));
        }
        mesh
    }

    /// Appends another mesh. Normals and colours survive if both meshes have them, or one mesh has no vertices.
    pub fn merge(&mut self, other: &TriMesh) {
        if other.vertices.is_empty() {
            return;
        }
        if self.vertices.is_empty() {
            *self = other.clone();
            return;
        }
        let offset = self.vertices.len() as u32;
        if self.has_normals() && other.has_normals() {
            self.normals.extend_from_slice(&other.normals);
        } else {
            self.normals.clear();
        }
        if self.has_colors() && other.has_colors() {
            self.colors.extend_from_slice(&other.colors);
        } else {
            self.colors.clear();
        }
        self.vertices.extend_from_slice(&other.vertices);
        self.triangles.extend(other.triangles.iter().map(|t| t.map(|i| i.saturating_add(offset))));
    }

    /// Number of vertices that repeat the position of another one: 0 means that the mesh is welded, as
    /// extraction leaves it.
    #[must_use]
    pub fn duplicate_vertices(&self) -> usize {
        let mut keys: Vec<[u32; 3]> = self.vertices.iter().map(|p| p.map(|v| (v + 0.0).to_bits())).collect();
        keys.sort_unstable();
        keys.windows(2).filter(|w| w[0] == w[1]).count()
    }

    /// Euler characteristic V - E + F over the vertices in use; 2 - 2g for a closed surface of genus g.
    #[must_use]
    pub fn euler_characteristic(&self) -> i64 {
        let mut edges: Vec<(u32, u32)> = self
            .triangles
            .iter()
            .flat_map(|t| [(t[0], t[1]), (t[1], t[2]), (t[2], t[0])])
            .map(|(a, b)| (a.min(b), a.max(b)))
            .collect();
        edges.sort_unstable();
        edges.dedup();
        let mut used: Vec<u32> = self.triangles.as_flattened().to_vec();
        used.sort_unstable();
        used.dedup();
        used.len() as i64 - edges.len() as i64 + self.triangles.len() as i64
    }
}

/// Whether lattice positions will be numbers.
pub(crate) fn usable_lattice(origin: [f32; 3], spacing: f32) -> bool {
    spacing > 0.0 && spacing.is_finite() && origin.iter().all(|v| v.is_finite())
}

pub(crate) fn sub(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|i| a[i] - b[i])
}

pub(crate) fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub(crate) fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

pub(crate) fn norm(a: [f64; 3]) -> f64 {
    dot(a, a).sqrt()
}

/// Normal of a triangle with twice its area as length.
pub(crate) fn double_area_normal([a, b, c]: &[[f64; 3]; 3]) -> [f64; 3] {
    cross(sub(*b, *a), sub(*c, *a))
}
