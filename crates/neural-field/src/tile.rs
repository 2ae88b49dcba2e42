//! The data of one tile of the training step: a few rays with all their samples.
//!
//! A lane is a sample, lane `l` belongs to ray `l % RAYS`. The last `central` lanes are the samples around the measured
//! depth: only they run the colour network and the eikonal term.
//!
//! The geometry network works on panels of lanes, feature-major (`[feature][lane]`): its layers are narrow on one side,
//! and a vector of lanes is always full. The colour network is wide on both sides and lane-major (`[lane][feature]`):
//! with the gradients by its outputs and its inputs in the same order, that by its weights needs no transpose.

use crate::clock::Clock;
use crate::grid::Grid;
use crate::mlp::Networks;
use crate::real::Real;
use std::ops::{Deref, DerefMut, Range};

/// Rays per tile.
pub(crate) const RAYS: usize = 4;

/// Most lanes of a panel, and the stride of its rows. The panel's hidden layer and its gradient fit the first-level cache
/// together.
pub(crate) const PANEL: usize = 32;

/// Numbers of lanes are multiples of this.
pub(crate) const VECTOR: usize = 16;

/// Some neighbouring lanes, of which each feature is a row of [`PANEL`] numbers.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Panel {
    /// Place among the panels of the tile.
    index: usize,
    pub(crate) start: usize,
    pub(crate) width: usize,
}

impl Panel {
    /// Cuts lanes into panels: the central lanes, which are the last, begin a new one.
    pub(crate) fn all(lanes: usize, central: usize) -> impl Iterator<Item = Self> {
        Self::free(lanes, central).chain(Self::central(lanes, central))
    }

    /// The panels of the lanes before the central ones.
    pub(crate) fn free(lanes: usize, central: usize) -> impl Iterator<Item = Self> {
        Self::cut(0, 0, lanes - central)
    }

    /// The panels of the central lanes.
    pub(crate) fn central(lanes: usize, central: usize) -> impl Iterator<Item = Self> {
        let from = lanes - central;
        Self::cut(from.div_ceil(PANEL), from, lanes)
    }

    fn cut(index: usize, from: usize, to: usize) -> impl Iterator<Item = Self> {
        (from..to).step_by(PANEL).enumerate().map(move |(i, start)| Self {
            index: index + i,
            start,
            width: PANEL.min(to - start),
        })
    }

    /// Where the panel is in a buffer with `rows` rows a panel.
    pub(crate) fn of(self, rows: usize) -> Range<usize> {
        rows * PANEL * self.index..rows * PANEL * (self.index + 1)
    }

    /// Where the panel is in a buffer of the central lanes' panels, of which the first lane is `from`.
    pub(crate) fn among_central(self, from: usize, rows: usize) -> Range<usize> {
        Self { index: (self.start - from) / PANEL, ..self }.of(rows)
    }

    /// Where its lanes are among others that start with lane `from`, with `features` numbers each.
    pub(crate) fn lanes(self, from: usize, features: usize) -> Range<usize> {
        features * (self.start - from)..features * (self.start - from + self.width)
    }
}

/// What the network is at one step.
pub(crate) struct Model<'a, R> {
    pub(crate) grid: &'a Grid<R>,
    pub(crate) networks: &'a Networks,
    pub(crate) weights: &'a [R],
    /// Transposes of some of the weights, by [`Networks::flip`].
    pub(crate) flipped: &'a [R],
    /// Truncation distance over the edge of the volume: turns a slope per edge into one per metre.
    pub(crate) truncation: R,
}

/// A frame's pose in units of the volume's edge, about the volume's centre.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct RayPose<R> {
    pub(crate) rotation: [[R; 3]; 3],
    pub(crate) translation: [R; 3],
}

/// Index of each loss in [`TileGradient::losses`].
pub(crate) mod loss {
    pub(crate) const UNCERTAIN: usize = 0;
    pub(crate) const EMPTY: usize = 1;
    pub(crate) const SURFACE: usize = 2;
    pub(crate) const COLOR: usize = 3;
    pub(crate) const EIKONAL: usize = 4;
    pub(crate) const COUNT: usize = 5;
}

/// Samples of one tile with their targets. Weights carry the loss weight, the ray's weight and the normalisation;
/// a weight of zero switches a term off.
#[derive(Clone, Debug)]
pub(crate) struct Tile<R> {
    pub(crate) lanes: usize,
    pub(crate) central: usize,
    pub(crate) frame: [usize; RAYS],
    /// Unit directions in the camera frame.
    pub(crate) dir: [[R; 3]; RAYS],
    pub(crate) color: [[R; 3]; RAYS],
    pub(crate) w_color: [R; RAYS],
    /// Distance along the ray, in edges of the volume.
    pub(crate) t: Vec<R>,
    /// Distance in truncation units: what the surface loss asks for, and the least one for the other two.
    pub(crate) target: Vec<R>,
    pub(crate) w_surface: Vec<R>,
    pub(crate) w_empty: Vec<R>,
    pub(crate) w_uncertain: Vec<R>,
    /// Colour weight of each central lane; a ray's sum to 1.
    pub(crate) bell: Vec<R>,
    pub(crate) w_eikonal: Vec<R>,
    pub(crate) has_color: bool,
    pub(crate) has_eikonal: bool,
}

impl<R: Real> Tile<R> {
    pub(crate) fn new(lanes: usize, central: usize) -> Self {
        let zeros = |n| vec![R::ZERO; n];
        Self {
            lanes,
            central,
            frame: [0; RAYS],
            dir: [[R::ZERO; 3]; RAYS],
            color: [[R::ZERO; 3]; RAYS],
            w_color: [R::ZERO; RAYS],
            t: zeros(lanes),
            target: zeros(lanes),
            w_surface: zeros(lanes),
            w_empty: zeros(lanes),
            w_uncertain: zeros(lanes),
            bell: zeros(central),
            w_eikonal: zeros(central),
            has_color: false,
            has_eikonal: false,
        }
    }
}

/// What a tile hands to the reductions that follow: gradients of the encoding (scattered level by level later),
/// of the rays' poses, and its losses.
#[derive(Clone, Debug)]
pub(crate) struct TileGradient<R> {
    pub(crate) lanes: usize,
    pub(crate) central: usize,
    /// `[axis][lane]`, in the unit cube.
    pub(crate) pos: Aligned<R>,
    /// `[feature][lane]`.
    pub(crate) enc: Aligned<R>,
    pub(crate) has_eikonal: bool,
    /// Eikonal: the encoding slope's gradient at a central lane is `v[feature] * gamma[axis]`.
    pub(crate) gamma: Aligned<R>,
    pub(crate) v: Aligned<R>,
    pub(crate) frame: [usize; RAYS],
    /// Gradient by a left perturbation `[rho; phi]` of the ray's pose.
    pub(crate) twist: [[R; 6]; RAYS],
    pub(crate) losses: [R; loss::COUNT],
}

impl<R: Real> TileGradient<R> {
    pub(crate) fn new(lanes: usize, central: usize, networks: &Networks) -> Self {
        let e = networks.encoding();
        Self {
            lanes,
            central,
            pos: Aligned::zeros(3 * lanes),
            enc: Aligned::zeros(e * lanes),
            has_eikonal: false,
            gamma: Aligned::zeros(3 * central),
            v: Aligned::zeros(e * central),
            frame: [0; RAYS],
            twist: [[R::ZERO; 6]; RAYS],
            losses: [R::ZERO; loss::COUNT],
        }
    }
}

/// Numbers that start on a cache line: a vector across two of them costs two loads.
#[derive(Clone, Debug)]
pub(crate) struct Aligned<R> {
    numbers: Vec<R>,
    from: usize,
    len: usize,
}

impl<R: Real> Aligned<R> {
    pub(crate) fn zeros(len: usize) -> Self {
        const LINE: usize = 64;
        let numbers = vec![R::ZERO; len + LINE / size_of::<R>()];
        let from = numbers.as_ptr().align_offset(LINE).min(numbers.len() - len);
        Self { numbers, from, len }
    }
}

impl<R> Deref for Aligned<R> {
    type Target = [R];

    #[inline(always)]
    fn deref(&self) -> &[R] {
        &self.numbers[self.from..self.from + self.len]
    }
}

impl<R> DerefMut for Aligned<R> {
    #[inline(always)]
    fn deref_mut(&mut self) -> &mut [R] {
        &mut self.numbers[self.from..self.from + self.len]
    }
}

/// Activations of one tile, allocated once per worker. What is "by panel" has the panels one after the other, each
/// `[row][lane of the panel]`.
#[derive(Clone, Debug)]
pub(crate) struct Scratch<R> {
    /// Encoding, by panel.
    pub(crate) enc: Aligned<R>,
    /// Its derivatives, by panel, rows `feature * 3 + axis`.
    pub(crate) jac: Aligned<R>,
    /// By panel of the central lanes.
    pub(crate) hidden: Aligned<R>,
    pub(crate) sdf: Aligned<R>,
    pub(crate) d_sdf: Aligned<R>,
    /// `[axis][lane]`.
    pub(crate) d_pos: Aligned<R>,
    /// Geometry features `[lane][padded feature]`, central lanes only.
    pub(crate) color_in: Aligned<R>,
    pub(crate) d_color_in: Aligned<R>,
    pub(crate) color_a: Aligned<R>,
    pub(crate) color_b: Aligned<R>,
    /// By panel of the central lanes.
    pub(crate) rgb: Aligned<R>,
    /// Of one panel.
    pub(crate) panel: PanelScratch<R>,
    pub(crate) sums: TileSums<R>,
    /// `w2[unit] * W1[unit][encoding]`.
    pub(crate) slope_weights: Aligned<R>,
    pub(crate) clock: Clock,
}

/// Buffers of one panel, feature-major where not said otherwise.
#[derive(Clone, Debug)]
pub(crate) struct PanelScratch<R> {
    pub(crate) d_hidden: Aligned<R>,
    pub(crate) d_features: Aligned<R>,
    /// 1 where a hidden unit is active.
    pub(crate) active: Aligned<R>,
    /// Slopes, then their gradients, `[axis][lane]`.
    pub(crate) slope: Aligned<R>,
    /// Something per feature of the encoding, and the same or another in rows of pairs of lanes (`to_pairs`).
    pub(crate) columns: Aligned<R>,
    pub(crate) rows: Aligned<R>,
    /// `[lane][unit]`.
    pub(crate) d_color_a: Aligned<R>,
    pub(crate) d_color_b: Aligned<R>,
    /// Biases of the geometry features, then zeros.
    pub(crate) feature_bias: Aligned<R>,
    /// What the colour network sees beside the features, `[ray][input]`, what its first layer makes of it and its bias,
    /// `[ray][unit]`, and the gradients by both.
    pub(crate) view_in: Aligned<R>,
    pub(crate) view: Aligned<R>,
    pub(crate) d_view: Aligned<R>,
    pub(crate) d_view_in: Aligned<R>,
}

/// Sums over the panels of some tiles that are not in the order of the weights.
#[derive(Clone, Debug)]
pub(crate) struct TileSums<R> {
    /// Per hidden unit, [`VECTOR`] partial sums of the gradients of its bias and of its weight in the distance.
    pub(crate) bias: Aligned<R>,
    pub(crate) head: Aligned<R>,
    /// Gradient of the geometry features' weights, `[unit][padded feature]`.
    pub(crate) features: Aligned<R>,
    /// Gradient of the first layer's weights, `[unit][encoding][2]`: the sum of both parts.
    pub(crate) first: Aligned<R>,
    /// In the same order, sums over the samples in which a hidden unit is active: of the encoding times the distance's
    /// gradient, and of the eikonal's `q`.
    pub(crate) masked: Aligned<R>,
    /// Sums over these samples of the distance's gradient, [`VECTOR`] partial sums per unit.
    pub(crate) masked_bias: Aligned<R>,
}

impl<R: Real> TileSums<R> {
    pub(crate) fn clear(&mut self) {
        self.bias.fill(R::ZERO);
        self.head.fill(R::ZERO);
        self.features.fill(R::ZERO);
        self.first.fill(R::ZERO);
        self.masked.fill(R::ZERO);
        self.masked_bias.fill(R::ZERO);
    }
}

impl<R: Real> Scratch<R> {
    pub(crate) fn new(lanes: usize, central: usize, networks: &Networks) -> Self {
        let zeros = Aligned::zeros;
        let panels = Panel::all(lanes, central).count();
        let (e, h) = (networks.encoding(), networks.hidden());
        let (c, view) = (networks.padded_features(), networks.view_inputs());
        Self {
            enc: zeros(e * PANEL * panels),
            jac: zeros(3 * e * PANEL * panels),
            hidden: zeros(h * PANEL * Panel::all(central, central).count()),
            sdf: zeros(lanes),
            d_sdf: zeros(lanes),
            d_pos: zeros(3 * lanes),
            color_in: zeros(c * central),
            d_color_in: zeros(c * central),
            color_a: zeros(h * central),
            color_b: zeros(h * central),
            rgb: zeros(3 * PANEL * Panel::all(central, central).count()),
            panel: PanelScratch {
                d_hidden: zeros(h * PANEL),
                d_features: zeros(c * PANEL),
                active: zeros(h * PANEL),
                slope: zeros(3 * PANEL),
                columns: zeros(e * PANEL),
                rows: zeros(e * PANEL),
                d_color_a: zeros(h * PANEL),
                d_color_b: zeros(h * PANEL),
                feature_bias: zeros(c),
                view_in: zeros(view * PANEL),
                view: zeros(h * PANEL),
                d_view: zeros(h * RAYS),
                d_view_in: zeros(view * RAYS),
            },
            sums: TileSums {
                bias: zeros(VECTOR * h),
                head: zeros(VECTOR * h),
                features: zeros(h * networks.padded_features()),
                first: zeros(2 * h * e),
                masked: zeros(2 * h * e),
                masked_bias: zeros(VECTOR * h),
            },
            slope_weights: zeros(h * e),
            clock: Clock::default(),
        }
    }
}

impl<R: Real> Scratch<R> {
    /// Distances in truncation units after [`query`].
    pub(crate) fn distances(&self) -> &[R] {
        &self.sdf
    }

    /// Slopes `[axis][lane]` after [`query`].
    pub(crate) fn slopes(&self) -> &[R] {
        &self.d_pos
    }

    /// Colours of the lanes, by channel, after [`query_color`](crate::query::QueryColor).
    pub(crate) fn color(&self, lane: usize) -> [R; 3] {
        let at = 3 * PANEL * (lane / PANEL) + lane % PANEL;
        [self.rgb[at], self.rgb[at + PANEL], self.rgb[at + 2 * PANEL]]
    }
}
