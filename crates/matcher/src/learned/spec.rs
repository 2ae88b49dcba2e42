//! The name of a matcher on a command line.

use super::{Error, Network};
use std::fmt;
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// Which matcher to use: `classical`, `edgepoint2:FILE` or `xfeat:FILE`.
///
/// Reading the file is the caller's part; [`from_bytes`](super::from_bytes) takes what is in it.
///
/// ```
/// use matcher::learned::{MatcherSpec, Network};
/// let spec: MatcherSpec = "edgepoint2:weights/L64.pth".parse()?;
/// assert_eq!(spec.network(), Some(Network::EdgePoint2));
/// assert_eq!(spec.path(), Some("weights/L64.pth".as_ref()));
/// # Ok::<(), matcher::learned::Error>(())
/// ```
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum MatcherSpec {
    /// [`ScaleSpaceMatcher`](crate::ScaleSpaceMatcher): no file.
    #[default]
    Classical,
    /// A network and the file of its weights.
    Learned(Network, PathBuf),
}

impl MatcherSpec {
    /// The network, if it is one.
    pub fn network(&self) -> Option<Network> {
        match self {
            Self::Classical => None,
            Self::Learned(network, _) => Some(*network),
        }
    }

    /// The file of its weights, if it needs one.
    pub fn path(&self) -> Option<&Path> {
        match self {
            Self::Classical => None,
            Self::Learned(_, path) => Some(path),
        }
    }
}

impl FromStr for MatcherSpec {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self, Error> {
        let unknown = || Error::Spec { given: text.to_owned() };
        if text.eq_ignore_ascii_case("classical") {
            return Ok(Self::Classical);
        }
        let (name, path) = text.split_once(':').filter(|(_, path)| !path.is_empty()).ok_or_else(unknown)?;
        let network = match name.to_ascii_lowercase().as_str() {
            "edgepoint2" => Network::EdgePoint2,
            "xfeat" => Network::XFeat,
            _ => return Err(unknown()),
        };
        Ok(Self::Learned(network, path.into()))
    }
}

impl fmt::Display for MatcherSpec {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Classical => f.write_str("classical"),
            Self::Learned(Network::EdgePoint2, path) => write!(f, "edgepoint2:{}", path.display()),
            Self::Learned(Network::XFeat, path) => write!(f, "xfeat:{}", path.display()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_read_and_written() {
        for text in ["classical", "edgepoint2:a/b c.pth", "xfeat:C:\\weights\\xfeat.pt"] {
            assert_eq!(text.parse::<MatcherSpec>().unwrap().to_string(), text);
        }
        assert_eq!("XFeat:x".parse::<MatcherSpec>().unwrap().network(), Some(Network::XFeat));
        for text in ["", "sift", "edgepoint2", "xfeat:", ":x", "loftr:x"] {
            let error = text.parse::<MatcherSpec>().unwrap_err();
            assert!(error.to_string().contains("edgepoint2:FILE"), "{error}");
        }
    }
}
