//! Connected components, and keeping some of the triangles.

use crate::TriMesh;

impl TriMesh {
    /// Connected components as meshes of their own, most triangles first (then by first triangle). Triangles are
    /// connected when they share a vertex number. Attributes are kept, unused vertices are dropped.
    #[must_use]
    pub fn components(&self) -> Vec<TriMesh> {
        let (label, sizes) = self.label_triangles();
        let mut members: Vec<Vec<usize>> = sizes.iter().map(|&n| Vec::with_capacity(n)).collect();
        for (t, &l) in label.iter().enumerate() {
            if let Some(list) = members.get_mut(l) {
                list.push(t);
            }
        }
        members.sort_by_key(|list| (std::cmp::Reverse(list.len()), list.first().copied()));
        let mut renumbered = vec![u32::MAX; self.vertices.len()];
        members.iter().map(|list| self.subset(list.iter().copied(), &mut renumbered)).collect()
    }

    /// The component with the most triangles (the first such), attributes kept; an empty mesh if there is none.
    #[must_use]
    pub fn largest_component(&self) -> TriMesh {
        let (label, sizes) = self.label_triangles();
        let Some(best) = (0..sizes.len()).max_by_key(|&l| (sizes[l], std::cmp::Reverse(l))) else {
            return TriMesh::default();
        };
        self.keep(|t| label[t] == best)
    }

    /// Removes components with fewer than `min_triangles` triangles, and unused vertices. Returns how many
    /// components went.
    pub fn remove_small_components(&mut self, min_triangles: usize) -> usize {
        let (label, sizes) = self.label_triangles();
        *self = self.keep(|t| sizes.get(label[t]).is_some_and(|&n| n >= min_triangles));
        sizes.iter().filter(|&&n| n < min_triangles).count()
    }

    /// Removes vertices that no triangle uses; the others keep their order. Triangles that name a missing vertex go.
    pub fn drop_unused_vertices(&mut self) {
        let mut used = vec![false; self.vertices.len()];
        let count = used.len();
        self.triangles.retain(|t| t.iter().all(|&i| (i as usize) < count));
        for &i in self.triangles.as_flattened() {
            used[i as usize] = true;
        }
        let mut renumbered = vec![0u32; count];
        let mut next = 0;
        for (new, &used) in renumbered.iter_mut().zip(&used) {
            *new = next;
            next += u32::from(used);
        }
        for t in &mut self.triangles {
            *t = t.map(|i| renumbered[i as usize]);
        }
        let (normals, colors) = (self.has_normals(), self.has_colors());
        filter_by(&mut self.vertices, &used, true);
        filter_by(&mut self.normals, &used, normals);
        filter_by(&mut self.colors, &used, colors);
    }

    /// Component of every triangle, numbered by first triangle, and the number of triangles in each. A triangle
    /// that names a missing vertex has the component `usize::MAX`.
    fn label_triangles(&self) -> (Vec<usize>, Vec<usize>) {
        let count = self.vertices.len();
        let mut parent: Vec<u32> = (0..count as u32).collect();
        let valid = |t: &[u32; 3]| t.iter().all(|&i| (i as usize) < count);
        for t in self.triangles.iter().filter(|t| valid(t)) {
            let a = root(&mut parent, t[0]);
            let b = root(&mut parent, t[1]);
            let c = root(&mut parent, t[2]);
            let least = a.min(b).min(c);
            for r in [a, b, c] {
                parent[r as usize] = least;
            }
        }
        let mut number = vec![usize::MAX; count];
        let mut sizes = Vec::new();
        let label = self.triangles.iter().map(|t| {
            if !valid(t) {
                return usize::MAX;
            }
            let slot = &mut number[root(&mut parent, t[0]) as usize];
            if *slot == usize::MAX {
                *slot = sizes.len();
                sizes.push(0);
            }
            sizes[*slot] += 1;
            *slot
        });
        (label.collect(), sizes)
    }

    fn keep(&self, wanted: impl Fn(usize) -> bool) -> TriMesh {
        let mut renumbered = vec![u32::MAX; self.vertices.len()];
        self.subset((0..self.triangles.len()).filter(|&t| wanted(t)), &mut renumbered)
    }

    /// Mesh of some triangles. `renumbered` holds `u32::MAX` for each vertex, and does so again afterwards.
    fn subset(&self, triangles: impl Iterator<Item = usize>, renumbered: &mut [u32]) -> TriMesh {
        let mut mesh = TriMesh::default();
        let mut sources = Vec::new();
        for t in triangles {
            mesh.triangles.push(self.triangles[t].map(|old| {
                let new = &mut renumbered[old as usize];
                if *new == u32::MAX {
                    *new = sources.len() as u32;
                    sources.push(old as usize);
                }
                *new
            }));
        }
        mesh.vertices = sources.iter().map(|&i| self.vertices[i]).collect();
        if self.has_normals() {
            mesh.normals = sources.iter().map(|&i| self.normals[i]).collect();
        }
        if self.has_colors() {
            mesh.colors = sources.iter().map(|&i| self.colors[i]).collect();
        }
        sources.iter().for_each(|&i| renumbered[i] = u32::MAX);
        mesh
    }
}

/// Root of a vertex in the union-find forest, halving the path on the way.
fn root(parent: &mut [u32], mut i: u32) -> u32 {
    while parent[i as usize] != i {
        parent[i as usize] = parent[parent[i as usize] as usize];
        i = parent[i as usize];
    }
    i
}

fn filter_by<T>(list: &mut Vec<T>, used: &[bool], keep: bool) {
    if !keep {
        list.clear();
    }
    let mut used = used.iter();
    list.retain(|_| used.next().copied().unwrap_or(false));
}
