//! Everything that can be wrong with a graph or with the options of a solve.

/// Why a graph could not be built or solved. Bad *data* (NaN points, outliers, empty edges) is never an error: it
/// is dropped. Errors are for mistakes in the graph's structure.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A term refers to a node that was never added.
    #[error("{term} refers to node {index}, but the graph has {nodes} nodes; add the node first")]
    NodeOutOfRange {
        /// Which kind of term.
        term: &'static str,
        /// The index it holds.
        index: usize,
        /// Nodes in the graph.
        nodes: usize,
    },
    /// An edge joins a node with itself.
    #[error("{term} joins node {index} with itself; an edge needs two different nodes")]
    SelfEdge {
        /// Which kind of edge.
        term: &'static str,
        /// The node.
        index: usize,
    },
    /// Two arrays that go together differ in length.
    #[error("{what} has {got} elements where {expected} are needed; pass arrays of equal length")]
    LengthMismatch {
        /// The array at fault.
        what: &'static str,
        /// Its length.
        got: usize,
        /// The length it should have.
        expected: usize,
    },
    /// A dense edge touches a node without a view.
    #[error("dense edge needs a view of node {node}; call set_view first")]
    MissingView {
        /// The node without a view.
        node: usize,
    },
    /// A view's camera cannot project.
    #[error("camera of the view is not usable; focal lengths must be positive, and all of it finite")]
    InvalidCamera,
    /// A view has more pixels than an index can count.
    #[error("a view of {pixels} pixels is too large; scale it down")]
    ViewTooLarge {
        /// Its pixels.
        pixels: usize,
    },
    /// A node's pose (or a prior's mean) holds NaN or infinity, or its rotation is not a unit quaternion.
    #[error("pose of node {node} is not a finite rigid motion; drop the node or give it a valid pose")]
    NonFinitePose {
        /// The node.
        node: usize,
    },
    /// A prior's information matrix is not symmetric positive semi-definite and finite.
    #[error("prior of node {node} needs a finite, symmetric, positive semi-definite information matrix")]
    InvalidInformation {
        /// The node.
        node: usize,
    },
    /// An option is NaN, infinite, negative, or zero where it divides.
    #[error("option {name} = {value} is out of range; it must be finite and not negative (scales: positive)")]
    InvalidOption {
        /// The field of [`SolveOptions`](crate::SolveOptions).
        name: &'static str,
        /// Its value.
        value: f64,
    },
}
