//! Dense term: point-to-plane distances under re-projective association (eq. `L_p`).

use nalgebra::{Isometry3, Point3, Translation3, Vector3};

use crate::cloud::Cloud;
use crate::jacobian::lift;
use crate::matches::Matches;
use crate::normal::PairBlocks;
use crate::observability::noise_information;
use crate::options::{Gates, SolveOptions};
use crate::simd;
use crate::stats::Tally;
use crate::transform::{Rigid, widen};

/// An association stands while no sample has moved by more than this fraction of a pixel: nearest pixels are only
/// that exact.
const STILL: f32 = 0.1;

/// Samples of an edge that are matched, about, while the gates are still wide: poses are then too rough for more to
/// pay, and the search is widest. Many edges share `COARSE_OF_ALL`.
const COARSE: [usize; 2] = [100, 200];
const COARSE_OF_ALL: usize = 4500;

/// Samples of each of `edges` that are matched while the gates are wide.
pub(crate) fn coarse_samples(edges: usize) -> usize {
    (COARSE_OF_ALL / edges.max(1)).clamp(COARSE[0], COARSE[1])
}

/// One dense edge and its current association.
#[derive(Debug)]
pub(crate) struct DenseTerm {
    pub(crate) edge: usize,
    pub(crate) source: usize,
    pub(crate) target: usize,
    matches: Matches,
    /// Where and with which gates the association was made.
    associated: Option<(Isometry3<f64>, Gates)>,
    scale: f64,
    delta: f64,
}

impl DenseTerm {
    pub(crate) fn new(edge: usize, (source, target): (usize, usize), options: &SolveOptions) -> Self {
        Self {
            edge,
            source,
            target,
            matches: Matches::default(),
            associated: None,
            scale: 0.0,
            delta: options.dense_huber,
        }
    }

    /// Re-associates the sampled source pixels at the given poses, unless they have hardly moved since.
    pub(crate) fn associate(
        &mut self,
        poses: &[Isometry3<f64>],
        clouds: (&Cloud<'_>, &Cloud<'_>),
        gates: &Gates,
        options: &SolveOptions,
    ) {
        let target_from_source = poses[self.target].inv_mul(&poses[self.source]);
        if self.associated.is_some_and(|(_, with)| with == *gates)
            && self.is_still(&target_from_source, clouds.0)
        {
            return;
        }
        self.associated = Some((target_from_source, *gates));
        self.search(&target_from_source, clouds, gates, options);
        // A sample that stands for several has their weight.
        let (_, stands_for) = clouds.0.samples(gates);
        let cap = options.dense_cap / (self.matches.count() as f64);
        self.scale = options.dense_weight * cap.min(stands_for);
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
        self.matches.set_centres(source.centre, shifted, options);
        if target_from_source.rotation.angle() <= options.max_pair_rotation {
            let transform = Rigid::<f32>::new(target_from_source);
            simd::search(&mut self.matches, &transform, (source, target), gates);
        } else {
            self.matches.clear();
        }
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

    pub(crate) fn linearise(&self, poses: &[Isometry3<f64>]) -> PairBlocks {
        let (sums, cost) = simd::dense_sums(self.matches.blocks(), &self.centred(poses), self.delta as f32);
        let (h, g) = sums.finish();
        let weight = self.scale * (h[(0, 0)] + h[(1, 1)] + h[(2, 2)]);
        let noise = noise_information(weight, self.matches.normal_variance());
        // Rows are about the target's centre: lift them from there.
        let centre = Translation3::from(widen(self.matches.target_centre));
        let lift = lift(&(poses[self.target] * centre));
        let h = lift * (h * self.scale) * lift.transpose();
        let nodes = (self.target, self.source);
        PairBlocks { nodes, h, g: lift * (g * self.scale), cost: self.scale * cost, noise, doubt: 0.0 }
    }

    pub(crate) fn tally(&self, poses: &[Isometry3<f64>]) -> Tally {
        simd::dense_tally(self.matches.blocks(), &self.centred(poses), self.delta as f32)
    }
}

fn transform_point(pose: &Isometry3<f64>, p: [f32; 3]) -> [f64; 3] {
    pose.transform_point(&Point3::from(widen(p))).coords.into()
}
