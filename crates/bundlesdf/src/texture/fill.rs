//! Colour where nothing was seen.

use std::collections::VecDeque;

use marching_cubes::TriMesh;
use rgbd_io::Image;

/// Sweeps of smoothing over the unknown vertices.
const SWEEPS: usize = 150;

/// A value for every vertex: the known ones stay, the others are the smoothest surface through them (Laplace's
/// equation on the mesh). Pieces without any known vertex get the mesh's colours, or the mean.
pub(super) fn over_surface(mesh: &TriMesh, known: &[Option<[f32; 3]>]) -> Vec<[f32; 3]> {
    let mut around: Vec<Vec<u32>> = vec![Vec::new(); known.len()];
    for t in &mesh.triangles {
        for k in 0..3 {
            around[t[k] as usize].extend([t[(k + 1) % 3], t[(k + 2) % 3]]);
        }
    }
    let count = known.iter().flatten().count().max(1) as f32;
    let sum = known.iter().flatten().fold([0.0f32; 3], |s, c| std::array::from_fn(|k| s[k] + c[k]));
    let mean = if known.iter().any(Option::is_some) { sum.map(|v| v / count) } else { [128.0; 3] };
    // The nearest known colour first, along the surface, in the order in which it arrives.
    let mut values: Vec<Option<[f32; 3]>> = known.to_vec();
    let mut order = Vec::new();
    let mut queue: VecDeque<usize> = (0..known.len()).filter(|&i| known[i].is_some()).collect();
    while let Some(i) = queue.pop_front() {
        for &j in &around[i] {
            if values[j as usize].is_none() {
                values[j as usize] = values[i];
                order.push(j as usize);
                queue.push_back(j as usize);
            }
        }
    }
    let fallback = |i: usize| if mesh.has_colors() { mesh.colors[i].map(f32::from) } else { mean };
    let mut values: Vec<[f32; 3]> =
        values.into_iter().enumerate().map(|(i, v)| v.unwrap_or_else(|| fallback(i))).collect();
    for _ in 0..SWEEPS {
        for &i in &order {
            let n = around[i].len().max(1) as f32;
            let sum = around[i].iter().fold([0.0f32; 3], |s, &j| {
                let c = values[j as usize];
                std::array::from_fn(|k| s[k] + c[k])
            });
            values[i] = sum.map(|v| v / n);
        }
    }
    values
}

/// Gives every texel that shows no surface the colour of one of the nearest that do, so that filtering and mipmaps
/// never mix in anything foreign.
pub(super) fn over_gaps(texture: &mut Image<[u8; 3]>, covered: &mut [bool]) {
    let (width, height) = texture.size();
    let mut front: Vec<u32> = (0..covered.len() as u32).filter(|&i| covered[i as usize]).collect();
    let mut next = Vec::new();
    while !front.is_empty() {
        for &i in &front {
            let (x, y) = (i as usize % width, i as usize / width);
            let color = texture[(x, y)];
            let steps = [(x.wrapping_sub(1), y), (x + 1, y), (x, y.wrapping_sub(1)), (x, y + 1)];
            for (u, v) in steps.into_iter().filter(|&(u, v)| u < width && v < height) {
                let at = v * width + u;
                if !covered[at] {
                    covered[at] = true;
                    texture[(u, v)] = color;
                    next.push(at as u32);
                }
            }
        }
        front.clear();
        std::mem::swap(&mut front, &mut next);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colour_runs_evenly_between_known_ends() {
        let n = 11u32;
        let mesh = TriMesh {
            vertices: (0..n).map(|i| [i as f32, (i % 2) as f32, 0.0]).collect(),
            triangles: (0..n - 2).map(|i| [i, i + 1, i + 2]).collect(),
            ..TriMesh::default()
        };
        let mut known = vec![None; n as usize];
        known[0] = Some([0.0; 3]);
        known[10] = Some([100.0; 3]);
        let values = over_surface(&mesh, &known);
        assert!(values.windows(2).all(|w| w[1][0] > w[0][0]));
        assert!((values[5][0] - 50.0).abs() < 5.0, "{values:?}");
    }

    #[test]
    fn what_was_never_near_anything_seen_keeps_the_meshs_colour() {
        let mesh = TriMesh {
            vertices: vec![[0.0; 3]; 6],
            triangles: vec![[0, 1, 2], [3, 4, 5]],
            colors: vec![[9; 3]; 6],
            ..TriMesh::default()
        };
        let mut known = vec![None; 6];
        known[0] = Some([80.0; 3]);
        let values = over_surface(&mesh, &known);
        assert_eq!(values[1], [80.0; 3]);
        assert_eq!(values[4], [9.0; 3]);
    }

    #[test]
    fn gaps_take_the_nearest_colour() {
        let mut texture = Image::filled(9, 3, [0; 3]);
        let mut covered = vec![false; 27];
        for (x, color) in [(0, [10; 3]), (8, [90; 3])] {
            texture[(x, 1)] = color;
            covered[9 + x] = true;
        }
        over_gaps(&mut texture, &mut covered);
        assert_eq!((texture[(2, 0)], texture[(7, 2)]), ([10; 3], [90; 3]));
        assert!(covered.iter().all(|c| *c));
    }
}
