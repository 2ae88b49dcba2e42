//! The graph compiled for one solve: usable residuals only, buffers allocated once, fixed nodes left out.

use nalgebra::Isometry3;

use crate::cloud::Cloud;
use crate::dense::{DenseTerm, coarse_samples};
use crate::feature::FeatureTerm;
use crate::graph::{PoseGraph, PosePrior};
use crate::normal::{NormalEquations, PairBlocks};
use crate::observability::{Observability, is_fully_observed};
use crate::options::SolveOptions;
use crate::parallel;
use crate::prior;
use crate::sdf::SdfUnary;
use crate::stats::{Extent, Residuals, Tally};

pub(crate) struct Problem<'a> {
    features: Vec<FeatureTerm>,
    dense: Vec<DenseTerm>,
    /// Views of the nodes that have a dense edge.
    clouds: Vec<Option<Cloud<'a>>>,
    /// Results of the feature or dense edges, in their order.
    blocks: Vec<PairBlocks>,
    costs: Vec<f64>,
    tallies: Vec<Tally>,
    sdf: Vec<SdfUnary<'a>>,
    priors: Vec<PosePrior>,
    /// What each node sees, in its camera's frame; of fixed nodes nothing is needed.
    extents: Vec<Extent>,
    /// Where a node is held in directions that are not observed.
    predictions: Vec<Isometry3<f64>>,
    /// Priors that hold nodes there, as found at the last linearisation.
    holds: Vec<PosePrior>,
}

/// What the residuals of a kind look like at some poses.
#[derive(Debug, Default)]
pub(crate) struct Summary {
    pub(crate) feature: Residuals,
    pub(crate) dense: Residuals,
    pub(crate) sdf: Residuals,
    pub(crate) feature_inliers: Vec<usize>,
    pub(crate) dense_inliers: Vec<usize>,
}

impl<'a> Problem<'a> {
    /// Keeps the terms that touch a free node and have a positive weight.
    pub(crate) fn new(graph: &PoseGraph<'a>, options: &SolveOptions, normal: &NormalEquations) -> Self {
        let free = |node: usize| normal.is_free(node);
        let mut features = Vec::new();
        if options.feature_weight > 0.0 {
            let edges = graph.feature_edges.iter().enumerate().filter(|(_, e)| free(e.i) || free(e.j));
            let edges: Vec<_> = edges.collect();
            parallel::map_into(&edges, &mut features, |(index, edge)| {
                FeatureTerm::new(*index, edge, options)
            });
        }
        let mut dense = Vec::new();
        let mut has_dense = vec![false; graph.nodes.len()];
        if options.dense_weight > 0.0 {
            for (index, edge) in graph.dense_edges.iter().enumerate() {
                if free(edge.source) || free(edge.target) {
                    has_dense[edge.source] = true;
                    has_dense[edge.target] = true;
                    dense.push(DenseTerm::new(index, (edge.source, edge.target), options));
                }
            }
        }
        // Edges that look up the same view follow each other: it stays in the cache.
        dense.sort_by_key(|t: &DenseTerm| t.target);
        let views: Vec<_> = graph.views.iter().zip(has_dense).map(|(&v, used)| v.filter(|_| used)).collect();
        let mut clouds = Vec::new();
        let edges = graph.dense_edges.len();
        let samples = (options.dense_share(edges), coarse_samples(edges));
        parallel::map_into(&views, &mut clouds, |view| view.map(|view| Cloud::new(view, options, samples)));
        let with_sdf = graph.sdf_terms.iter().filter(|t| free(t.node) && options.sdf_weight > 0.0);
        let mut problem = Self {
            features,
            blocks: Vec::new(),
            costs: Vec::new(),
            tallies: Vec::new(),
            dense,
            clouds,
            sdf: with_sdf.map(|t| SdfUnary::new(t, options)).collect(),
            priors: graph.priors.iter().filter(|p| free(p.node)).copied().collect(),
            extents: Vec::new(),
            predictions: graph
                .nodes
                .iter()
                .zip(&graph.predictions)
                .map(|(n, p)| p.unwrap_or(n.obj_from_cam))
                .collect(),
            holds: Vec::new(),
        };
        let extent = |node| if free(node) { problem.extent(node) } else { Extent::default() };
        problem.extents = (0..graph.nodes.len()).map(extent).collect();
        problem
    }

    /// Whether later iterations are about the same cost as earlier ones.
    pub(crate) fn is_steady(&self) -> bool {
        self.dense.is_empty() && self.features.is_empty()
    }

    /// Fixes the dense correspondences and the threshold on matches for the steps that follow.
    pub(crate) fn associate(&mut self, poses: &[Isometry3<f64>], iteration: usize, options: &SolveOptions) {
        let gates = options.gates(iteration);
        self.features.iter_mut().for_each(|term| term.robust = gates.feature);
        let clouds = &self.clouds;
        parallel::for_each_mut(&mut self.dense, |term| {
            if let (Some(source), Some(target)) = (&clouds[term.source], &clouds[term.target]) {
                term.associate(poses, (source, target), &gates, options);
            }
        });
    }

    /// Cost under the current correspondences.
    pub(crate) fn cost(&mut self, poses: &[Isometry3<f64>]) -> f64 {
        let mut cost = 0.0;
        parallel::map_into(&self.features, &mut self.costs, |t| t.cost(poses));
        cost += self.costs.iter().sum::<f64>();
        parallel::map_into(&self.dense, &mut self.costs, |t| t.cost(poses));
        cost += self.costs.iter().sum::<f64>();
        cost += self.sdf.iter_mut().map(|t| t.cost(poses)).sum::<f64>();
        cost += self.priors.iter().chain(&self.holds).map(|p| prior::cost(p, poses)).sum::<f64>();
        cost
    }

    /// Builds the normal equations and returns the cost; makes the current SDF points the reference set.
    pub(crate) fn linearise(&mut self, poses: &[Isometry3<f64>], normal: &mut NormalEquations) -> f64 {
        normal.clear();
        let mut cost = 0.0;
        parallel::map_into(&self.features, &mut self.blocks, |t| t.linearise(poses));
        cost += self.blocks.iter().map(|b| normal.add_pair(b)).sum::<f64>();
        parallel::map_into(&self.dense, &mut self.blocks, |t| t.linearise(poses));
        cost += self.blocks.iter().map(|b| normal.add_pair(b)).sum::<f64>();
        cost += self.sdf.iter_mut().map(|t| t.linearise(poses, normal)).sum::<f64>();
        cost += self.priors.iter().map(|p| prior::linearise(p, poses, normal)).sum::<f64>();
        cost
    }

    /// Holds every node at its prediction in the directions that the equations just built don't observe: adds the priors
    /// that do, and returns their cost.
    pub(crate) fn hold(&mut self, poses: &[Isometry3<f64>], normal: &mut NormalEquations) -> f64 {
        self.holds.clear();
        for (node, pose) in poses.iter().enumerate() {
            let Some(own) = normal.own(node) else { continue };
            let extent = self.extents[node].moved(pose);
            if is_fully_observed(&own, &extent) {
                continue;
            }
            let observability = Observability::new(node, &own, &extent);
            if let Some(information) = observability.and_then(|o| o.hold()) {
                self.holds.push(PosePrior { node, obj_from_cam: self.predictions[node], information });
            }
        }
        self.holds.iter().map(|p| prior::linearise(p, poses, normal)).sum()
    }

    /// Takes the priors of [`Self::hold`] back, so that the equations tell of measurements alone.
    pub(crate) fn release(&self, poses: &[Isometry3<f64>], normal: &mut NormalEquations) {
        for hold in &self.holds {
            let taken = PosePrior { information: -hold.information, ..*hold };
            prior::linearise(&taken, poses, normal);
        }
    }

    /// What the equations tell of the newest free node, the others given.
    pub(crate) fn observability(
        &self,
        poses: &[Isometry3<f64>],
        normal: &NormalEquations,
    ) -> Option<Observability> {
        let node = (0..poses.len()).rev().find(|&node| normal.is_free(node))?;
        Observability::new(node, &normal.own(node)?, &self.extents[node].moved(&poses[node]))
    }

    pub(crate) fn summary(&mut self, poses: &[Isometry3<f64>], graph: &PoseGraph<'_>) -> Summary {
        let mut s = Summary {
            feature_inliers: vec![0; graph.feature_edges.len()],
            dense_inliers: vec![0; graph.dense_edges.len()],
            ..Summary::default()
        };
        parallel::map_into(&self.features, &mut self.tallies, |t| t.tally(poses));
        for (t, tally) in self.features.iter().zip(&self.tallies) {
            s.feature_inliers[t.edge] = s.feature.add_edge(tally);
        }
        parallel::map_into(&self.dense, &mut self.tallies, |t| t.tally(poses));
        for (t, tally) in self.dense.iter().zip(&self.tallies) {
            s.dense_inliers[t.edge] = s.dense.add_edge(tally);
        }
        for t in &mut self.sdf {
            t.residuals(poses, &mut s.sdf);
        }
        s
    }

    /// Centre and size of what `node` sees, in its camera's frame.
    fn extent(&self, node: usize) -> Extent {
        if let Some(Some(cloud)) = self.clouds.get(node) {
            return cloud.extent;
        }
        let features = self.features.iter().flat_map(|t| t.points(node));
        let sdf = self.sdf.iter().filter(|t| t.node == node).flat_map(|t| t.points().iter().copied());
        Extent::of(features.chain(sdf))
    }
}
