//! Extraction from a full lattice, one slab of cells at a time, on all cores.

use crate::table::{CASES, EDGES};
use crate::{TriMesh, mesh::usable_lattice};
use rayon::prelude::*;
use std::ops::Range;

/// Mesh of the level set `value = iso` of a dense lattice.
///
/// `values[x + dims[0] * (y + dims[1] * z)]` is the field at `origin + spacing * [x, y, z]`; `dims` counts lattice
/// points, not cells. Outside is `value > iso`: normals point towards larger values and triangles are
/// counter-clockwise seen from there. A vertex lies where linear interpolation puts the level on a lattice edge, and
/// is shared by all triangles around it. Cells with a NaN corner give no triangles and leave the mesh open there.
/// Normals and colours are left empty. Vertices keep 1/1024 of the spacing away from lattice points, so that values
/// equal to `iso` do not make triangles without area.
///
/// Runs on the current rayon pool; the mesh does not depend on the number of threads.
///
/// The mesh is empty when an axis has fewer than two points, `values` does not have `dims` entries (at most 2^30),
/// or `origin`, `spacing` (> 0) or `iso` is not usable.
#[must_use]
pub fn extract_dense(dims: [usize; 3], values: &[f32], origin: [f32; 3], spacing: f32, iso: f32) -> TriMesh {
    let count = dims[0].checked_mul(dims[1]).and_then(|n| n.checked_mul(dims[2]));
    let too_many = values.len() > 1 << 30;
    if dims.iter().any(|&n| n < 2) || count != Some(values.len()) || too_many || iso.is_nan() {
        return TriMesh::default();
    }
    if !usable_lattice(origin, spacing) {
        return TriMesh::default();
    }
    let slabs = dims[2] - 1;
    let parts = (0..slabs.div_ceil(SLABS)).into_par_iter().map(|k| {
        Extraction::new(dims, values, origin, spacing, iso).run(k * SLABS..slabs.min((k + 1) * SLABS))
    });
    join(parts.collect())
}

/// Slabs of cells in one task. Fixed, and parts are joined in order: the result is that of a single pass.
const SLABS: usize = 16;

/// The mesh of some slabs.
struct Part {
    mesh: TriMesh,
    /// Number of vertices in the lowest layer; they come first.
    lowest: usize,
    /// Where the vertices of the highest layer start. They are the next part's lowest ones, in the same order.
    highest: usize,
    any_nan: bool,
}

/// Puts parts together; the vertices that two of them share are taken from the lower one.
fn join(mut parts: Vec<Part>) -> TriMesh {
    // Global number of a part's vertex: of one in the lowest layer, and of all others, as offsets.
    let mut offsets: Vec<[i64; 2]> = Vec::with_capacity(parts.len());
    let mut next = 0;
    for (k, part) in parts.iter().enumerate() {
        let shared = k.checked_sub(1).map(|below| parts[below].highest as i64 + offsets[below][1]);
        let dropped = if shared.is_some() { part.lowest } else { 0 };
        let own = next - dropped as i64;
        offsets.push([shared.unwrap_or(own), own]);
        next += (part.mesh.vertices.len() - dropped) as i64;
    }
    parts.par_iter_mut().zip(&offsets).skip(1).for_each(|(part, [lowest, others])| {
        let shared = part.lowest as u32;
        for i in part.mesh.triangles.iter_mut().flatten() {
            *i = (i64::from(*i) + if *i < shared { lowest } else { others }) as u32;
        }
    });
    let any_nan = parts.iter().any(|p| p.any_nan);
    let triangles = parts.iter().map(|p| p.mesh.triangles.len()).sum::<usize>();
    let mut parts = parts.into_iter();
    let Some(Part { mut mesh, .. }) = parts.next() else { return TriMesh::default() };
    mesh.vertices.reserve_exact(next as usize - mesh.vertices.len());
    mesh.triangles.reserve_exact(triangles - mesh.triangles.len());
    for part in parts {
        mesh.vertices.extend_from_slice(&part.mesh.vertices[part.lowest..]);
        mesh.triangles.extend_from_slice(&part.mesh.triangles);
    }
    if any_nan {
        mesh.drop_unused_vertices();
    }
    mesh
}

/// [`extract_dense`] of a field given as a function of the position; it is called once a lattice point, x fastest.
#[must_use]
pub fn extract_fn(
    dims: [usize; 3],
    origin: [f32; 3],
    spacing: f32,
    iso: f32,
    mut field: impl FnMut([f32; 3]) -> f32,
) -> TriMesh {
    let mut values = Vec::new();
    for z in 0..dims[2] {
        for y in 0..dims[1] {
            values.extend((0..dims[0]).map(|x| {
                let cell = [x, y, z];
                field(std::array::from_fn(|a| origin[a] + spacing * cell[a] as f32))
            }));
        }
    }
    extract_dense(dims, &values, origin, spacing, iso)
}

/// Vertices keep this part of the spacing away from lattice points. Where a value equals the level, up to six vertices
/// would otherwise coincide, with triangles that have no area and hence no normal.
const MARGIN: f64 = 1.0 / 1024.0;

/// Position between two lattice neighbours, in 0..1, at which the linear interpolant of their values is `iso`.
#[inline]
pub(crate) fn crossing(a: f32, b: f32, iso: f32) -> f64 {
    let (a, b, iso) = (f64::from(a), f64::from(b), f64::from(iso));
    let t = (iso - a) / (b - a);
    let t = if (b - a).is_finite() && t.is_finite() { t.clamp(MARGIN, 1.0 - MARGIN) } else { 0.5 };
    // With few enough digits to be added to a lattice number without rounding: a vertex is then at the same place however
    // its lattice is numbered.
    f64::from(t as f32)
}

/// Signs of one layer of lattice points, 64 to a word, rows padded to whole words.
struct Layer {
    outside: Vec<u64>,
    nan: Vec<u64>,
}

struct Extraction<'a> {
    dims: [usize; 3],
    values: &'a [f32],
    origin: [f64; 3],
    spacing: f64,
    iso: f32,
    /// Words in a row of signs.
    words: usize,
    /// Vertex on each lattice edge of the current slab, valid only for crossed edges: five planes of `dims[0] *
    /// dims[1]`, for edges along x and y in even layers, along x and y in odd layers, and along z between them.
    vertex_on: Vec<u32>,
    mesh: TriMesh,
    any_nan: bool,
}

impl<'a> Extraction<'a> {
    fn new(dims: [usize; 3], values: &'a [f32], origin: [f32; 3], spacing: f32, iso: f32) -> Self {
        Self {
            dims,
            values,
            origin: origin.map(f64::from),
            spacing: f64::from(spacing),
            iso,
            words: dims[0].div_ceil(64),
            vertex_on: vec![0; 5 * dims[0] * dims[1]],
            mesh: TriMesh::default(),
            any_nan: false,
        }
    }

    /// Extracts the cells between layers `z` and `z + 1` for each `z` of `slabs`.
    fn run(mut self, slabs: Range<usize>) -> Part {
        let size = self.words * self.dims[1];
        let layer = || Layer { outside: vec![0; size], nan: vec![0; size] };
        let (mut below, mut above) = (layer(), layer());
        self.classify(slabs.start, &mut below);
        self.vertices_in_layer(slabs.start, &below);
        let lowest = self.mesh.vertices.len();
        let mut highest = 0;
        for z in slabs {
            self.classify(z + 1, &mut above);
            highest = self.mesh.vertices.len();
            self.vertices_in_layer(z + 1, &above);
            self.vertices_between(z, &below, &above);
            self.triangles(z, &below, &above);
            std::mem::swap(&mut below, &mut above);
        }
        Part { mesh: self.mesh, lowest, highest, any_nan: self.any_nan }
    }

    fn classify(&mut self, z: usize, layer: &mut Layer) {
        let [nx, ny, _] = self.dims;
        let plane = &self.values[nx * ny * z..nx * ny * (z + 1)];
        let rows = layer.outside.chunks_exact_mut(self.words).zip(layer.nan.chunks_exact_mut(self.words));
        for (row, (outside, nan)) in plane.chunks_exact(nx).zip(rows) {
            for ((chunk, outside), nan) in row.chunks(64).zip(outside).zip(nan) {
                *outside = bits_where(chunk, |v| v > self.iso);
                *nan = 0;
                if chunk.iter().fold(false, |any, v| any | v.is_nan()) {
                    *nan = bits_where(chunk, f32::is_nan);
                    self.any_nan = true;
                }
            }
        }
    }

    /// Makes a vertex on the edge of `axis` from lattice point `at`, and notes it in plane `plane`.
    #[inline]
    fn add_vertex(&mut self, axis: usize, at: [usize; 3], plane: usize) {
        let [nx, ny, _] = self.dims;
        let stride = [1, nx, nx * ny][axis];
        let in_layer = at[0] + nx * at[1];
        let i = in_layer + nx * ny * at[2];
        let t = crossing(self.values[i], self.values[i + stride], self.iso);
        let mut p = at.map(|c| c as f64);
        p[axis] += t;
        self.vertex_on[plane * nx * ny + in_layer] = self.mesh.vertices.len() as u32;
        self.mesh.vertices.push(std::array::from_fn(|a| (self.origin[a] + self.spacing * p[a]) as f32));
    }

    /// Vertices on the edges along x and y of layer `z`.
    fn vertices_in_layer(&mut self, z: usize, layer: &Layer) {
        let [nx, ny, _] = self.dims;
        let plane = 2 * (z % 2);
        for y in 0..ny {
            let row = y * self.words;
            for w in 0..self.words {
                let (outside, nan) = (layer.outside[row + w], layer.nan[row + w]);
                let next = if w + 1 < self.words { row + w + 1 } else { usize::MAX };
                let crossed = (outside ^ shifted(&layer.outside, row + w, next))
                    & !(nan | shifted(&layer.nan, row + w, next))
                    & low_bits(nx - 1, w);
                for_ones(crossed, |b| self.add_vertex(0, [64 * w + b, y, z], plane));
                if y + 1 < ny {
                    let up = row + w + self.words;
                    let crossed = (outside ^ layer.outside[up]) & !(nan | layer.nan[up]);
                    for_ones(crossed, |b| self.add_vertex(1, [64 * w + b, y, z], plane + 1));
                }
            }
        }
    }

    /// Vertices on the edges along z between layers `z` and `z + 1`.
    fn vertices_between(&mut self, z: usize, below: &Layer, above: &Layer) {
        for y in 0..self.dims[1] {
            for w in 0..self.words {
                let i = y * self.words + w;
                let crossed = (below.outside[i] ^ above.outside[i]) & !(below.nan[i] | above.nan[i]);
                for_ones(crossed, |b| self.add_vertex(2, [64 * w + b, y, z], 4));
            }
        }
    }

    fn triangles(&mut self, z: usize, below: &Layer, above: &Layer) {
        let [nx, ny, _] = self.dims;
        let (cases, offsets) = (&*CASES, self.edge_offsets(z));
        for y in 0..ny - 1 {
            for w in 0..self.words {
                let i = y * self.words + w;
                let j = i + self.words;
                let next = |k: usize| if w + 1 < self.words { k + 1 } else { usize::MAX };
                // Rows of corners 0, 2, 4, 6, then the same one step along x: corners 1, 3, 5, 7.
                let low = [below.outside[i], below.outside[j], above.outside[i], above.outside[j]];
                let high = [
                    shifted(&below.outside, i, next(i)),
                    shifted(&below.outside, j, next(j)),
                    shifted(&above.outside, i, next(i)),
                    shifted(&above.outside, j, next(j)),
                ];
                let any = low.iter().chain(&high).fold(0, |acc, r| acc | r);
                let all = low.iter().chain(&high).fold(!0, |acc, r| acc & r);
                let mut mixed = any & !all & low_bits(nx - 1, w);
                if mixed != 0 && self.any_nan {
                    for (layer, k) in [(below, i), (below, j), (above, i), (above, j)] {
                        mixed &= !(layer.nan[k] | shifted(&layer.nan, k, next(k)));
                    }
                }
                for_ones(mixed, |b| {
                    let mut case = 0;
                    for k in 0..4 {
                        case |= (low[k] >> b & 1) << (2 * k) | (high[k] >> b & 1) << (2 * k + 1);
                    }
                    let cell = 64 * w + b + nx * y;
                    self.mesh.triangles.extend(
                        cases[case as usize]
                            .triangles()
                            .iter()
                            .map(|t| t.map(|e| self.vertex_on[cell + offsets[usize::from(e)]])),
                    );
                });
            }
        }
    }

    /// Where each of a cell's 12 edges is in `vertex_on`, relative to the cell's place in its layer.
    fn edge_offsets(&self, z: usize) -> [usize; 12] {
        let [nx, ny, _] = self.dims;
        EDGES.map(|(axis, lower)| {
            let plane = if axis == 2 { 4 } else { 2 * ((z + (lower >> 2)) % 2) + axis };
            plane * nx * ny + (lower & 1) + nx * (lower >> 1 & 1)
        })
    }
}

/// One bit for each of up to 64 values.
#[inline]
fn bits_where(values: &[f32], test: impl Fn(f32) -> bool) -> u64 {
    let mut flags = [0u8; 64];
    for (flag, v) in flags.iter_mut().zip(values) {
        *flag = u8::from(test(*v));
    }
    let mut bits = 0;
    for (k, group) in flags.as_chunks::<8>().0.iter().enumerate() {
        // The product gathers the low bits of eight bytes in its top byte.
        bits |= (u64::from_le_bytes(*group).wrapping_mul(0x0102_0408_1020_4080) >> 56) << (8 * k);
    }
    bits
}

/// Signs one step further along x; `next` is the following word of the row, or out of range.
#[inline]
fn shifted(row: &[u64], word: usize, next: usize) -> u64 {
    row[word] >> 1 | row.get(next).map_or(0, |n| n << 63)
}

/// Bits of word `w` that stand for positions below `limit`.
#[inline]
fn low_bits(limit: usize, w: usize) -> u64 {
    match limit.saturating_sub(64 * w) {
        0 => 0,
        n if n >= 64 => !0,
        n => (1 << n) - 1,
    }
}

#[inline]
pub(crate) fn for_ones(mut word: u64, mut f: impl FnMut(usize)) {
    while word != 0 {
        f(word.trailing_zeros() as usize);
        word &= word - 1;
    }
}
