//! The matches of a dense edge: the blocks of eight that residuals are summed from.

use crate::cloud::{Cloud, Samples};
use crate::lanes::{Block, Lane, Placement, dot};
use crate::options::{Gates, SolveOptions};
use crate::search::Found;
use crate::simd::Vector;
use crate::transform::Rigid;

/// Matches of one dense edge under its current association.
#[derive(Debug, Default)]
pub(crate) struct Matches {
    /// Source points relative to `source_centre`, target points relative to `target_centre`. A block for every eight
    /// samples; samples without a match are zero.
    blocks: Vec<Block>,
    count: usize,
    /// Sum over the matches of the squared difference of the two normals.
    disagreement: f64,
    pub(crate) source_centre: [f32; 3],
    pub(crate) target_centre: [f32; 3],
    /// Depth noise `a + b z^2`: a and b.
    noise: [f32; 2],
}

impl Matches {
    /// Drops all matches.
    pub(crate) fn clear(&mut self) {
        self.blocks.clear();
        (self.count, self.disagreement) = (0, 0.0);
    }

    /// Matches that are searched from now on are stored relative to these centres.
    pub(crate) fn set_centres(
        &mut self,
        source_centre: [f32; 3],
        target_centre: [f32; 3],
        options: &SolveOptions,
    ) {
        self.source_centre = source_centre;
        self.target_centre = target_centre;
        self.noise = [options.depth_sigma_constant as f32, options.depth_sigma_quadratic as f32];
    }

    pub(crate) fn blocks(&self) -> &[Block] {
        &self.blocks
    }

    /// Samples that found a match.
    pub(crate) fn count(&self) -> usize {
        self.count
    }

    /// Variance of a plane's normal in one tangential direction, radians squared: that of the bisector of two normals
    /// that differ as the matched ones do.
    pub(crate) fn normal_variance(&self) -> f64 {
        // Four errors, two of each normal, make up the difference; the bisector has half of one's variance.
        self.disagreement / (8.0 * f64::max(self.count as f64, 1.0))
    }

    /// Finds the best match of every sample that these gates ask for.
    #[inline(always)]
    pub(crate) fn search<V: Vector>(
        &mut self,
        transform: &Rigid<f32>,
        (source, target): (&Cloud<'_>, &Cloud<'_>),
        gates: &Gates,
    ) {
        let (samples, _) = source.samples(gates);
        let placement = Placement::<V>::new(transform);
        self.blocks.resize(samples.len(), Block::default());
        (self.count, self.disagreement) = (0, 0.0);
        let centres = (self.source_centre, self.target_centre);
        for (samples, block) in samples.iter().zip(&mut self.blocks) {
            let found = target.find(&placement, samples, gates);
            self.disagreement += fill::<V>(block, samples, &found, centres, self.noise);
            self.count += block.weight.iter().map(|w| usize::from(*w > 0.0)).sum::<usize>();
        }
    }
}

/// The plane's normal is the bisector of both normals, the weight 1 / variance of both depths. Lanes without a match
/// become zero. Returns the sum of the squared differences of the normals.
#[inline(always)]
fn fill<V: Vector>(
    block: &mut Block,
    samples: &Samples,
    found: &Found<Lane>,
    (source_centre, target_centre): ([f32; 3], [f32; 3]),
    [a, b]: [f32; 2],
) -> f64 {
    let (zero, one, none) = (V::splat(0.0), V::splat(1.0), V::splat(f32::INFINITY));
    let (source, q) = (V::load3(&samples.point), V::load3(&found.q));
    let (m, n) = (V::load3(&found.m), V::load3(&found.n));
    let (variance, sigma) = (V::load(&samples.variance), V::splat(a) + V::splat(b) * q[2] * q[2]);
    let weight = one / (variance + sigma * sigma);
    let weight = V::if_less(weight, none, V::if_less(zero, variance, weight, zero), zero);
    let weight = V::if_less(V::load(&found.score), none, weight, zero);
    let sum = [m[0] + n[0], m[1] + n[1], m[2] + n[2]];
    // Two unit vectors that are less than a right angle apart have a sum of more than one.
    let inverse = one / dot(sum, sum).max(V::splat(0.5)).sqrt();
    for k in 0..3 {
        let (source, target) = (source[k] - V::splat(source_centre[k]), q[k] - V::splat(target_centre[k]));
        block.source[k] = V::if_less(zero, weight, source, zero).lane();
        block.target[k] = V::if_less(zero, weight, target, zero).lane();
        block.normal[k] = V::if_less(zero, weight, sum[k] * inverse, zero).lane();
    }
    block.weight = weight.lane();
    let difference = [m[0] - n[0], m[1] - n[1], m[2] - n[2]];
    V::if_less(zero, weight, dot(difference, difference), zero).total()
}
