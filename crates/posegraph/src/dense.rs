//! Dense term: point-to-plane distances under re-projective association (eq. `L_p`).

use nalgebra::{Isometry3, Matrix6, Point3, Translation3, Vector3, Vector6};

use crate::cloud::Cloud;
use crate::jacobian::lift;
use crate::lanes;
use crate::matches::Matches;
use crate::normal::NormalEquations;
use crate::options::{Gates, SolveOptions};
use crate::simd;
use crate::stats::{Extent, Residuals};
use crate::transform::{Rigid, widen};

/// An association stands while no sample has moved by more than this fraction of a pixel: nearest pixels are only
/// that exact.
const STILL: f32 = 0.1;

/// Samples of an edge that are matched, about, while the gates are still wide: poses are then too rough for more to
/// pay, and the search is widest. Many edges share `COARSE_OF_ALL`.
const COARSE: [usize; 2] = [100, 200];
const COARSE_OF_ALL: usize = 4500;

/// One dense edge and its current association.
#[derive(Debug)]
pub(crate) struct DenseTerm {
    pub(crate) edge: usize,
    pub(crate) source: usize,
    pub(crate) target: usize,
    matches: Matches,
    /// Where and with which gates the association was made.
    associated: Option<(Isometry3<f64>, Gates)>,
    /// Samples to match while the gates are wide.
    coarse: usize,
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
    /// Edge number `edge` of `edges`.
    pub(crate) fn new(
        (edge, edges): (usize, usize),
        (source, target): (usize, usize),
        options: &SolveOptions,
    ) -> Self {
        Self {
            coarse: (COARSE_OF_ALL / edges.max(1)).clamp(COARSE[0], COARSE[1]),
            edge,
            source,
            target,
            matches: Matches::default(),
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
                self.matches.filter(&Rigid::<f32>::new(&target_from_source), clouds, gates);
            }
            _ => {
                self.associated = Some((target_from_source, *gates));
                self.search(&target_from_source, clouds, gates, options);
            }
        }
        // A sample that stands for several has their weight.
        let cap = options.dense_cap / (self.matches.count() as f64);
        self.scale = options.dense_weight * cap.min(self.stride(clouds.0, gates) as f64);
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
        let shifted = transform_point(target_from_source, source.centre).map(|x| x as f32);
        self.matches.clear(source.centre, shifted, options);
        if target_from_source.rotation.angle() <= options.max_pair_rotation {
            let transform = Rigid::<f32>::new(target_from_source);
            let stride = self.stride(source, gates);
            simd::search(&mut self.matches, &transform, (source, target), gates, stride);
        }
    }

    /// Every how many samples are matched.
    fn stride(&self, source: &Cloud<'_>, gates: &Gates) -> usize {
        if gates.last { 1 } else { (source.samples.len() / self.coarse).max(1) }
    }

    /// Target from source, both relative to their centres.
    fn centred(&self, poses: &[Isometry3<f64>]) -> Rigid<f32> {
        let target_from_source = poses[self.target].inv_mul(&poses[self.source]);
        let centre = transform_point(&target_from_source, self.matches.source_centre);
        let offset = Vector3::from(centre) - Vector3::from(widen(self.matches.target_centre));
        Rigid::<f32>::new(&Isometry3::from_parts(offset.into(), target_from_source.rotation))
    }

    pub(crate) fn cost(&self, poses: &[Isometry3<f64>]) -> f64 {
        self.scale * simd::dense_cost(self.matches.blocks(), &self.centred(poses), self.delta as f32)
    }

    pub(crate) fn linearise(&self, poses: &[Isometry3<f64>]) -> DenseBlocks {
        let (sums, cost) = simd::dense_sums(self.matches.blocks(), &self.centred(poses), self.delta as f32);
        let (h, g) = sums.finish();
        // Rows are about the target's centre: lift them from there.
        let centre = Translation3::from(widen(self.matches.target_centre));
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
        lanes::for_each(self.matches.blocks(), self.matches.count(), &self.centred(poses), |r, weight| {
            inliers += usize::from(all.add(r, self.delta, weight));
        });
        inliers
    }

    /// Adds the object-frame points if `node` takes part.
    pub(crate) fn extent(&self, node: usize, poses: &[Rigid], extent: &mut Extent) {
        if node != self.source && node != self.target {
            return;
        }
        self.matches.for_each_source(|point| extent.add(poses[self.source].point(point)));
    }
}

fn transform_point(pose: &Isometry3<f64>, p: [f32; 3]) -> [f64; 3] {
    pose.transform_point(&Point3::from(widen(p))).coords.into()
}
