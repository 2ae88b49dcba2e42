//! Dense term: point-to-plane distances under re-projective association (eq. `L_p`).

use nalgebra::{Isometry3, Matrix6, Point3, Translation3, Vector3, Vector6};

use crate::cloud::{Cloud, Sample};
use crate::jacobian::lift;
use crate::lanes::{self, Block, LANES, Match};
use crate::normal::NormalEquations;
use crate::options::{Gates, SolveOptions};
use crate::stats::{Extent, Residuals};
use crate::transform::{Rigid, widen};

/// An association stands while no sample has moved by more than this fraction of a pixel: nearest pixels are only
/// that exact.
const STILL: f32 = 0.1;

/// Samples of an edge that are matched, about, while the gates are still wide: poses are then too rough for more to
/// pay, and the search is widest.
const COARSE: usize = 200;

/// One dense edge and its current association.
#[derive(Debug)]
pub(crate) struct DenseTerm {
    pub(crate) edge: usize,
    pub(crate) source: usize,
    pub(crate) target: usize,
    /// Matches; source points relative to `source_centre`, target points relative to `target_centre`.
    blocks: Vec<Block>,
    count: usize,
    /// Sample and pixel of each match.
    pairs: Vec<(u32, u32)>,
    source_centre: [f32; 3],
    target_centre: [f32; 3],
    /// Where and with which gates the association was made.
    associated: Option<(Isometry3<f64>, Gates)>,
    scale: f64,
    delta: f64,
}

/// What a dense edge adds to the normal equations: the blocks of its nodes are `h`, `h` and `-h`, the gradients `g`
/// (target) and `-g` (source).
#[derive(Debug, Clone, Copy)]
pub(crate) struct DenseBlocks {
    h: Matrix6<f64>,
    g: Vector6<f64>,
    cost: f64,
}

impl DenseTerm {
    pub(crate) fn new(edge: usize, (source, target): (usize, usize), options: &SolveOptions) -> Self {
        Self {
            edge,
            source,
            target,
            blocks: Vec::new(),
            count: 0,
            pairs: Vec::new(),
            source_centre: [0.0; 3],
            target_centre: [0.0; 3],
            associated: None,
            scale: 0.0,
            delta: options.dense_huber,
        }
    }

    /// Re-associates the sampled source pixels at the given poses. If they have hardly moved since, matches only have
    /// to pass the new gates.
    pub(crate) fn associate(
        &mut self,
        poses: &[Isometry3<f64>],
        clouds: (&Cloud<'_>, &Cloud<'_>),
        gates: &Gates,
        options: &SolveOptions,
    ) {
        let target_from_source = poses[self.target].inv_mul(&poses[self.source]);
        let still = self.is_still(&target_from_source, clouds.0);
        match &mut self.associated {
            Some((_, with)) if still && with == gates => return,
            Some((_, with)) if still && gates.are_within(with) => {
                *with = *gates;
                self.filter(&target_from_source, clouds, gates, options);
            }
            _ => {
                self.associated = Some((target_from_source, *gates));
                self.search(&target_from_source, clouds, gates, options);
            }
        }
        // A sample that stands for several has their weight.
        let cap = options.dense_cap / (self.count as f64);
        self.scale = options.dense_weight * cap.min(stride(clouds.0, gates) as f64);
    }

    /// Whether no sample has moved notably since the last search.
    fn is_still(&self, target_from_source: &Isometry3<f64>, source: &Cloud<'_>) -> bool {
        let Some((before, _)) = &self.associated else { return false };
        let shift = Vector3::from(transform_point(target_from_source, source.centre))
            - Vector3::from(transform_point(before, source.centre));
        let angle = before.rotation.angle_to(&target_from_source.rotation);
        shift.norm() + angle * f64::from(source.radius) <= f64::from(STILL * source.pixel_size)
    }

    /// Finds a match for every sample.
    fn search(
        &mut self,
        target_from_source: &Isometry3<f64>,
        (source, target): (&Cloud<'_>, &Cloud<'_>),
        gates: &Gates,
        options: &SolveOptions,
    ) {
        self.blocks.clear();
        self.pairs.clear();
        self.count = 0;
        if target_from_source.rotation.angle() > options.max_pair_rotation {
            return;
        }
        self.source_centre = source.centre;
        self.target_centre = transform_point(target_from_source, source.centre).map(|x| x as f32);
        let transform = Rigid::<f32>::new(target_from_source);
        let stride = stride(source, gates);
        for k in (stride / 2..source.samples.len()).step_by(stride) {
            if let Some((pixel, m)) = find(&transform, (&source.samples[k], target), gates, options) {
                self.push(&m);
                self.pairs.push((k as u32, pixel));
            }
        }
    }

    /// Searches again for the samples whose match does not pass the gates.
    fn filter(
        &mut self,
        target_from_source: &Isometry3<f64>,
        (source, target): (&Cloud<'_>, &Cloud<'_>),
        gates: &Gates,
        options: &SolveOptions,
    ) {
        let transform = Rigid::<f32>::new(target_from_source);
        let before = std::mem::take(&mut self.blocks);
        let pairs = std::mem::take(&mut self.pairs);
        self.blocks.reserve(before.len());
        self.pairs.reserve(pairs.len());
        self.count = 0;
        for (k, &(index, pixel)) in pairs.iter().enumerate() {
            let sample = &source.samples[index as usize];
            let (p, n) = (transform.point(sample.point), transform.direction(sample.normal));
            if target.is_compatible(pixel as usize, p, n, gates) {
                self.push_centred(&before[k / LANES].lane(k % LANES));
                self.pairs.push((index, pixel));
            } else if let Some((pixel, m)) = find(&transform, (sample, target), gates, options) {
                self.push(&m);
                self.pairs.push((index, pixel));
            }
        }
    }

    /// Adds a match with points in their cameras' frames.
    #[inline(always)]
    fn push(&mut self, m: &Match) {
        let (s, t) = (&self.source_centre, &self.target_centre);
        self.push_centred(&Match {
            source: [m.source[0] - s[0], m.source[1] - s[1], m.source[2] - s[2]],
            target: [m.target[0] - t[0], m.target[1] - t[1], m.target[2] - t[2]],
            ..*m
        });
    }

    #[inline(always)]
    fn push_centred(&mut self, m: &Match) {
        if self.count.is_multiple_of(LANES) {
            self.blocks.push(Block::default());
        }
        if let Some(block) = self.blocks.last_mut() {
            block.set_lane(self.count % LANES, m);
            self.count += 1;
        }
    }

    /// Target from source, both relative to their centres.
    fn centred(&self, poses: &[Isometry3<f64>]) -> Rigid<f32> {
        let target_from_source = poses[self.target].inv_mul(&poses[self.source]);
        let centre = transform_point(&target_from_source, self.source_centre);
        let offset = Vector3::from(centre) - Vector3::from(widen(self.target_centre));
        Rigid::<f32>::new(&Isometry3::from_parts(offset.into(), target_from_source.rotation))
    }

    pub(crate) fn cost(&self, poses: &[Isometry3<f64>]) -> f64 {
        self.scale * lanes::cost(&self.blocks, &self.centred(poses), self.delta as f32)
    }

    pub(crate) fn linearise(&self, poses: &[Isometry3<f64>]) -> DenseBlocks {
        let (h, g, cost) = lanes::linearise(&self.blocks, &self.centred(poses), self.delta as f32);
        // Rows are about the target's centre: lift them from there.
        let centre = Translation3::from(widen(self.target_centre));
        let lift = lift(&(poses[self.target] * centre));
        let h = lift * (h * self.scale) * lift.transpose();
        DenseBlocks { h, g: lift * (g * self.scale), cost: self.scale * cost }
    }

    /// Adds the blocks of a linearisation and returns its cost.
    pub(crate) fn add(&self, blocks: &DenseBlocks, normal: &mut NormalEquations) -> f64 {
        let DenseBlocks { h, g, cost } = blocks;
        normal.add(self.target, h, g);
        normal.add(self.source, h, &-g);
        normal.add_cross(self.target, self.source, &-h);
        *cost
    }

    pub(crate) fn residuals(&self, poses: &[Isometry3<f64>], all: &mut Residuals) -> usize {
        let mut inliers = 0;
        lanes::for_each(&self.blocks, self.count, &self.centred(poses), |r, weight| {
            inliers += usize::from(all.add(r, self.delta, weight));
        });
        inliers
    }

    /// Adds the object-frame points if `node` takes part.
    pub(crate) fn extent(&self, node: usize, poses: &[Rigid], extent: &mut Extent) {
        if node != self.source && node != self.target {
            return;
        }
        for k in 0..self.count {
            let (block, lane) = (&self.blocks[k / LANES], k % LANES);
            let point = std::array::from_fn(|c| block.source[c][lane] + self.source_centre[c]);
            extent.add(poses[self.source].point(point));
        }
    }
}

/// Every how many samples are matched.
fn stride(source: &Cloud<'_>, gates: &Gates) -> usize {
    if gates.last { 1 } else { (source.samples.len() / COARSE).max(1) }
}

/// The best match of a sample with the target view (its pixel, and the match in camera frames).
#[inline(always)]
fn find(
    transform: &Rigid<f32>,
    (sample, target): (&Sample, &Cloud<'_>),
    gates: &Gates,
    options: &SolveOptions,
) -> Option<(u32, Match)> {
    let n = transform.direction(sample.normal);
    let best = target.nearest_compatible(transform.point(sample.point), n, gates)?;
    let (&target, &normal) = target.pixel(best)?;
    let weight = 1.0 / (sample.variance + options.depth_variance(f64::from(target[2])) as f32);
    let m = Match { source: sample.point, target, normal: bisector(normal, n), weight };
    weight.is_finite().then_some((best as u32, m))
}

fn transform_point(pose: &Isometry3<f64>, p: [f32; 3]) -> [f64; 3] {
    pose.transform_point(&Point3::from(widen(p))).coords.into()
}

/// Normal of the plane that a match is measured against: unit vector half way between two unit vectors that are less
/// than a right angle apart.
#[inline(always)]
fn bisector(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    let s = [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
    let inverse = 1.0 / (s[0] * s[0] + s[1] * s[1] + s[2] * s[2]).sqrt();
    [s[0] * inverse, s[1] * inverse, s[2] * inverse]
}
