//! One colour for each point of the surface, and what each view has to be multiplied by to show it.

use marching_cubes::TriMesh;
use rayon::prelude::*;

use super::{color::scaled, sample::Sighting};

/// Rounds of smoothing; the corrections are smooth over about the square root of so many edges.
const SWEEPS: usize = 16;
/// A correction beyond this factor is a mistake.
const MOST: f32 = 2.0;
/// Colours below this (0 to 255) have no ratio.
const DARK: f32 = 8.0;

/// Multiplies each sighting's factor by what brings the view, in the neighbourhood of the vertex, to the colours that
/// all views agree on: what is left of shadows, of highlights and of lamps that are near. The correction is smooth over
/// the surface, so that the view's detail stays as it is and no seam is left beside other views.
pub(super) fn level(mesh: &TriMesh, sightings: &mut [Vec<Sighting>], colors: &[[f32; 3]], views: usize) {
    let around = neighbours(mesh, sightings.len());
    let smooth: Vec<Vec<(u32, [f32; 3])>> =
        (0..views as u16).into_par_iter().map(|view| corrections(view, sightings, colors, &around)).collect();
    for (view, list) in (0u16..).zip(smooth) {
        for (vertex, factor) in list {
            if let Some(s) = sightings[vertex as usize].iter_mut().find(|s| s.view == view) {
                s.factor = scaled(s.factor, factor);
            }
        }
    }
}

/// The view's corrections at the vertices that it sees.
fn corrections(
    view: u16,
    sightings: &[Vec<Sighting>],
    colors: &[[f32; 3]],
    around: &[Vec<u32>],
) -> Vec<(u32, [f32; 3])> {
    let mut place = vec![u32::MAX; sightings.len()];
    let mut seen = Vec::new();
    // Log ratios and how much they are worth: as much as others had a say in the colour.
    let mut ratios: Vec<([f32; 3], f32)> = Vec::new();
    for (i, list) in sightings.iter().enumerate() {
        let Some(s) = list.iter().find(|s| s.view == view) else { continue };
        place[i] = seen.len() as u32;
        seen.push(i as u32);
        let own = scaled(s.color, s.factor);
        let others: f32 = list.iter().filter(|o| o.view != view).map(|o| o.broad).sum();
        let ratio = std::array::from_fn(|k| (colors[i][k].max(DARK) / own[k].max(DARK)).ln());
        ratios.push((ratio, others * s.broad / (others + s.broad)));
    }
    let links: Vec<Vec<u32>> = seen
        .iter()
        .map(|&i| around[i as usize].iter().map(|&j| place[j as usize]).filter(|p| *p != u32::MAX).collect())
        .collect();
    let mut values: Vec<([f32; 3], f32)> = ratios.iter().map(|(r, w)| (r.map(|v| v * w), *w)).collect();
    for _ in 0..SWEEPS {
        values = (0..values.len())
            .map(|i| {
                let share = 1.0 / (1.0 + links[i].len() as f32);
                let start = values[i];
                let sum = links[i].iter().fold(start, |(sum, weight), &j| {
                    let (v, w) = values[j as usize];
                    (std::array::from_fn(|k| sum[k] + v[k]), weight + w)
                });
                (sum.0.map(|v| v * share), sum.1 * share)
            })
            .collect();
    }
    let factor = |(sum, weight): ([f32; 3], f32)| {
        // Where hardly anyone else was near there is nothing to be brought to.
        sum.map(|v| (v / (weight + 1e-3)).exp().clamp(1.0 / MOST, MOST))
    };
    seen.into_iter().zip(values.into_iter().map(factor)).collect()
}

fn neighbours(mesh: &TriMesh, count: usize) -> Vec<Vec<u32>> {
    let mut around: Vec<Vec<u32>> = vec![Vec::new(); count];
    for t in &mesh.triangles {
        for k in 0..3 {
            around[t[k] as usize].push(t[(k + 1) % 3]);
        }
    }
    around
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIDE: u32 = 24;

    fn sheet() -> TriMesh {
        let at = |x: u32, y: u32| y * SIDE + x;
        let cells = (0..SIDE - 1).flat_map(|y| (0..SIDE - 1).map(move |x| (x, y)));
        TriMesh {
            vertices: (0..SIDE * SIDE).map(|i| [(i % SIDE) as f32, (i / SIDE) as f32, 0.0]).collect(),
            triangles: cells
                .flat_map(|(x, y)| {
                    let (a, b, c, d) = (at(x, y), at(x + 1, y), at(x + 1, y + 1), at(x, y + 1));
                    [[a, b, c], [a, c, d]]
                })
                .collect(),
            ..TriMesh::default()
        }
    }

    /// One of three views got a shadow that grows to the right, and a dot that the others don't have.
    #[test]
    fn a_smooth_shadow_goes_and_detail_stays() {
        let sighting = |view, value: f32| Sighting {
            view,
            broad: 1.0,
            detail: 1.0,
            color: [value; 3],
            factor: [1.0; 3],
        };
        let shadow = |i: u32| (-0.02 * (i % SIDE) as f32).exp();
        let dot = SIDE * 12 + 12;
        let mut sightings: Vec<Vec<Sighting>> = (0..SIDE * SIDE)
            .map(|i| {
                let own = if i == dot { 180.0 } else { 120.0 } * shadow(i);
                vec![sighting(0, own), sighting(1, 120.0), sighting(2, 120.0)]
            })
            .collect();
        level(&sheet(), &mut sightings, &vec![[120.0; 3]; (SIDE * SIDE) as usize], 3);
        for (i, list) in (0..SIDE * SIDE).zip(&sightings) {
            let inside = (4..SIDE - 4).contains(&(i % SIDE)) && (4..SIDE - 4).contains(&(i / SIDE));
            let levelled = list[0].color[1] * list[0].factor[1];
            if i == dot {
                assert!(levelled > 170.0, "the dot became {levelled}");
            } else if inside {
                assert!((levelled - 120.0).abs() < 4.0, "{i}: {levelled}");
            }
            assert!((list[1].factor[1] - 1.0).abs() < 1e-3);
        }
    }

    #[test]
    fn a_view_that_is_alone_stays_as_it_is() {
        let alone = Sighting { view: 0, broad: 1.0, detail: 1.0, color: [50.0; 3], factor: [1.5; 3] };
        let mut sightings = vec![vec![alone]; (SIDE * SIDE) as usize];
        level(&sheet(), &mut sightings, &vec![[200.0; 3]; (SIDE * SIDE) as usize], 1);
        assert!(sightings.iter().all(|list| list[0].factor == [1.5; 3]));
    }
}
