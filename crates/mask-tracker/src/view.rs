//! A frame beside the last one: what both passes have in common.

use nalgebra::Isometry3;

use crate::appearance::{Appearance, Band, Bin};
use crate::cut::Edges;
use crate::grid::{Camera, Grid, depth_noise};
use crate::propagate::Options;
use crate::warp::{Layer, Sample, color_match};

/// The frame's cells and what the last frame's samples say of them, once these have been moved.
pub(crate) struct View {
    pub(crate) grid: Grid,
    pub(crate) edges: Edges,
    pub(crate) bins: Vec<Bin>,
    /// Weighted colour log-likelihood ratio, by [`Band`].
    pub(crate) color: [Vec<f32>; 2],
    /// Object samples of the last frame at their predicted place.
    pub(crate) object: Layer,
    /// The object's depth there, 0 where it wasn't measured.
    pub(crate) object_depth: Vec<f32>,
    /// The object is drawn here and was in view in the last frame.
    pub(crate) in_view: Vec<bool>,
    /// The moved object is possible here: what is seen is neither in front of it nor behind it, and a point that was
    /// hidden has come back into view.
    pub(crate) plausible: Vec<bool>,
    pub(crate) habit: Vec<Habit>,
}

/// Cells that look as predicted keep their label: the object's points moved with it, the background's either stayed
/// or moved along (what holds the object).
#[derive(Clone, Copy, Default)]
pub(crate) struct Habit {
    /// Preference for object, 0..2.
    pub(crate) object: f32,
    /// Preference for background, 0..1.2.
    pub(crate) background: f32,
    /// 0..1: how long the cell's point has been seen as background, where it still looks like that.
    pub(crate) held: f32,
    /// It shows something that wasn't in view in the last frame, neither where it is nor moved along with the object:
    /// a part of the object that has come into view, or something that has come between.
    pub(crate) is_new: bool,
}

/// Samples of the last frame, and how they have moved since.
pub(crate) struct Moved<'a> {
    pub(crate) samples: &'a [Sample],
    pub(crate) motion: &'a Isometry3<f32>,
    pub(crate) camera: &'a Camera,
    /// Cells that each sample covers.
    pub(crate) footprint: i32,
}

impl View {
    pub(crate) fn new(
        grid: Grid,
        bins: Vec<Bin>,
        last: &Moved<'_>,
        appearance: &Appearance,
        options: &Options,
    ) -> Self {
        let Moved { samples, motion, camera, footprint } = *last;
        let window = &grid.window;
        let draw = |object: bool, motion: &Isometry3<f32>| {
            Layer::draw(samples, |s| s.object == object, motion, camera, window, footprint)
        };
        let object = draw(true, motion);
        let (carried, still) = (draw(false, motion), draw(false, &Isometry3::identity()));
        let color = [Band::Near, Band::Far].map(|band| {
            let weight = 0.35 + 0.65 * appearance.reliability(band);
            bins.iter().map(|&c| weight * appearance.log_ratio(c, band)).collect()
        });
        let n = window.len();
        let mut object_depth = vec![0.0; n];
        let mut in_view = vec![false; n];
        let mut plausible = vec![false; n];
        let mut habit = Vec::with_capacity(n);
        for i in 0..n {
            let sample = object.sample(samples, i);
            if let Some(s) = sample {
                let depth = object.depth[i];
                object_depth[i] = if s.measured { depth } else { 0.0 };
                in_view[i] = s.hidden == 0;
                plausible[i] = is_plausible(&grid, i, s, depth, options);
            }
            let [object, carried, still] = [(&object, sample), (&carried, None), (&still, None)]
                .map(|(layer, known)| likeness(&grid, i, layer, known.or_else(|| layer.sample(samples, i))));
            habit.push(Habit::new(grid.depth[i], object, carried, still));
        }
        let edges = Edges::new(&grid, options.smoothness);
        Self { grid, edges, bins, color, object, object_depth, in_view, plausible, habit }
    }
}

/// The predicted object is possible at cell `i`, on which sample `s` fell at `predicted` depth.
fn is_plausible(grid: &Grid, i: usize, s: &Sample, predicted: f32, options: &Options) -> bool {
    let z = grid.depth[i];
    let slack = 2.0 * depth_noise(predicted);
    let known = z > 0.0 && s.measured;
    if known && (z < predicted - options.in_front - slack || z > predicted + options.behind + slack) {
        return false;
    }
    s.hidden == 0 || (known && color_match(s.color, grid.color(i)) > 0.4)
}

/// How much a cell looks like the sample that was drawn there.
#[derive(Clone, Copy, Default)]
struct Likeness {
    /// 0..1.
    value: f32,
    trust: f32,
    /// At the depth of the sample.
    level: bool,
}

#[inline]
fn likeness(grid: &Grid, i: usize, layer: &Layer, sample: Option<&Sample>) -> Likeness {
    let Some(s) = sample else { return Likeness::default() };
    let z = grid.depth[i];
    let color = color_match(s.color, grid.color(i));
    let apart = z - layer.depth[i];
    let noise = depth_noise(z);
    let depth = if z > 0.0 && s.measured {
        let r = apart / (0.006 + 2.0 * noise);
        1.0 / (1.0 + r * r)
    } else if z > 0.0 || s.measured {
        0.4
    } else {
        0.7
    };
    let level = s.measured && apart.abs() < 0.006 + 3.0 * noise;
    Likeness { value: color * depth, trust: s.trust, level }
}

impl Habit {
    fn new(z: f32, object: Likeness, carried: Likeness, still: Likeness) -> Self {
        let held = |l: Likeness| if l.value > 0.5 { l.trust } else { 0.0 };
        let background = (carried.value * carried.trust).max(0.8 * still.value * still.trust);
        Self {
            object: 2.0 * object.value * object.trust,
            background: 1.2 * background,
            held: held(carried).max(held(still)),
            is_new: z > 0.0 && !carried.level && !still.level,
        }
    }
}
