//! Poses, relative measurements, and the checks made before a solve.

use std::collections::BTreeSet;

use nalgebra::{Cholesky, Isometry3, Matrix6};

use crate::graph::is_finite_pose;

/// A measurement of one pose in the frame of another.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RelativePose {
    /// Node whose frame the measurement is expressed in.
    pub from: usize,
    /// Node that is measured.
    pub to: usize,
    /// Measured `T_from^-1 T_to`: maps coordinates of `to` to coordinates of `from`, metres.
    pub from_from_to: Isometry3<f64>,
    /// Inverse covariance of the residual `log(from_from_to^-1 T_from^-1 T_to) = [rho; phi]` (translation first, in the
    /// frame of `to`), 1/m^2 and 1/rad^2; symmetric positive semi-definite.
    pub information: Matrix6<f64>,
}

impl RelativePose {
    /// A measurement from its parts, see the fields.
    pub fn new(from: usize, to: usize, from_from_to: Isometry3<f64>, information: Matrix6<f64>) -> Self {
        Self { from, to, from_from_to, information }
    }
}

/// A pose graph: variables with initial values, and measurements between them.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Graph {
    /// Pose of each node: maps node coordinates to world coordinates, metres.
    pub poses: Vec<Isometry3<f64>>,
    /// Measurements; several between the same two nodes add up.
    pub edges: Vec<RelativePose>,
    /// Nodes that are constants: they are left out of the system and come back bit for bit. In every connected part of
    /// the graph without one, the solver holds the node of lowest index.
    pub fixed: BTreeSet<usize>,
}

impl Graph {
    /// Half of chi squared at the current poses, without robust kernel; NaN if an edge refers to a missing node.
    pub fn half_chi_squared(&self) -> f64 {
        let term = |edge: &RelativePose| match (self.poses.get(edge.from), self.poses.get(edge.to)) {
            (Some(from), Some(to)) => 0.5 * super::edge::squared_error(edge, from, to),
            _ => f64::NAN,
        };
        self.edges.iter().map(term).sum()
    }

    /// Checks that every index exists, every number is finite and every information matrix is usable.
    pub(super) fn validate(&self) -> Result<(), Error> {
        let nodes = self.poses.len();
        if let Some(node) = self.poses.iter().position(|pose| !is_finite_pose(pose)) {
            return Err(Error::NonFinitePose { node });
        }
        if let Some(&node) = self.fixed.iter().find(|&&node| node >= nodes) {
            return Err(Error::FixedOutOfRange { node, nodes });
        }
        for (edge, e) in self.edges.iter().enumerate() {
            for node in [e.from, e.to] {
                if node >= nodes {
                    return Err(Error::NodeOutOfRange { edge, node, nodes });
                }
            }
            if e.from == e.to {
                return Err(Error::SelfEdge { edge, node: e.from });
            }
            if !is_finite_pose(&e.from_from_to) {
                return Err(Error::NonFiniteMeasurement { edge });
            }
            if !is_information(&e.information) {
                return Err(Error::InvalidInformation { edge });
            }
        }
        Ok(())
    }

    /// Which nodes are constants: the fixed ones, and one in every connected part that has none.
    pub(super) fn constants(&self) -> Vec<bool> {
        let mut constant: Vec<bool> = (0..self.poses.len()).map(|k| self.fixed.contains(&k)).collect();
        let mut parent: Vec<usize> = (0..constant.len()).collect();
        for edge in &self.edges {
            let (a, b) = (root(&mut parent, edge.from), root(&mut parent, edge.to));
            // The lower index becomes the root: it is the node held.
            parent[a.max(b)] = a.min(b);
        }
        let mut anchored = vec![false; constant.len()];
        for node in 0..constant.len() {
            anchored[root(&mut parent, node)] |= constant[node];
        }
        for node in 0..constant.len() {
            constant[node] |= parent[node] == node && !anchored[node];
        }
        constant
    }
}

/// Representative of a node's connected part; shortens the path on the way.
fn root(parent: &mut [usize], mut node: usize) -> usize {
    while parent[node] != node {
        parent[node] = parent[parent[node]];
        node = parent[node];
    }
    node
}

/// Finite, symmetric and positive semi-definite, up to rounding of numbers written with six digits.
pub(crate) fn is_information(information: &Matrix6<f64>) -> bool {
    let scale = information.amax();
    if information.iter().any(|x| !x.is_finite())
        || (information - information.transpose()).amax() > 1e-9 * scale
    {
        return false;
    }
    scale == 0.0 || Cholesky::new(information / scale + Matrix6::identity() * 1e-6).is_some()
}

/// Why a sparse graph could not be solved.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// An edge refers to a node that does not exist.
    #[error(
        "edge {edge} refers to node {node}, but the graph has {nodes} poses; add the pose or drop the edge"
    )]
    NodeOutOfRange {
        /// Index of the edge.
        edge: usize,
        /// The index it holds.
        node: usize,
        /// Poses in the graph.
        nodes: usize,
    },
    /// A node is fixed that does not exist.
    #[error("node {node} is fixed, but the graph has {nodes} poses; fix an existing node")]
    FixedOutOfRange {
        /// The node.
        node: usize,
        /// Poses in the graph.
        nodes: usize,
    },
    /// An edge joins a node with itself.
    #[error("edge {edge} joins node {node} with itself; an edge needs two different nodes")]
    SelfEdge {
        /// Index of the edge.
        edge: usize,
        /// The node.
        node: usize,
    },
    /// A pose holds NaN or infinity, or its rotation is not a unit quaternion.
    #[error("pose of node {node} is not a finite rigid motion; give it a valid initial pose")]
    NonFinitePose {
        /// The node.
        node: usize,
    },
    /// A measurement holds NaN or infinity, or its rotation is not a unit quaternion.
    #[error("measurement of edge {edge} is not a finite rigid motion; drop the edge")]
    NonFiniteMeasurement {
        /// Index of the edge.
        edge: usize,
    },
    /// An information matrix is not finite, symmetric and positive semi-definite.
    #[error("edge {edge} needs a finite, symmetric, positive semi-definite information matrix")]
    InvalidInformation {
        /// Index of the edge.
        edge: usize,
    },
    /// An option is NaN, infinite, negative, or zero where it divides.
    #[error("option {name} = {value} is out of range; it must be finite and not negative (scales: positive)")]
    InvalidOption {
        /// The field of [`Options`](super::Options).
        name: &'static str,
        /// Its value.
        value: f64,
    },
    /// The factorisation does not fit in memory.
    #[error("factorisation of {nodes} free nodes does not fit in memory; solve the graph in parts")]
    TooLarge {
        /// Free nodes.
        nodes: usize,
    },
}
