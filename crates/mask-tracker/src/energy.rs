//! The segmentation energy: one signed preference per cell from every cue, smoothness across edges.

use crate::appearance::{Appearance, Band};
use crate::distance::nearest;
use crate::grid::{Grid, color_distance2, depth_noise};
use crate::maxflow::{GridCut, OFFSETS};
use crate::memory::band;
use crate::propagate::Options;
use crate::surface::{Surface, offset};
use crate::warp::{Layer, color_match};

/// The cues of one frame, all on the same window.
pub(crate) struct Cues<'a> {
    pub(crate) grid: &'a Grid,
    pub(crate) appearance: &'a Appearance,
    /// Object points of the last frame at their predicted place.
    pub(crate) object: &'a Layer,
    /// Background points of the last frame moved as if attached to the object (a hand, a gripper).
    pub(crate) carried: &'a Layer,
    /// Background points of the last frame where they were.
    pub(crate) still: &'a Layer,
    pub(crate) surface: Option<&'a Surface>,
    /// What the space around the object says of every cell's point, see [`crate::volume::Volume::testimony`].
    pub(crate) space: Option<&'a [f32]>,
    /// After the pose: the model decides where it covers.
    pub(crate) refined: bool,
}

/// Preferences in log-odds, positive = object.
pub(crate) struct Unaries {
    pub(crate) total: Vec<f32>,
    /// What speaks for the cell besides its place: colour, depth, persistence and model.
    pub(crate) evidence: Vec<f32>,
    /// The colour's part of it.
    pub(crate) color: Vec<f32>,
    /// Cells where the warped object is plausible (not occluded, not gone), and others that can only be a part of it
    /// that wasn't in view.
    pub(crate) predicted: Vec<bool>,
    /// 0..1: how long the cell's point has been seen as background, where it still looks like that.
    pub(crate) held: Vec<f32>,
}

/// Background that has been seen for longer than this (0..1) is certain to be background.
pub(crate) const KNOWN: f32 = 0.7;
/// Weighted colour log-likelihood ratio that only the object's own colours reach.
const SURE_COLOR: f32 = 1.5;
/// Cells within which a part cut off from the object is looked for.
const BESIDE: f32 = 12.0;
const LOG_ODDS_SCALE: f32 = 64.0;

/// Weighs all cues.
pub(crate) fn unaries(cues: &Cues<'_>, options: &Options, focal: f32) -> Unaries {
    let grid = cues.grid;
    let n = grid.window.len();
    let predicted: Vec<bool> = (0..n).map(|i| plausible(cues, options, i)).collect();
    let to_object = nearest(grid.window.w, grid.window.h, |i| predicted[i]);
    let to_outside = nearest(grid.window.w, grid.window.h, |i| !predicted[i]);
    let mut all = Unaries {
        total: Vec::with_capacity(n),
        evidence: Vec::with_capacity(n),
        color: Vec::with_capacity(n),
        predicted: predicted.clone(),
        held: Vec::with_capacity(n),
    };
    for i in 0..n {
        let reference = reference(cues, to_object.seed[i]);
        let color = color(cues, i, reference);
        let new = is_new(cues, i);
        let mut layering = layering(cues, reference, to_object.distance[i], i, focal);
        let mut place = place(to_object.distance[i], to_outside.distance[i]);
        let (object, background, age) = persistence(cues, i);
        let near = band(grid.depth[i], reference) == Band::Near;
        if new && near && color > 0.0 && age < KNOWN {
            // It may be a part of the object that has come into view: those are where nothing was known.
            layering /= 1.0 + color;
            place *= 0.4;
        }
        if near && color > SURE_COLOR && age < KNOWN && to_object.distance[i] < BESIDE {
            // Nothing else around has this colour: it may be a part that an occluder cuts off from the rest.
            place = place.max(-1.5);
        }
        let model =
            cues.surface.map_or(0.0, |s| testimony(s, grid.depth[i], i, cues.refined, color, options));
        let space = cues.space.map_or(0.0, |s| s[i]) * if cues.refined { 1.0 } else { 0.6 };
        // What has the colours of the hand may have been taken for the object before: being where the object was
        // seen to be then speaks for less.
        let memory = object + model + space;
        let doubt = (1.0 - 0.5 * object) * color / 3.0;
        let memory = if memory > 0.0 { memory * (1.0 + doubt).clamp(0.2, 1.0) } else { memory };
        let e = color + layering - background + memory;
        all.evidence.push(e);
        all.color.push(color);
        all.total.push(e + place);
        all.held.push(age);
        all.predicted[i] |= new && near && color > 0.5 && layering > -0.5 && space > -0.5;
    }
    all
}

/// Weighted colour log-likelihood ratio of a cell whose neighbouring object lies at depth `reference`.
fn color(cues: &Cues<'_>, i: usize, reference: f32) -> f32 {
    let band = band(cues.grid.depth[i], reference);
    let weight = 0.35 + 0.65 * cues.appearance.reliability(band);
    weight * cues.appearance.log_ratio(cues.grid.color[i], band)
}

/// Depth of the predicted object at the cell `seed`, 0 if unknown.
fn reference(cues: &Cues<'_>, seed: u32) -> f32 {
    let seed = seed as usize;
    match (cues.object.measured.get(seed), cues.surface) {
        (Some(true), _) => cues.object.depth[seed],
        (Some(false), Some(surface)) => surface.near[seed],
        _ => 0.0,
    }
}

/// The cell shows something that wasn't in view in the last frame, neither where it is nor moved along with the
/// object: a part of the object that has come into view, or something that has come between.
fn is_new(cues: &Cues<'_>, i: usize) -> bool {
    let z = cues.grid.depth[i];
    let explains =
        |layer: &Layer| layer.measured[i] && (z - layer.depth[i]).abs() < 0.006 + 3.0 * depth_noise(z);
    z > 0.0 && !explains(cues.still) && !explains(cues.carried)
}

/// The predicted object is possible at `i`: the observed depth is neither an occluder's nor the background's, and a
/// point that was hidden has come back into view. The model predicts too, where the depth image confirms it.
fn plausible(cues: &Cues<'_>, options: &Options, i: usize) -> bool {
    let z = cues.grid.depth[i];
    if z > 0.0
        && let Some(surface) = cues.surface
        && surface.near[i] > 0.0
        && surface.weight > 0.5
        && offset(z, surface.near[i], surface.far[i]).abs() < options.in_front
        && color(cues, i, z) > -1.0
    {
        return true;
    }
    let predicted = cues.object.depth[i];
    if predicted <= 0.0 {
        return false;
    }
    let slack = 2.0 * depth_noise(predicted);
    let known = z > 0.0 && cues.object.measured[i];
    if known && (z < predicted - options.in_front - slack || z > predicted + options.behind + slack) {
        return false;
    }
    cues.object.hidden[i] == 0 || (known && color_match(cues.object.color[i], cues.grid.color[i]) > 0.4)
}

/// From the warped mask: undecided at its outline, sure far from it.
fn place(to_object: f32, to_outside: f32) -> f32 {
    if to_object == 0.0 {
        (0.35 * to_outside).min(1.4)
    } else {
        -(0.25 * to_object + 0.03 * to_object * to_object).min(8.0)
    }
}

/// Depth against the nearest predicted object cell: far in front or behind is something else, and the tolerance
/// grows with the distance over which the surface had to be continued.
fn layering(cues: &Cues<'_>, reference: f32, distance: f32, i: usize, focal: f32) -> f32 {
    let z = cues.grid.depth[i];
    if z <= 0.0 || reference <= 0.0 {
        return 0.0;
    }
    let reach = distance * cues.grid.window.step as f32 * z / focal;
    let tolerance = 0.012 + 3.0 * depth_noise(z) + 1.2 * reach;
    let excess = ((z - reference).abs() - tolerance) / tolerance;
    -4.0 * excess.clamp(0.0, 1.0)
}

/// Cells that look as predicted keep their label: the object's points moved with it, the background's either stayed
/// or moved along (what holds the object). The preferences for object and for background, and how long what is seen
/// here has been background.
fn persistence(cues: &Cues<'_>, i: usize) -> (f32, f32, f32) {
    let likeness = |layer: &Layer| {
        if layer.depth[i] <= 0.0 {
            return 0.0;
        }
        let z = cues.grid.depth[i];
        let color = color_match(layer.color[i], cues.grid.color[i]);
        let depth = if z > 0.0 && layer.measured[i] {
            let r = (z - layer.depth[i]) / (0.006 + 2.0 * depth_noise(z));
            1.0 / (1.0 + r * r)
        } else if z > 0.0 || layer.measured[i] {
            0.4
        } else {
            0.7
        };
        color * depth
    };
    let object = likeness(cues.object) * cues.object.trust[i];
    let (carried, still) = (likeness(cues.carried), likeness(cues.still));
    let (carried_age, still_age) = (cues.carried.trust[i], cues.still.trust[i]);
    let age = |likeness: f32, trust: f32| if likeness > 0.5 { trust } else { 0.0 };
    let background = (carried * carried_age).max(0.8 * still * still_age);
    (2.0 * object, 1.2 * background, age(carried, carried_age).max(age(still, still_age)))
}

/// The model's word on a cell that it covers.
fn testimony(surface: &Surface, z: f32, i: usize, refined: bool, color: f32, options: &Options) -> f32 {
    let (near, far) = (surface.near[i], surface.far[i]);
    if near <= 0.0 {
        return 0.0;
    }
    let strength = surface.weight * if refined { 1.0 } else { 0.6 };
    if z <= 0.0 {
        return 0.7 * strength;
    }
    let d = offset(z, near, far);
    let slack = depth_noise(z);
    let front = options.in_front + slack;
    let behind = options.behind + slack;
    if d < 0.0 {
        // In front of the surface seen so far there is an occluder, or, if it has the object's colours, a part of
        // the object that has turned into view.
        let against = if color > 0.0 { 5.5 - 3.0 * color.min(1.0) } else { 5.5 };
        strength * (2.5 - against * ((-d - 0.5 * front) / front).clamp(0.0, 1.0))
    } else {
        strength * (2.5 - 6.5 * ((d - 0.4 * behind) / (0.8 * behind)).clamp(0.0, 1.0))
    }
}

/// Minimises the energy exactly; `true` = object.
///
/// A cell whose own preference outweighs all its edges together keeps it in every minimum. Such a cell leaves the
/// graph and its edges become preferences of its neighbours, which may settle them in turn; the maximum flow only
/// decides the few cells that remain.
pub(crate) fn cut(grid: &Grid, edges: &[[i32; 8]], unaries: &[f32]) -> Vec<bool> {
    let (w, h) = (grid.window.w, grid.window.h);
    let mut incident: Vec<i32> = edges.iter().map(|e| e.iter().sum()).collect();
    let mut unary: Vec<i32> =
        unaries.iter().map(|u| (u.clamp(-30.0, 30.0) * LOG_ODDS_SCALE) as i32).collect();
    // Edges that would leave the grid weigh nothing, so that their far end is never looked at.
    let steps = OFFSETS.map(|(dx, dy)| dy as isize * w as isize + dx as isize);
    let neighbour = |i: usize, d: usize| (edges[i][d] > 0).then(|| (i as isize + steps[d]) as usize);
    let mut settled: Vec<bool> = (0..w * h).map(|i| unary[i].abs() > incident[i]).collect();
    let mut queue: Vec<usize> = (0..w * h).filter(|&i| settled[i]).collect();
    while let Some(i) = queue.pop() {
        let label = unary[i].signum();
        for d in 0..8 {
            let Some(j) = neighbour(i, d).filter(|&j| !settled[j]) else { continue };
            unary[j] += edges[i][d] * label;
            incident[j] -= edges[i][d];
            if unary[j].abs() > incident[j] {
                settled[j] = true;
                queue.push(j);
            }
        }
    }
    let mut graph = GridCut::new(w, h);
    for i in (0..w * h).filter(|&i| !settled[i]) {
        graph.set_unary(i % w, i / w, unary[i]);
        for d in 4..8 {
            if let Some(j) = neighbour(i, d)
                && !settled[j]
            {
                graph.set_edge(i % w, i / w, d, edges[i][d]);
            }
        }
    }
    let mut labels = graph.solve();
    for i in (0..w * h).filter(|&i| settled[i]) {
        labels[i] = unary[i] > 0;
    }
    labels
}

/// Costs of a boundary between every cell and its eight neighbours, 0 out of the grid.
pub(crate) fn edges(grid: &Grid, smoothness: f32) -> Vec<[i32; 8]> {
    let (w, h) = (grid.window.w, grid.window.h);
    let contrast = mean_contrast(grid);
    let mut edges = vec![[0i32; 8]; w * h];
    for y in 0..h {
        for x in 0..w {
            let i = y * w + x;
            for d in 4..8 {
                let Some(j) = grid.window.index((x as i32 + OFFSETS[d].0, y as i32 + OFFSETS[d].1)) else {
                    continue;
                };
                let length = if d == 5 || d == 7 { 0.707 } else { 1.0 };
                let weight = (smoothness * length * edge(grid, i, j, contrast) * LOG_ODDS_SCALE) as i32;
                edges[i][d] = weight;
                edges[j][7 - d] = weight;
            }
        }
    }
    edges
}

/// Cost of a boundary between two cells: low across colour edges (Boykov and Jolly 2001) and depth steps.
fn edge(grid: &Grid, i: usize, j: usize, contrast: f32) -> f32 {
    let color = 0.06 + 0.94 * (-color_distance2(grid.color[i], grid.color[j]) / contrast).exp();
    let (a, b) = (grid.depth[i], grid.depth[j]);
    let depth = if a > 0.0 && b > 0.0 {
        let r = (a - b) / (0.006 + 2.0 * depth_noise(a.min(b)));
        1.0 / (1.0 + r * r * r * r)
    } else {
        0.7
    };
    color * depth
}

fn mean_contrast(grid: &Grid) -> f32 {
    let w = grid.window.w;
    let (mut sum, mut count) = (0.0, 0);
    for i in 0..grid.window.len() {
        if (i + 1) % w != 0 && i + 1 < grid.window.len() {
            sum += color_distance2(grid.color[i], grid.color[i + 1]);
            count += 1;
        }
    }
    (2.0 * sum / count.max(1) as f32).clamp(40.0, 1500.0)
}

/// Drops components that neither touch the prediction nor are a fair part of the object.
pub(crate) fn keep_connected(labels: &mut [bool], predicted: &[bool], w: usize, h: usize) {
    let mut component = vec![u32::MAX; labels.len()];
    let mut sizes: Vec<(usize, usize)> = Vec::new();
    let mut stack = Vec::new();
    for start in 0..labels.len() {
        if !labels[start] || component[start] != u32::MAX {
            continue;
        }
        let id = sizes.len() as u32;
        let (mut size, mut overlap) = (0, 0);
        component[start] = id;
        stack.push(start);
        while let Some(i) = stack.pop() {
            size += 1;
            overlap += usize::from(predicted[i]);
            let (x, y) = (i % w, i / w);
            let mut visit = |j: usize| {
                if labels[j] && component[j] == u32::MAX {
                    component[j] = id;
                    stack.push(j);
                }
            };
            if x > 0 {
                visit(i - 1);
            }
            if x + 1 < w {
                visit(i + 1);
            }
            if y > 0 {
                visit(i - w);
            }
            if y + 1 < h {
                visit(i + w);
            }
        }
        sizes.push((size, overlap));
    }
    let largest = sizes.iter().map(|s| s.1).max().unwrap_or(0);
    let keep: Vec<bool> =
        sizes.iter().map(|&(size, overlap)| overlap * 3 >= size && size * 50 >= largest).collect();
    for (label, &c) in labels.iter_mut().zip(&component) {
        *label = *label && keep[c as usize];
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::Window;
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(40))]
        #[test]
        fn settling_cells_first_keeps_the_minimum(
            unaries in prop::collection::vec(-4.0f32..4.0, 63),
            luma in prop::collection::vec(0.0f32..60.0, 63),
        ) {
            let window = Window { x0: 0, y0: 0, step: 1, w: 9, h: 7 };
            let color: Vec<_> = luma.iter().map(|&y| [y, 0.0, 0.0]).collect();
            let grid = Grid { window, color, depth: vec![0.0; 63] };
            let contrast = mean_contrast(&grid);
            let mut graph = GridCut::new(9, 7);
            let mut weights = Vec::new();
            for i in 0..63usize {
                graph.set_unary(i % 9, i / 9, (unaries[i] * LOG_ODDS_SCALE) as i32);
                for d in 4..8 {
                    let at = ((i % 9) as i32 + OFFSETS[d].0, (i / 9) as i32 + OFFSETS[d].1);
                    let Some(j) = window.index(at) else { continue };
                    let length = if d == 5 || d == 7 { 0.707 } else { 1.0 };
                    let weight = (1.5 * length * edge(&grid, i, j, contrast) * LOG_ODDS_SCALE) as i32;
                    graph.set_edge(i % 9, i / 9, d, weight);
                    weights.push((i, j, weight));
                }
            }
            let energy = |labels: &[bool]| {
                let unary: i32 = (0..63)
                    .map(|i| (unaries[i] * LOG_ODDS_SCALE) as i32)
                    .zip(labels)
                    .map(|(u, &l)| if l { -u } else { u })
                    .sum();
                let cut: i32 = weights.iter().filter(|(i, j, _)| labels[*i] != labels[*j]).map(|e| 2 * e.2).sum();
                unary + cut
            };
            prop_assert_eq!(energy(&cut(&grid, &edges(&grid, 1.5), &unaries)), energy(&graph.solve()));
        }
    }
}
