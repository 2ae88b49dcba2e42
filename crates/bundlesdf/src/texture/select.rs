//! The best views of each vertex.

use marching_cubes::TriMesh;

use super::sample::Sighting;

/// A view that scores half as much as the best one weighs one half to this power. Averaging a few views that agree shows
/// more than any of them, each of which has its pixels elsewhere; many that don't quite agree would blur.
const SHARPNESS: i32 = 3;
/// Smaller weights only cost time.
const LEAST: f32 = 0.02;

/// Weights of the views' detail at each vertex, summing to 1; none where no view saw it.
pub(super) fn best_views(sightings: &[Vec<Sighting>]) -> Vec<Vec<(u16, f32)>> {
    sightings.iter().map(|seen| weights(seen)).collect()
}

fn weights(seen: &[Sighting]) -> Vec<(u16, f32)> {
    let best = seen.iter().map(|s| s.detail).fold(f32::MIN_POSITIVE, f32::max);
    let mut weights: Vec<(u16, f32)> = seen
        .iter()
        .map(|s| (s.view, (s.detail / best).powi(SHARPNESS)))
        .filter(|(_, weight)| *weight >= LEAST)
        .collect();
    let sum: f32 = weights.iter().map(|(_, weight)| weight).sum();
    weights.iter_mut().for_each(|(_, weight)| *weight /= sum);
    weights
}

/// How many faces take their detail mostly from each view.
pub(super) fn faces_per_view(mesh: &TriMesh, detail: &[Vec<(u16, f32)>], views: usize) -> Vec<usize> {
    let mut counts = vec![0; views];
    let mut shares = vec![0.0f32; views];
    for t in &mesh.triangles {
        shares.fill(0.0);
        t.iter().flat_map(|&v| &detail[v as usize]).for_each(|&(view, w)| shares[usize::from(view)] += w);
        let best = shares.iter().enumerate().max_by(|a, b| a.1.total_cmp(b.1));
        if let Some((view, _)) = best.filter(|(_, share)| **share > 0.0) {
            counts[view] += 1;
        }
    }
    counts
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sighting(view: u16, detail: f32) -> Sighting {
        Sighting { view, broad: detail, detail, color: [0.0; 3] }
    }

    #[test]
    fn the_best_views_share_and_bad_ones_have_no_say() {
        let all = best_views(&[vec![sighting(0, 1.0), sighting(1, 0.9), sighting(2, 0.1)], vec![]]);
        assert_eq!(all[0].iter().map(|w| w.0).collect::<Vec<_>>(), [0, 1]);
        assert!(all[0][0].1 > all[0][1].1 && (all[0][0].1 + all[0][1].1 - 1.0).abs() < 1e-6);
        assert!(all[1].is_empty());
    }

    #[test]
    fn faces_count_for_the_view_that_has_most_of_them() {
        let mesh = TriMesh {
            vertices: vec![[0.0; 3]; 4],
            triangles: vec![[0, 1, 2], [1, 2, 3]],
            ..TriMesh::default()
        };
        let one = |view| vec![(view, 1.0)];
        let detail = [one(0), one(0), one(1), one(1)];
        assert_eq!(faces_per_view(&mesh, &detail, 3), [1, 1, 0]);
        assert_eq!(faces_per_view(&mesh, &vec![vec![]; 4], 2), [0, 0]);
    }
}
