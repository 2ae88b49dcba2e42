//! The best view of each face.

use std::collections::HashMap;

use marching_cubes::TriMesh;

use super::sample::Sighting;

/// What a change of view between two neighbours costs, in shares of a face's best score.
const CHANGE: f32 = 0.25;
/// Sweeps of the smoothing.
const SWEEPS: usize = 12;

/// The view that gives each face its detail; `None` where no view saw all three corners.
///
/// Iterated conditional modes (Besag 1986) on the faces' scores with a Potts term over neighbours.
pub(super) fn best_views(mesh: &TriMesh, sightings: &[Vec<Sighting>]) -> Vec<Option<u16>> {
    let scores: Vec<Vec<(u16, f32)>> = mesh.triangles.iter().map(|t| face_scores(*t, sightings)).collect();
    let neighbours = neighbours(mesh);
    let best = |list: &[(u16, f32)]| list.iter().copied().max_by(|a, b| a.1.total_cmp(&b.1));
    let mut labels: Vec<Option<u16>> = scores.iter().map(|list| best(list).map(|(view, _)| view)).collect();
    for _ in 0..SWEEPS {
        let mut changed = false;
        for (f, list) in scores.iter().enumerate() {
            let Some((_, top)) = best(list) else { continue };
            let energy = |(view, score): (u16, f32)| {
                let others = neighbours[f].iter().filter(|&&g| labels[g as usize].is_some_and(|l| l != view));
                1.0 - score / top + CHANGE * others.count() as f32
            };
            let choice = list.iter().copied().min_by(|a, b| energy(*a).total_cmp(&energy(*b)));
            let choice = choice.map(|(view, _)| view);
            changed |= choice != labels[f];
            labels[f] = choice;
        }
        if !changed {
            break;
        }
    }
    labels
}

/// Views that see all three corners, with the product of what they are worth there.
fn face_scores(t: [u32; 3], sightings: &[Vec<Sighting>]) -> Vec<(u16, f32)> {
    let [a, b, c] = t.map(|i| &sightings[i as usize]);
    let of = |list: &[Sighting], view: u16| list.iter().find(|s| s.view == view).map(|s| s.detail);
    let all = a.iter().filter_map(|s| {
        let (p, q) = (of(b, s.view)?, of(c, s.view)?);
        Some((s.view, (s.detail * p * q).cbrt()))
    });
    all.collect()
}

/// Faces across the edges of each face.
fn neighbours(mesh: &TriMesh) -> Vec<Vec<u32>> {
    let mut edges: HashMap<(u32, u32), u32> = HashMap::with_capacity(2 * mesh.triangles.len());
    let mut lists = vec![Vec::with_capacity(3); mesh.triangles.len()];
    for (f, t) in (0u32..).zip(&mesh.triangles) {
        for k in 0..3 {
            let (a, b) = (t[k], t[(k + 1) % 3]);
            if let Some(other) = edges.insert((a.min(b), a.max(b)), f) {
                lists[f as usize].push(other);
                lists[other as usize].push(f);
            }
        }
    }
    lists
}

/// Weights of the views' detail at each vertex: the share of its faces that take it from them. Within a face they are
/// interpolated, so that detail fades from one view to the next over the width of a face.
pub(super) fn feathered(
    mesh: &TriMesh,
    sightings: &[Vec<Sighting>],
    labels: &[Option<u16>],
) -> Vec<Vec<(u16, f32)>> {
    let mut weights: Vec<Vec<(u16, f32)>> = vec![Vec::new(); mesh.vertices.len()];
    for (t, label) in mesh.triangles.iter().zip(labels) {
        let Some(view) = *label else { continue };
        for &v in t {
            let list = &mut weights[v as usize];
            match list.iter_mut().find(|(other, _)| *other == view) {
                Some((_, weight)) => *weight += 1.0,
                None => list.push((view, 1.0)),
            }
        }
    }
    for (list, seen) in weights.iter_mut().zip(sightings) {
        if list.is_empty() {
            // On the rim of what was seen no face is complete.
            let best = seen.iter().max_by(|a, b| a.detail.total_cmp(&b.detail));
            list.extend(best.map(|s| (s.view, 1.0)));
        }
        let sum: f32 = list.iter().map(|(_, weight)| weight).sum();
        list.iter_mut().for_each(|(_, weight)| *weight /= sum);
    }
    weights
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A strip of faces and two views: one better on the left, one on the right, with noise between.
    #[test]
    fn labels_follow_the_scores_without_islands() {
        let n = 40u32;
        let mesh = TriMesh {
            vertices: (0..n).map(|i| [i as f32, (i % 2) as f32, 0.0]).collect(),
            triangles: (0..n - 2).map(|i| [i, i + 1, i + 2]).collect(),
            ..TriMesh::default()
        };
        let sighting =
            |view, detail| Sighting { view, broad: detail, detail, color: [0.0; 3], factor: [1.0; 3] };
        let sightings: Vec<_> = (0..n)
            .map(|i| {
                let t = i as f32 / n as f32;
                let noise = if i == 10 { 0.15 } else { 0.0 };
                vec![sighting(0, 1.0 - t - noise), sighting(1, t + noise)]
            })
            .collect();
        let labels = best_views(&mesh, &sightings);
        let changes = labels.windows(2).filter(|w| w[0] != w[1]).count();
        assert_eq!(changes, 1);
        assert_eq!((labels[0], labels[37]), (Some(0), Some(1)));
        let weights = feathered(&mesh, &sightings, &labels);
        assert!(weights.iter().all(|l| (l.iter().map(|w| w.1).sum::<f32>() - 1.0).abs() < 1e-6));
    }

    #[test]
    fn a_face_that_no_view_saw_whole_has_none() {
        let mesh = TriMesh { vertices: vec![[0.0; 3]; 3], triangles: vec![[0, 1, 2]], ..TriMesh::default() };
        let one = |view| vec![Sighting { view, broad: 1.0, detail: 1.0, color: [0.0; 3], factor: [1.0; 3] }];
        assert_eq!(best_views(&mesh, &[one(0), one(0), one(1)]), [None]);
    }
}
