//! Colours that agree: gains of the views, outliers, and a colour for every vertex.

use marching_cubes::TriMesh;

use super::{fill, sample::Sighting};

/// Rounds of the alternating least squares.
const ROUNDS: usize = 60;
/// Weight of "no gain at all", as a share of a view's sightings.
const PRIOR: f64 = 0.02;
/// Difference of log colours from which on a sighting counts less (Huber 1964).
const HUBER: f64 = 0.15;
/// Least distance of colours (0 to 255) that makes an outlier.
const OUTLIER: f32 = 24.0;

/// Factors on red, green and blue for each view beside those of the sightings: the least-squares solution of "what two
/// views saw of one vertex has one colour", in logarithms, robust, with mean 1 over the views.
pub(super) fn gains(sightings: &[Vec<Sighting>], views: usize) -> Vec<[f32; 3]> {
    let log = |v: f32| f64::from(v.max(4.0)).ln();
    let mut gains = vec![[0.0f64; 3]; views];
    for channel in 0..3 {
        let mut gain = vec![0.0f64; views];
        for _ in 0..ROUNDS {
            let mut sums = vec![(0.0f64, 0.0f64); views];
            for list in sightings.iter().filter(|list| list.len() > 1) {
                let own = |s: &Sighting| log(s.color[channel] * s.factor[channel]);
                let corrected = |s: &Sighting| own(s) + gain[usize::from(s.view)];
                let weight: f64 = list.iter().map(|s| f64::from(s.broad)).sum();
                let mean = list.iter().map(|s| f64::from(s.broad) * corrected(s)).sum::<f64>() / weight;
                for s in list {
                    let error = mean - corrected(s);
                    let weight = f64::from(s.broad) * (HUBER / error.abs()).min(1.0);
                    let (total, weights) = &mut sums[usize::from(s.view)];
                    *total += weight * (mean - own(s));
                    *weights += weight;
                }
            }
            for (g, (total, weights)) in gain.iter_mut().zip(sums) {
                *g = if weights > 0.0 { total / (weights * (1.0 + PRIOR)) } else { 0.0 };
            }
            let mean = gain.iter().sum::<f64>() / views.max(1) as f64;
            gain.iter_mut().for_each(|g| *g -= mean);
        }
        gains.iter_mut().zip(gain).for_each(|(all, g)| all[channel] = g);
    }
    gains.iter().map(|g| g.map(|v| v.exp() as f32)).collect()
}

pub(super) fn scaled(color: [f32; 3], gain: [f32; 3]) -> [f32; 3] {
    std::array::from_fn(|k| color[k] * gain[k])
}

pub(super) fn to_bytes(color: [f32; 3]) -> [u8; 3] {
    color.map(|v| v.round().clamp(0.0, 255.0) as u8)
}

/// Removes views from vertices where most others see another colour: a hand, a shadow, a highlight.
pub(super) fn drop_outliers(sightings: &mut [Vec<Sighting>]) {
    for list in sightings.iter_mut().filter(|list| list.len() > 2) {
        let median = median(list);
        let distance = |s: &Sighting| {
            let c = scaled(s.color, s.factor);
            (0..3).map(|k| (c[k] - median[k]).abs()).fold(0.0, f32::max)
        };
        let typical = weighted_median(list.iter().map(|s| (distance(s), s.broad)).collect());
        let limit = OUTLIER.max(3.0 * typical);
        list.retain(|s| distance(s) <= limit);
    }
}

fn median(list: &[Sighting]) -> [f32; 3] {
    std::array::from_fn(|k| {
        weighted_median(list.iter().map(|s| (s.color[k] * s.factor[k], s.broad)).collect())
    })
}

fn weighted_median(mut values: Vec<(f32, f32)>) -> f32 {
    values.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
    let half = 0.5 * values.iter().map(|v| v.1).sum::<f32>();
    let mut sum = 0.0;
    for &(value, weight) in &values {
        sum += weight;
        if sum >= half {
            return value;
        }
    }
    values.last().map_or(0.0, |v| v.0)
}

/// Multiplies each view's sightings by its gain.
pub(super) fn apply(sightings: &mut [Vec<Sighting>], gains: &[[f32; 3]]) {
    for s in sightings.iter_mut().flatten() {
        s.factor = scaled(s.factor, gains[usize::from(s.view)]);
    }
}

/// The colour (0 to 255) that the views of a point agree on; `None` without views.
pub(super) fn agreed(list: &[Sighting]) -> Option<[f32; 3]> {
    if list.len() > 2 {
        return Some(median(list));
    }
    let weight: f32 = list.iter().map(|s| s.broad).sum();
    let sum = list.iter().fold([0.0; 3], |sum: [f32; 3], s| {
        let c = scaled(s.color, s.factor);
        std::array::from_fn(|k| sum[k] + s.broad * c[k])
    });
    (weight > 0.0).then(|| sum.map(|v| v / weight))
}

/// The colour of every vertex, 0 to 255; where no view saw it, what the surroundings suggest.
pub(super) fn vertex_colors(mesh: &TriMesh, sightings: &[Vec<Sighting>]) -> Vec<[f32; 3]> {
    let known: Vec<_> = sightings.iter().map(|list| agreed(list)).collect();
    fill::over_surface(mesh, &known)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sighting(view: u16, color: [f32; 3]) -> Sighting {
        Sighting { view, broad: 1.0, detail: 1.0, color, factor: [1.0; 3] }
    }

    #[test]
    fn gains_undo_exposure() {
        // Three views of 60 vertices, each seen by two of them, with known exposure.
        let exposure = [[1.2, 1.0, 0.9], [0.8, 1.1, 1.0], [1.0 / 0.96, 1.0 / 1.1, 1.0 / 0.9]];
        let list = |i: usize| {
            let albedo = [60.0 + i as f32, 150.0 - i as f32, 90.0];
            let pair = [i % 3, (i + 1) % 3];
            pair.map(|v| sighting(v as u16, scaled(albedo, exposure[v]))).to_vec()
        };
        let sightings: Vec<_> = (0..60).map(list).collect();
        let gains = gains(&sightings, 3);
        for k in 0..3 {
            let products: Vec<f32> = (0..3).map(|v| gains[v][k] * exposure[v][k]).collect();
            for p in &products {
                // The prior keeps a little of the difference.
                assert!((p / products[0] - 1.0).abs() < 0.02, "{products:?}");
            }
        }
    }

    #[test]
    fn a_view_of_a_hand_is_dropped_and_a_highlight_too() {
        let mut sightings = vec![vec![
            sighting(0, [100.0, 50.0, 50.0]),
            sighting(1, [104.0, 52.0, 49.0]),
            sighting(2, [98.0, 47.0, 52.0]),
            sighting(3, [200.0, 160.0, 140.0]),
        ]];
        drop_outliers(&mut sightings);
        assert_eq!(sightings[0].iter().map(|s| s.view).collect::<Vec<_>>(), [0, 1, 2]);
    }
}
