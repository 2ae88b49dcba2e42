//! The data of one tile of the training step: a few rays with all their samples.
//!
//! Everything is feature-major (`[feature][lane]`), a lane is a sample, lane `l` belongs to ray `l % RAYS`. The
//! last `central` lanes are the samples around the measured depth: only they run the colour network and the
//! eikonal term.

use crate::clock::Clock;
use crate::grid::Grid;
use crate::mlp::Networks;
use crate::real::Real;

/// Rays per tile. Four rays of 32 samples keep a hidden layer in the first-level cache.
pub(crate) const RAYS: usize = 4;

/// What the network is at one step.
pub(crate) struct Model<'a, R> {
    pub(crate) grid: &'a Grid<R>,
    pub(crate) networks: &'a Networks,
    pub(crate) weights: &'a [R],
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
    pub(crate) pos: Vec<R>,
    /// `[feature][lane]`.
    pub(crate) enc: Vec<R>,
    pub(crate) has_eikonal: bool,
    /// Eikonal: the encoding slope's gradient at a central lane is `v[feature] * gamma[axis]`.
    pub(crate) gamma: Vec<R>,
    pub(crate) v: Vec<R>,
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
            pos: vec![R::ZERO; 3 * lanes],
            enc: vec![R::ZERO; e * lanes],
            has_eikonal: false,
            gamma: vec![R::ZERO; 3 * central],
            v: vec![R::ZERO; e * central],
            frame: [0; RAYS],
            twist: [[R::ZERO; 6]; RAYS],
            losses: [R::ZERO; loss::COUNT],
        }
    }
}

/// Activations of one tile, allocated once per worker.
#[derive(Clone, Debug)]
pub(crate) struct Scratch<R> {
    pub(crate) enc: Vec<R>,
    pub(crate) jac: Vec<R>,
    pub(crate) hidden: Vec<R>,
    pub(crate) d_hidden: Vec<R>,
    pub(crate) sdf: Vec<R>,
    pub(crate) d_sdf: Vec<R>,
    pub(crate) color_in: Vec<R>,
    pub(crate) d_color_in: Vec<R>,
    pub(crate) color_a: Vec<R>,
    pub(crate) color_b: Vec<R>,
    pub(crate) d_color_a: Vec<R>,
    pub(crate) d_color_b: Vec<R>,
    pub(crate) rgb: Vec<R>,
    pub(crate) transposed: Vec<R>,
    pub(crate) masked: Vec<R>,
    pub(crate) q: Vec<R>,
    pub(crate) d_pos: Vec<R>,
    pub(crate) clock: Clock,
}

impl<R: Real> Scratch<R> {
    pub(crate) fn new(lanes: usize, central: usize, networks: &Networks) -> Self {
        let zeros = |n: usize| vec![R::ZERO; n];
        let (e, h) = (networks.encoding(), networks.hidden());
        let c = networks.color[0].inputs;
        Self {
            enc: zeros(e * lanes),
            jac: zeros(e * 3 * lanes),
            hidden: zeros(h * lanes),
            d_hidden: zeros(h * lanes),
            sdf: zeros(lanes),
            d_sdf: zeros(lanes),
            color_in: zeros(c * central),
            d_color_in: zeros(c * central),
            color_a: zeros(h * central),
            color_b: zeros(h * central),
            d_color_a: zeros(h * central),
            d_color_b: zeros(h * central),
            rgb: zeros(3 * central),
            transposed: zeros(h.max(e).max(c) * lanes),
            masked: zeros(h * central),
            q: zeros(e * central),
            d_pos: zeros(3 * lanes),
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

    /// Colours `[channel][lane]` after [`query_color`].
    pub(crate) fn colors(&self) -> &[R] {
        &self.rgb
    }
}
