//! The matches of a dense edge: which pixel each sample found, and the blocks of eight that residuals are summed from.

use crate::cloud::{Cloud, Projections, Sample};
use crate::lanes::{Block, LANES, Match};
use crate::options::{Gates, SolveOptions};
use crate::transform::Rigid;

/// Matches of one dense edge under its current association.
#[derive(Debug, Default)]
pub(crate) struct Matches {
    /// Source points relative to `source_centre`, target points relative to `target_centre`.
    blocks: Vec<Block>,
    /// Sample and pixel of each match.
    pairs: Vec<(u32, u32)>,
    pub(crate) source_centre: [f32; 3],
    pub(crate) target_centre: [f32; 3],
    /// Depth noise `a + b z^2`: a and b.
    noise: [f32; 2],
}

impl Matches {
    /// Drops all matches; those that follow are stored relative to these centres.
    pub(crate) fn clear(&mut self, source_centre: [f32; 3], target_centre: [f32; 3], options: &SolveOptions) {
        self.blocks.clear();
        self.pairs.clear();
        self.source_centre = source_centre;
        self.target_centre = target_centre;
        self.noise = [options.depth_sigma_constant as f32, options.depth_sigma_quadratic as f32];
    }

    pub(crate) fn blocks(&self) -> &[Block] {
        &self.blocks
    }

    pub(crate) fn count(&self) -> usize {
        self.pairs.len()
    }

    /// Adds the best match of every `stride`-th sample.
    #[inline(always)]
    pub(crate) fn search(
        &mut self,
        transform: &Rigid<f32>,
        (source, target): (&Cloud<'_>, &Cloud<'_>),
        gates: &Gates,
        stride: usize,
    ) {
        let stride = stride.max(1);
        let mut next = stride / 2;
        while next < source.samples.len() {
            let mut batch = [Sample::default(); LANES];
            let mut indices = [0u32; LANES];
            let mut filled = 0;
            while filled < LANES
                && let Some(sample) = source.samples.get(next)
            {
                (batch[filled], indices[filled]) = (*sample, next as u32);
                filled += 1;
                next += stride;
            }
            let projections = target.project_all(transform, &batch);
            for l in 0..filled {
                self.add_best((indices[l], &batch[l]), &projections, l, target, gates);
            }
        }
        let (depth, noise) = (self.target_centre[2], self.noise);
        self.blocks.iter_mut().for_each(|block| finish(block, depth, noise));
    }

    #[inline(always)]
    fn add_best(
        &mut self,
        (index, sample): (u32, &Sample),
        projections: &Projections,
        l: usize,
        target: &Cloud<'_>,
        gates: &Gates,
    ) {
        let (p, n) = projections.lane(l);
        if let Some(at) = projections.position(l)
            && let Some(pixel) = target.best_near(at, p, n, gates)
            && let Some((q, m)) = target.pixel(pixel)
        {
            self.push(&self.raw(sample, q, m, n), (index, pixel as u32));
        }
    }

    /// A match before [`finish`]: `normal` is the sum of both normals, `weight` the variance of the source.
    #[inline(always)]
    fn raw(&self, sample: &Sample, q: &[f32; 3], m: &[f32; 3], n: [f32; 3]) -> Match {
        let (s, t) = (&self.source_centre, &self.target_centre);
        Match {
            source: [sample.point[0] - s[0], sample.point[1] - s[1], sample.point[2] - s[2]],
            target: [q[0] - t[0], q[1] - t[1], q[2] - t[2]],
            normal: [m[0] + n[0], m[1] + n[1], m[2] + n[2]],
            weight: sample.variance,
        }
    }

    /// Searches again for the samples whose match does not pass the gates.
    pub(crate) fn filter(
        &mut self,
        transform: &Rigid<f32>,
        (source, target): (&Cloud<'_>, &Cloud<'_>),
        gates: &Gates,
    ) {
        let before = std::mem::take(&mut self.blocks);
        let pairs = std::mem::take(&mut self.pairs);
        self.blocks.reserve(before.len());
        self.pairs.reserve(pairs.len());
        for (k, &(index, pixel)) in pairs.iter().enumerate() {
            let sample = &source.samples[index as usize];
            let (p, n) = (transform.point(sample.point), transform.direction(sample.normal));
            if target.is_compatible(pixel as usize, p, n, gates) {
                self.push(&before[k / LANES].lane(k % LANES), (index, pixel));
            } else if let Some(pixel) = target.nearest_compatible(p, n, gates)
                && let Some((q, m)) = target.pixel(pixel)
            {
                let mut alone = Block::default();
                alone.set_lane(0, &self.raw(sample, q, m, n));
                finish(&mut alone, self.target_centre[2], self.noise);
                self.push(&alone.lane(0), (index, pixel as u32));
            }
        }
    }

    #[inline(always)]
    fn push(&mut self, m: &Match, pair: (u32, u32)) {
        let lane = self.pairs.len() % LANES;
        if lane == 0 {
            self.blocks.push(Block::default());
        }
        if let Some(block) = self.blocks.last_mut() {
            block.set_lane(lane, m);
            self.pairs.push(pair);
        }
    }

    /// Calls `f` with the source point of each match, in its camera's frame.
    pub(crate) fn for_each_source(&self, mut f: impl FnMut([f32; 3])) {
        for k in 0..self.count() {
            let (block, lane) = (&self.blocks[k / LANES], k % LANES);
            f(std::array::from_fn(|c| block.source[c][lane] + self.source_centre[c]));
        }
    }
}

/// Turns sums of two normals into their bisectors, and variances of sources into weights: 1 / variance of both depths.
/// Lanes without a match keep the weight zero.
#[inline(always)]
fn finish(block: &mut Block, target_depth: f32, [a, b]: [f32; 2]) {
    for l in 0..LANES {
        let n = [block.normal[0][l], block.normal[1][l], block.normal[2][l]];
        let squared = n[0] * n[0] + n[1] * n[1] + n[2] * n[2];
        // Two unit vectors that are less than a right angle apart have a sum of more than one.
        let inverse = 1.0 / (if squared > 0.5 { squared } else { 0.5 }).sqrt();
        (0..3).for_each(|k| block.normal[k][l] = n[k] * inverse);
        let z = block.target[2][l] + target_depth;
        let sigma = a + b * z * z;
        let weight = 1.0 / (block.weight[l] + sigma * sigma);
        let usable = (block.weight[l] > 0.0) & (weight < f32::INFINITY);
        block.weight[l] = if usable { weight } else { 0.0 };
    }
}
