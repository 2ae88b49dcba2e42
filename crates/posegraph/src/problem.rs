//! The graph compiled for one solve: usable residuals only, buffers allocated once, fixed nodes left out.

use nalgebra::Isometry3;

use crate::cloud::Cloud;
use crate::dense::{DenseBlocks, DenseTerm};
use crate::feature::FeatureTerm;
use crate::graph::{PoseGraph, PosePrior};
use crate::normal::NormalEquations;
use crate::options::SolveOptions;
use crate::parallel;
use crate::prior;
use crate::sdf::SdfUnary;
use crate::stats::{Extent, Residuals};
use crate::transform::Rigid;

pub(crate) struct Problem<'a> {
    features: Vec<FeatureTerm>,
    dense: Vec<DenseTerm>,
    /// Views of the nodes that have a dense edge.
    clouds: Vec<Option<Cloud<'a>>>,
    /// Results of the dense edges, in their order.
    dense_blocks: Vec<DenseBlocks>,
    dense_costs: Vec<f64>,
    sdf: Vec<SdfUnary<'a>>,
    priors: Vec<PosePrior>,
    rigid: Vec<Rigid>,
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
            for (index, edge) in graph.feature_edges.iter().enumerate() {
                if free(edge.i) || free(edge.j) {
                    features.push(FeatureTerm::new(index, edge, options));
                }
            }
        }
        let mut dense = Vec::new();
        let edges = graph.dense_edges.len();
        let mut has_dense = vec![false; graph.nodes.len()];
        if options.dense_weight > 0.0 {
            for (index, edge) in graph.dense_edges.iter().enumerate() {
                if free(edge.source) || free(edge.target) {
                    has_dense[edge.source] = true;
                    has_dense[edge.target] = true;
                    dense.push(DenseTerm::new((index, edges), (edge.source, edge.target), options));
                }
            }
        }
        // Edges that look up the same view follow each other: it stays in the cache.
        dense.sort_by_key(|t: &DenseTerm| t.target);
        let views: Vec<_> = graph.views.iter().zip(has_dense).map(|(&v, used)| v.filter(|_| used)).collect();
        let mut clouds = Vec::new();
        parallel::map_into(&views, &mut clouds, |view| view.map(|view| Cloud::new(view, options)));
        let with_sdf = graph.sdf_terms.iter().filter(|t| free(t.node) && options.sdf_weight > 0.0);
        Self {
            features,
            dense_blocks: Vec::with_capacity(dense.len()),
            dense_costs: Vec::with_capacity(dense.len()),
            dense,
            clouds,
            sdf: with_sdf.map(|t| SdfUnary::new(t, options)).collect(),
            priors: graph.priors.iter().filter(|p| free(p.node)).copied().collect(),
            rigid: graph.nodes.iter().map(|n| Rigid::<f64>::new(&n.obj_from_cam)).collect(),
        }
    }

    pub(crate) fn has_dense(&self) -> bool {
        !self.dense.is_empty()
    }

    fn update_rigid(&mut self, poses: &[Isometry3<f64>]) {
        for (rigid, pose) in self.rigid.iter_mut().zip(poses) {
            *rigid = Rigid::<f64>::new(pose);
        }
    }

    /// Fixes the dense correspondences for the steps that follow.
    pub(crate) fn associate(&mut self, poses: &[Isometry3<f64>], iteration: usize, options: &SolveOptions) {
        let gates = options.gates(iteration);
        let clouds = &self.clouds;
        parallel::for_each_mut(&mut self.dense, |term| {
            if let (Some(source), Some(target)) = (&clouds[term.source], &clouds[term.target]) {
                term.associate(poses, (source, target), &gates, options);
            }
        });
    }

    /// Cost under the current correspondences.
    pub(crate) fn cost(&mut self, poses: &[Isometry3<f64>]) -> f64 {
        self.update_rigid(poses);
        let mut cost = 0.0;
        cost += self.features.iter().map(|t| t.cost(poses)).sum::<f64>();
        parallel::map_into(&self.dense, &mut self.dense_costs, |t| t.cost(poses));
        cost += self.dense_costs.iter().sum::<f64>();
        cost += self.sdf.iter_mut().map(|t| t.cost(poses)).sum::<f64>();
        cost += self.priors.iter().map(|p| prior::cost(p, poses)).sum::<f64>();
        cost
    }

    /// Builds the normal equations and returns the cost; makes the current SDF points the reference set.
    pub(crate) fn linearise(&mut self, poses: &[Isometry3<f64>], normal: &mut NormalEquations) -> f64 {
        self.update_rigid(poses);
        normal.clear();
        let mut cost = 0.0;
        cost += self.features.iter().map(|t| t.linearise(poses, normal)).sum::<f64>();
        parallel::map_into(&self.dense, &mut self.dense_blocks, |t| t.linearise(poses));
        cost += self.dense.iter().zip(&self.dense_blocks).map(|(t, b)| t.add(b, normal)).sum::<f64>();
        cost += self.sdf.iter_mut().map(|t| t.linearise(poses, normal)).sum::<f64>();
        cost += self.priors.iter().map(|p| prior::linearise(p, poses, normal)).sum::<f64>();
        cost
    }

    pub(crate) fn summary(&mut self, poses: &[Isometry3<f64>], graph: &PoseGraph<'_>) -> Summary {
        self.update_rigid(poses);
        let mut s = Summary {
            feature_inliers: vec![0; graph.feature_edges.len()],
            dense_inliers: vec![0; graph.dense_edges.len()],
            ..Summary::default()
        };
        for t in &self.features {
            s.feature_inliers[t.edge] = t.residuals(poses, &mut s.feature);
        }
        for t in &self.dense {
            s.dense_inliers[t.edge] = t.residuals(poses, &mut s.dense);
        }
        for t in &mut self.sdf {
            t.residuals(poses, &mut s.sdf);
        }
        s
    }

    /// Centre and radius of the points through which `node` is observed.
    pub(crate) fn extent(&mut self, node: usize, poses: &[Isometry3<f64>]) -> Extent {
        self.update_rigid(poses);
        let mut extent = Extent::default();
        self.features.iter().for_each(|t| t.extent(node, poses, &mut extent));
        self.dense.iter().for_each(|t| t.extent(node, &self.rigid, &mut extent));
        self.sdf.iter().for_each(|t| t.extent(node, &self.rigid, &mut extent));
        extent
    }
}
