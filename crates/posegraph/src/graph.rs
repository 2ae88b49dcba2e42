//! The problem as data: nodes, the measurements between them, and the checks made when they are added.

use nalgebra::{Isometry3, Matrix6};

use crate::error::Error;
use crate::view::DenseView;

/// One pose variable `T` (camera to object). The solver perturbs it from the left: `T <- exp(delta) T`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Node {
    /// Initial value: maps camera coordinates to object coordinates, metres.
    pub obj_from_cam: Isometry3<f64>,
    /// A fixed node is a constant: it is eliminated from the system and returned bit for bit.
    pub fixed: bool,
}

/// Matched 3-D points of two frames, each in its own camera frame (eq. `L_f` of the paper).
#[derive(Debug, Clone, PartialEq)]
pub struct FeatureEdge {
    /// First node.
    pub i: usize,
    /// Second node.
    pub j: usize,
    /// Points of `i`, metres, camera frame.
    pub points_i: Vec<[f32; 3]>,
    /// Points of `j`, metres, camera frame; `points_j[k]` is the same surface point as `points_i[k]`.
    pub points_j: Vec<[f32; 3]>,
    /// Weight of each match, or empty for all ones. A match whose weight is not positive and finite is dropped.
    pub weights: Vec<f32>,
}

/// Point-to-plane alignment of two views by re-projective association (eq. `L_p` of the paper).
///
/// The plane's normal is the bisector of the two points' normals (Rusinkiewicz, "A symmetric objective function for
/// ICP", 2019), not the target's alone: on a curved surface sampled in pixels this removes most of the bias.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DenseEdge {
    /// Node whose pixels are transformed; take the view with fewer valid points.
    pub source: usize,
    /// Node whose points and normals are looked up.
    pub target: usize,
}

/// A signed distance field that can be queried for values and gradients.
pub trait SdfModel: Sync {
    /// For object-frame `points` (metres) writes the signed distance (metres) and its gradient (unitless). All three
    /// slices have the same length. NaN where the field is unknown: such points are left out.
    fn sdf_and_gradient(&self, points: &[[f32; 3]], sdf: &mut [f32], gradient: &mut [[f32; 3]]);
}

/// Unary term: the points of one frame lie on the zero level of a signed distance field (eq. `L_s` of the paper).
#[derive(Clone)]
pub struct SdfTerm<'a> {
    /// The node.
    pub node: usize,
    /// Observed surface points, camera frame, metres.
    pub points: Vec<[f32; 3]>,
    /// The field, in the object frame.
    pub model: &'a dyn SdfModel,
}

impl std::fmt::Debug for SdfTerm<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("SdfTerm").field("node", &self.node).field("points", &self.points.len()).finish()
    }
}

/// Gaussian prior on a pose: `1/2 r^T information r` with `r = log(T * prior^-1)`, an object-frame twist.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PosePrior {
    /// The node.
    pub node: usize,
    /// Mean, camera to object.
    pub obj_from_cam: Isometry3<f64>,
    /// Inverse covariance of `[rho; phi]`, units 1/m^2 and 1/rad^2; symmetric positive semi-definite.
    pub information: Matrix6<f64>,
}

/// A pose graph under construction. Every `add_*` checks its indices, so a graph that exists is well formed.
#[derive(Debug, Clone, Default)]
pub struct PoseGraph<'a> {
    pub(crate) nodes: Vec<Node>,
    pub(crate) views: Vec<Option<&'a DenseView>>,
    pub(crate) feature_edges: Vec<FeatureEdge>,
    pub(crate) dense_edges: Vec<DenseEdge>,
    pub(crate) sdf_terms: Vec<SdfTerm<'a>>,
    pub(crate) priors: Vec<PosePrior>,
    pub(crate) predictions: Vec<Option<Isometry3<f64>>>,
}

impl<'a> PoseGraph<'a> {
    /// A graph without nodes.
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds a pose variable and returns its index. Indices count up from 0 in the order of the calls. A pose that
    /// is not finite is reported by [`solve`](crate::solve).
    pub fn add_node(&mut self, node: Node) -> usize {
        self.nodes.push(node);
        self.views.push(None);
        self.predictions.push(None);
        self.nodes.len() - 1
    }

    /// Gives a node its organised cloud; needed by every node of a dense edge.
    ///
    /// # Errors
    /// Unknown node.
    pub fn set_view(&mut self, node: usize, view: &'a DenseView) -> Result<(), Error> {
        self.check_node("view", node)?;
        if let Some(slot) = self.views.get_mut(node) {
            *slot = Some(view);
        }
        Ok(())
    }

    /// Says where a node is expected, camera to object: it stays there in directions that nothing observes
    /// ([`SolveOptions::hold`](crate::SolveOptions::hold)). By default that is its initial pose.
    ///
    /// # Errors
    /// Unknown node, or a pose that is not finite.
    pub fn set_prediction(&mut self, node: usize, obj_from_cam: Isometry3<f64>) -> Result<(), Error> {
        self.check_node("prediction", node)?;
        if !is_finite_pose(&obj_from_cam) {
            return Err(Error::NonFinitePose { node });
        }
        if let Some(slot) = self.predictions.get_mut(node) {
            *slot = Some(obj_from_cam);
        }
        Ok(())
    }

    /// Adds matched points between two nodes.
    ///
    /// # Errors
    /// Unknown node, `i == j`, or arrays of different length.
    pub fn add_feature_edge(&mut self, edge: FeatureEdge) -> Result<(), Error> {
        self.check_pair("feature edge", edge.i, edge.j)?;
        check_length("points_j", edge.points_j.len(), edge.points_i.len())?;
        if !edge.weights.is_empty() {
            check_length("weights", edge.weights.len(), edge.points_i.len())?;
        }
        self.feature_edges.push(edge);
        Ok(())
    }

    /// Adds a point-to-plane edge between two nodes that have views.
    ///
    /// # Errors
    /// Unknown node, `source == target`, or a node without a view.
    pub fn add_dense_edge(&mut self, edge: DenseEdge) -> Result<(), Error> {
        self.check_pair("dense edge", edge.source, edge.target)?;
        for node in [edge.source, edge.target] {
            if self.views.get(node).copied().flatten().is_none() {
                return Err(Error::MissingView { node });
            }
        }
        self.dense_edges.push(edge);
        Ok(())
    }

    /// Adds an SDF term to a node.
    ///
    /// # Errors
    /// Unknown node.
    pub fn add_sdf_term(&mut self, term: SdfTerm<'a>) -> Result<(), Error> {
        self.check_node("sdf term", term.node)?;
        self.sdf_terms.push(term);
        Ok(())
    }

    /// Adds a prior to a node.
    ///
    /// # Errors
    /// Unknown node, a mean that is not finite, or an information matrix that is not positive semi-definite.
    pub fn add_prior(&mut self, prior: PosePrior) -> Result<(), Error> {
        self.check_node("prior", prior.node)?;
        if !is_finite_pose(&prior.obj_from_cam) {
            return Err(Error::NonFinitePose { node: prior.node });
        }
        let information = &prior.information;
        let scale = information.amax();
        let symmetric = (information - information.transpose()).amax() <= 1e-9 * scale;
        if !scale.is_finite() || information.iter().any(|x| !x.is_finite()) || !symmetric {
            return Err(Error::InvalidInformation { node: prior.node });
        }
        if information.symmetric_eigenvalues().min() < -1e-9 * scale {
            return Err(Error::InvalidInformation { node: prior.node });
        }
        self.priors.push(prior);
        Ok(())
    }

    /// The nodes, in the order of their indices.
    pub fn nodes(&self) -> &[Node] {
        &self.nodes
    }

    fn check_node(&self, term: &'static str, index: usize) -> Result<(), Error> {
        let nodes = self.nodes.len();
        if index < nodes { Ok(()) } else { Err(Error::NodeOutOfRange { term, index, nodes }) }
    }

    fn check_pair(&self, term: &'static str, a: usize, b: usize) -> Result<(), Error> {
        self.check_node(term, a)?;
        self.check_node(term, b)?;
        if a == b { Err(Error::SelfEdge { term, index: a }) } else { Ok(()) }
    }
}

pub(crate) fn check_length(what: &'static str, got: usize, expected: usize) -> Result<(), Error> {
    if got == expected { Ok(()) } else { Err(Error::LengthMismatch { what, got, expected }) }
}

/// Finite translation and a rotation close to unit length.
pub(crate) fn is_finite_pose(pose: &Isometry3<f64>) -> bool {
    pose.translation.vector.iter().all(|x| x.is_finite())
        && (pose.rotation.as_ref().norm_squared() - 1.0).abs() < 1e-3
}
