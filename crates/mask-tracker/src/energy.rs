//! The segmentation energy: one signed preference per cell from every cue.

use crate::appearance::Band;
use crate::distance::nearest;
use crate::grid::depth_noise;
use crate::memory::band;
use crate::propagate::Options;
use crate::surface::{Surface, offset};
use crate::view::View;
use crate::volume;

/// The cues of one pass, all on the same window.
pub(crate) struct Cues<'a> {
    pub(crate) view: &'a View,
    pub(crate) surface: Option<&'a Surface>,
    /// What the space around the object says of every cell's point, see [`crate::volume::Volume::testimony`].
    pub(crate) space: Option<&'a [f32]>,
    /// How far the pose can be trusted, 0..1.
    pub(crate) confidence: f32,
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
}

/// Background that has been seen for longer than this (0..1) is certain to be background.
pub(crate) const KNOWN: f32 = 0.7;

/// Weighs all cues.
pub(crate) fn unaries(cues: &Cues<'_>, options: &Options, focal: f32) -> Unaries {
    let View { grid, habit, .. } = cues.view;
    let n = grid.window.len();
    let mut predicted: Vec<bool> = (0..n).map(|i| plausible(cues, options, i)).collect();
    let to_object = nearest(grid.window.w, grid.window.h, |i| predicted[i]);
    let to_outside = nearest(grid.window.w, grid.window.h, |i| !predicted[i]);
    let (mut total, mut evidence, mut colors) =
        (Vec::with_capacity(n), Vec::with_capacity(n), Vec::with_capacity(n));
    let pixel = grid.window.step as f32 / focal;
    let trust_in_space = cues.confidence * if cues.refined { 1.0 } else { 0.75 };
    for i in 0..n {
        let (z, habit) = (grid.depth[i], habit[i]);
        let reference = reference(cues, to_object.seed[i]);
        let near = band(z, reference) == Band::Near;
        let color = cues.view.color[usize::from(!near)][i];
        let space = cues.space.map_or(0.0, |s| s[i]) * trust_in_space;
        let mut layering = layering(z, reference, to_object.distance[i] * pixel);
        let mut place = place(to_object.distance[i], to_outside.distance[i]);
        if near && color > 0.0 && habit.held < KNOWN && space > -0.5 {
            // It may be a part of the object that has come into view, now or a while ago: those are where nothing
            // else is known to be.
            layering /= 1.0 + color;
            place *= 0.4;
        }
        let model = cues.surface.map_or(0.0, |s| testimony(s, z, i, cues.refined, color, options));
        // What has the colours of the hand may have been taken for the object before: being where the object was
        // seen to be then speaks for less, unless it was long seen there or already in the first frame.
        let memory = habit.object + model + space;
        let certain = (0.5 * habit.object).max(space / volume::MOST_FOR_OBJECT);
        let doubt = (1.0 - certain) * color / 3.0;
        let memory = if memory > 0.0 { memory * (1.0 + doubt).clamp(0.2, 1.0) } else { memory };
        let e = color + layering - habit.background + memory;
        evidence.push(e);
        colors.push(color);
        total.push(e + place);
        predicted[i] |= habit.is_new && near && color > 0.5 && layering > -0.5 && space > -0.5;
    }
    Unaries { total, evidence, color: colors, predicted }
}

/// Depth of the predicted object at the cell `seed`, 0 if unknown.
fn reference(cues: &Cues<'_>, seed: u32) -> f32 {
    match (cues.view.object_depth.get(seed as usize), cues.surface) {
        (Some(z), _) if *z > 0.0 => *z,
        (Some(_), Some(surface)) => surface.near[seed as usize],
        _ => 0.0,
    }
}

/// The predicted object is possible at `i`. The model predicts too, where the depth image confirms it.
fn plausible(cues: &Cues<'_>, options: &Options, i: usize) -> bool {
    let z = cues.view.grid.depth[i];
    cues.view.plausible[i]
        || cues.surface.is_some_and(|surface| {
            z > 0.0
                && surface.near[i] > 0.0
                && surface.weight > 0.5
                && offset(z, surface.near[i], surface.far[i]).abs() < options.in_front
                && cues.view.color[Band::Near as usize][i] > -1.0
        })
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
/// grows with the distance over which the surface had to be continued (`distance`, metres at a depth of one).
fn layering(z: f32, reference: f32, distance: f32) -> f32 {
    if z <= 0.0 || reference <= 0.0 {
        return 0.0;
    }
    let tolerance = 0.012 + 3.0 * depth_noise(z) + 1.2 * distance * z;
    let excess = ((z - reference).abs() - tolerance) / tolerance;
    -4.0 * excess.clamp(0.0, 1.0)
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
