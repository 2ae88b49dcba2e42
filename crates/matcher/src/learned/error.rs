//! Why a network could not be loaded.

/// Why a file of weights was refused. Every message says what to do about it.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// Neither of the two file formats.
    #[error(
        "the file is neither safetensors nor a PyTorch archive (it starts with {start}): download the network's own \
         .pth, .pt or .safetensors file, not the web page or the Git LFS pointer that stands for it"
    )]
    UnknownFormat {
        /// First bytes, readable.
        start: String,
    },
    /// The file ends early or contradicts itself.
    #[error("the {format} file is damaged: {problem}; download it again")]
    Damaged {
        /// The file's format.
        format: &'static str,
        /// What does not fit.
        problem: String,
    },
    /// A valid file with something that is not read here.
    #[error(
        "the {format} file has {what}, which is not supported: save the state dict as 32-bit safetensors instead"
    )]
    Unsupported {
        /// The file's format.
        format: &'static str,
        /// What is not supported.
        what: String,
    },
    /// No known network has these tensors.
    #[error(
        "the {count} tensors are those of no known network: give the weights of EdgePoint2 (T32 to E64) or of XFeat"
    )]
    UnknownNetwork {
        /// Number of tensors in the file.
        count: usize,
    },
    /// A tensor is missing or has another shape.
    #[error("tensor `{name}` {problem}: the file is not one of {network}'s, or of another version of it")]
    Tensor {
        /// The tensor's name.
        name: String,
        /// What is wrong with it.
        problem: String,
        /// The network it was read for.
        network: &'static str,
    },
    /// A matcher's name that is not one.
    #[error("unknown matcher `{given}`: use `classical`, `edgepoint2:FILE` or `xfeat:FILE`")]
    Spec {
        /// What was given.
        given: String,
    },
}
