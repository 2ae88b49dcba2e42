//! How much of its colour each vertex takes from each view.

use super::sample::Sighting;

/// Weights fall with this power of a view's score: a view half as good as the best one has hardly a say, so that detail
/// stays sharp, and views that are equally good average their noise and what is left of shading.
const POWER: f32 = 4.0;
/// Weight, next to that of the best view, below which a view isn't asked at all.
const LEAST: f32 = 0.01;

/// Weights of the views at each vertex, with sum 1; none where no view saw it. Within a face they are interpolated:
/// since scores are smooth over the surface, no seam shows where the best view changes.
pub(super) fn weights(sightings: &[Vec<Sighting>]) -> Vec<Vec<(u16, f32)>> {
    let at_vertex = |list: &Vec<Sighting>| {
        let top = list.iter().map(|s| s.detail).fold(f32::MIN_POSITIVE, f32::max);
        let weights = list.iter().map(|s| (s.view, (s.detail / top).powf(POWER)));
        let mut weights: Vec<_> = weights.filter(|(_, weight)| *weight > LEAST).collect();
        let sum: f32 = weights.iter().map(|(_, weight)| weight).sum();
        weights.iter_mut().for_each(|(_, weight)| *weight /= sum);
        weights
    };
    sightings.iter().map(at_vertex).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sighting(view: u16, detail: f32) -> Sighting {
        Sighting { view, broad: 1.0, detail, color: [0.0; 3], factor: [1.0; 3] }
    }

    #[test]
    fn equal_views_share_and_poor_ones_are_left_out() {
        let found = weights(&[vec![sighting(4, 0.6), sighting(7, 0.6), sighting(9, 0.15)], vec![]]);
        assert_eq!(found, [vec![(4, 0.5), (7, 0.5)], vec![]]);
    }

    /// From one end of a strip to the other the best of two views changes.
    #[test]
    fn weights_change_without_a_step() {
        const COUNT: usize = 100;
        let strip: Vec<_> = (0..COUNT)
            .map(|i| {
                let t = (i as f32 + 0.5) / COUNT as f32;
                vec![sighting(0, 1.0 - t), sighting(1, t)]
            })
            .collect();
        let of_first = |list: &Vec<(u16, f32)>| list.iter().find(|w| w.0 == 0).map_or(0.0, |w| w.1);
        let found = weights(&strip);
        assert!(found.iter().all(|list| (list.iter().map(|w| w.1).sum::<f32>() - 1.0).abs() < 1e-6));
        let first: Vec<f32> = found.iter().map(of_first).collect();
        assert_eq!((first[0], first[COUNT - 1]), (1.0, 0.0));
        assert!(first.windows(2).all(|w| w[0] >= w[1] && w[0] - w[1] < 0.1), "{first:?}");
    }
}
