//! The triangles of the 256 sign patterns of a cell, derived from one rule for a face.
//!
//! Corner `c` sits at `(c & 1, c >> 1 & 1, c >> 2)`; bit `c` of a case is set when the corner is outside (its value
//! is above the iso level). Edge `4 * axis + k` runs along `axis`; see [`EDGES`].

use std::sync::LazyLock;

/// Axis and lower corner of each of the 12 edges.
pub(crate) const EDGES: [(usize, usize); 12] = [
    (0, 0b000),
    (0, 0b010),
    (0, 0b100),
    (0, 0b110),
    (1, 0b000),
    (1, 0b001),
    (1, 0b100),
    (1, 0b101),
    (2, 0b000),
    (2, 0b001),
    (2, 0b010),
    (2, 0b011),
];

/// Most triangles that a case has.
const MAX_TRIANGLES: usize = 5;

/// Triangles of one case, as edge numbers, counter-clockwise seen from the outside.
#[derive(Clone, Copy, Default)]
pub(crate) struct Case {
    count: u8,
    edges: [[u8; 3]; MAX_TRIANGLES],
}

impl Case {
    #[inline]
    pub(crate) fn triangles(&self) -> &[[u8; 3]] {
        self.edges.get(..usize::from(self.count)).unwrap_or_default()
    }
}

/// The 256 cases, by corner signs.
pub(crate) static CASES: LazyLock<[Case; 256]> = LazyLock::new(|| std::array::from_fn(derive_case));

fn derive_case(outside: usize) -> Case {
    let mut case = Case::default();
    for polygon in loops(outside) {
        let mut triangles = Vec::new();
        triangulate(&polygon, &mut triangles);
        for t in triangles {
            // Five always suffice, see the tests.
            if let Some(slot) = case.edges.get_mut(usize::from(case.count)) {
                *slot = t;
                case.count += 1;
            }
        }
    }
    case
}

fn edge_between(a: usize, b: usize) -> u8 {
    EDGES.iter().position(|&(axis, lower)| lower == a & b && 1 << axis == a ^ b).unwrap_or(0) as u8
}

/// Corners of a face, counter-clockwise seen from outside the cell.
fn face_corners(axis: usize, side: usize) -> [usize; 4] {
    let (u, v) = (1 << ((axis + 1) % 3), 1 << ((axis + 2) % 3));
    let base = side << axis;
    if side == 1 {
        [base, base | u, base | u | v, base | v]
    } else {
        [base, base | v, base | u | v, base | u]
    }
}

/// For each crossed edge the next one along the surface, [`NONE`] for the others.
///
/// Walking around a face, the surface enters the inside at one edge and leaves it at another. The segment joins each
/// entry with the exit that ends the same run of inside corners, so two inside corners that face each other
/// diagonally stay separate. The rule looks at nothing but the face, hence both cells at a face agree, and since they
/// walk it in opposite senses, so do their orientations. Every edge is an entry on exactly one of its two faces.
fn successors(outside: usize) -> [u8; 12] {
    let inside = |corner: usize| outside >> corner & 1 == 0;
    let mut next = [NONE; 12];
    for axis in 0..3 {
        for side in 0..2 {
            let corners = face_corners(axis, side);
            for i in 0..4 {
                let at = |k: usize| corners[(i + k) % 4];
                if inside(at(0)) || !inside(at(1)) {
                    continue;
                }
                for run in 1..4 {
                    if inside(at(run)) && !inside(at(run + 1)) {
                        next[usize::from(edge_between(at(0), at(1)))] = edge_between(at(run), at(run + 1));
                        break;
                    }
                }
            }
        }
    }
    next
}

const NONE: u8 = u8::MAX;

/// Closed polygons that the surface cuts out of a cell.
fn loops(outside: usize) -> Vec<Vec<u8>> {
    let mut next = successors(outside);
    let mut found = Vec::new();
    for start in 0..12 {
        let (mut polygon, mut edge) = (Vec::new(), start);
        while let Some(&following) = next.get(edge).filter(|&&n| n != NONE) {
            polygon.push(edge as u8);
            next[edge] = NONE;
            edge = usize::from(following);
        }
        if !polygon.is_empty() {
            found.push(polygon);
        }
    }
    found
}

/// Whether two edges of the cell bound a common face.
fn share_face(a: u8, b: u8) -> bool {
    let faces = |edge: u8| {
        let (along, lower) = EDGES[usize::from(edge)];
        (0..3).filter(|&axis| axis != along).map(|axis| 1u32 << (2 * axis + (lower >> axis & 1))).sum::<u32>()
    };
    faces(a) & faces(b) != 0
}

/// Triangulates a polygon with the fewest diagonals inside a face of the cell (none, see the tests): the neighbour
/// might draw the same diagonal, and the edge would have four triangles. Returns how many there are.
fn triangulate(polygon: &[u8], out: &mut Vec<[u8; 3]>) -> usize {
    let [first, .., last] = *polygon else { return 0 };
    let mut best: Option<(usize, Vec<[u8; 3]>)> = None;
    for k in 1..polygon.len() - 1 {
        let mut triangles = vec![[first, polygon[k], last]];
        let mut bad = usize::from(k > 1 && share_face(first, polygon[k]));
        bad += usize::from(k + 2 < polygon.len() && share_face(polygon[k], last));
        bad += triangulate(&polygon[..=k], &mut triangles) + triangulate(&polygon[k..], &mut triangles);
        if best.as_ref().is_none_or(|(least, _)| bad < *least) {
            best = Some((bad, triangles));
        }
    }
    best.map_or(0, |(bad, triangles)| {
        out.extend(triangles);
        bad
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;

    #[test]
    fn every_loop_has_a_triangulation_off_the_faces() {
        for outside in 0..256 {
            let mut total = 0;
            for polygon in loops(outside) {
                let mut triangles = Vec::new();
                assert!(polygon.len() >= 3);
                assert_eq!(triangulate(&polygon, &mut triangles), 0, "case {outside:08b} loop {polygon:?}");
                assert_eq!(triangles.len(), polygon.len() - 2);
                total += triangles.len();
            }
            assert_eq!(CASES[outside].triangles().len(), total, "case {outside:08b} exceeds the table");
        }
    }

    #[test]
    fn exactly_the_crossed_edges_carry_vertices() {
        for outside in 0..256usize {
            let mut used = [false; 12];
            for e in CASES[outside].triangles().as_flattened() {
                used[usize::from(*e)] = true;
            }
            for (edge, (axis, lower)) in EDGES.into_iter().enumerate() {
                let crossed = (outside >> lower ^ outside >> (lower | 1 << axis)) & 1 == 1;
                assert_eq!(used[edge], crossed, "case {outside:08b} edge {edge}");
            }
        }
    }

    /// Boundary of a case: directed sides that no other triangle of the case takes back.
    fn boundary(outside: usize) -> Vec<(u8, u8)> {
        let mut count: BTreeMap<(u8, u8), i32> = BTreeMap::new();
        for t in CASES[outside].triangles() {
            for (a, b) in [(t[0], t[1]), (t[1], t[2]), (t[2], t[0])] {
                *count.entry((a, b)).or_default() += 1;
                *count.entry((b, a)).or_default() -= 1;
            }
        }
        count.into_iter().filter(|&(_, n)| n > 0).map(|(side, n)| (side, assert_eq!(n, 1)).0).collect()
    }

    /// Every pair of cases that can be neighbours leaves the same segments on the common face, reversed.
    #[test]
    fn every_case_is_closed_against_its_neighbours() {
        for axis in 0..3 {
            let bit = 1 << axis;
            let on_face = |side: usize, e: u8| {
                let (along, lower) = EDGES[usize::from(e)];
                along != axis && lower >> axis & 1 == side
            };
            let segments = |case: usize, side: usize| -> Vec<(u8, u8)> {
                boundary(case).into_iter().filter(|&(a, b)| on_face(side, a) && on_face(side, b)).collect()
            };
            let to_low = |e: u8| {
                let (along, lower) = EDGES[usize::from(e)];
                edge_between(lower & !bit, (lower | 1 << along) & !bit)
            };
            for here in 0..256usize {
                let mut mine: Vec<_> =
                    segments(here, 1).into_iter().map(|(a, b)| (to_low(b), to_low(a))).collect();
                mine.sort_unstable();
                for there in 0..256usize {
                    if !(0..8).filter(|c| c & bit == 0).all(|c| here >> (c | bit) & 1 == there >> c & 1) {
                        continue;
                    }
                    let mut theirs = segments(there, 0);
                    theirs.sort_unstable();
                    assert_eq!(mine, theirs, "axis {axis}, {here:08b} beside {there:08b}");
                }
            }
        }
    }

    #[test]
    fn a_lone_inside_corner_faces_outwards() {
        let t = CASES[0b1111_1110].triangles();
        assert_eq!(t.len(), 1);
        // Normal (1, 1, 1): the edges along x, y and z in cyclic order.
        let axes = t[0].map(|e| e / 4);
        assert!([[0, 1, 2], [1, 2, 0], [2, 0, 1]].contains(&axes), "{axes:?}");
    }
}
