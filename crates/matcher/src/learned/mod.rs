//! Matchers learned from data, in plain Rust: EdgePoint2 and XFeat, with weights that the caller has.
//!
//! Where the classical matcher finds a few very precise correspondences, these find many, across wider changes of view;
//! like it, they need the roll removed ([`RollCrop`](crate::RollCrop)). The file of weights, as its authors publish it,
//! is downloaded by the user and handed over as bytes; nothing here reads files, and nothing in them is executed.
//!
//! Two small networks do not need an inference engine: both are chains of a few dozen convolutions, and all of those run
//! in one inner loop, written once and compiled for the processor's instruction sets. The work is spread over the
//! threads of the rayon pool in which [`detect`](crate::FeatureMatcher::detect) is called; results do not depend on
//! their number.
//!
//! One thing differs from the authors' code: an image whose sides are not multiples of 32 is continued at its edges
//! instead of being resized, which keeps pixels what they are.
//!
//! ```no_run
//! use matcher::learned::{self, MatcherSpec};
//! use matcher::{FeatureMatcher, ScaleSpaceMatcher};
//!
//! let spec: MatcherSpec = "edgepoint2:EdgePoint2_L64.pth".parse()?;
//! let matcher: Box<dyn FeatureMatcher> = match spec.path() {
//!     Some(path) => learned::from_bytes(spec.network(), &std::fs::read(path)?)?,
//!     None => Box::new(ScaleSpaceMatcher::default()),
//! };
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod cosine;
mod detect;
mod edgepoint2;
mod error;
mod keypoints;
mod nn;
mod spec;
mod weights;
mod xfeat;

pub use edgepoint2::{EdgePoint2, EdgePoint2Maps};
pub use error::Error;
pub use spec::MatcherSpec;
pub use weights::{Tensor, Weights};
pub use xfeat::{XFeat, XFeatMaps};

use crate::matching::FeatureMatcher;

/// A network that can be loaded.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Network {
    /// [`EdgePoint2`] of any size.
    EdgePoint2,
    /// [`XFeat`], sparse.
    XFeat,
}

/// How the features of a network are chosen and matched.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LearnedOptions {
    /// At most this many keypoints of a crop, strongest first.
    pub max_features: usize,
    /// Keypoints keep this distance from the background, crop pixels: the silhouette slides over a turning object.
    pub border: usize,
    /// Cosine of the descriptors at which a match begins to count; its confidence rises from there.
    pub min_cosine: f32,
    /// Whether the background is replaced by a smooth continuation of the object: a fifth more matches on a bottle
    /// that is turned in front of a table.
    pub fill_background: bool,
}

impl Default for LearnedOptions {
    fn default() -> Self {
        Self { max_features: 500, border: 2, min_cosine: 0.75, fill_background: true }
    }
}

/// The matcher of a file of weights (safetensors, or PyTorch's `.pth` and `.pt`), with default options. Without
/// `network`, it is told from the names of the tensors.
///
/// # Errors
/// Everything that [`Error`] lists but a wrong specification.
pub fn from_bytes(network: Option<Network>, bytes: &[u8]) -> Result<Box<dyn FeatureMatcher>, Error> {
    let weights = Weights::from_bytes(bytes)?;
    let options = LearnedOptions::default();
    let network = network.or_else(|| recognise(&weights));
    match network.ok_or(Error::UnknownNetwork { count: weights.len() })? {
        Network::EdgePoint2 => Ok(Box::new(EdgePoint2::new(&weights, options)?)),
        Network::XFeat => Ok(Box::new(XFeat::new(&weights, options)?)),
    }
}

/// The network that has these tensors.
fn recognise(weights: &Weights) -> Option<Network> {
    if weights.has_conv("score_head.0") && weights.has_conv("desc_head.0") {
        Some(Network::EdgePoint2)
    } else if weights.has_conv("block_fusion.0") && weights.has_conv("keypoint_head.0") {
        Some(Network::XFeat)
    } else {
        None
    }
}
