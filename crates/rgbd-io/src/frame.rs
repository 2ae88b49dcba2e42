//! One RGB-D frame and where frames come from.

use crate::{Image, Intrinsics, Mask};

/// One frame of an RGB-D video: colour and depth registered to each other, of one size.
#[derive(Clone, Debug)]
pub struct RgbdFrame {
    /// Name of the frame: the stem of its file, or a running number.
    pub id: String,
    /// RGB colour.
    pub color: Image<[u8; 3]>,
    /// z-depth in metres, `0` = missing.
    pub depth: Image<f32>,
    /// The object's mask, where one is given for this frame.
    pub mask: Option<Mask>,
    /// The camera.
    pub intrinsics: Intrinsics,
}

/// A sequence of frames that can be read in any order, from several threads at once.
pub trait FrameSource: Send + Sync {
    /// Number of frames.
    fn len(&self) -> usize;

    /// Whether there is no frame.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Name of frame `index` (the stem of its file); used for output files. Empty past the end.
    fn id(&self, index: usize) -> &str;

    /// Reads frame `index`.
    ///
    /// # Errors
    /// When a file of the frame is missing, truncated or of the wrong kind or size; the error names it.
    fn frame(&self, index: usize) -> Result<RgbdFrame, crate::Error>;
}

macro_rules! forward {
    ($pointer:ty) => {
        impl<S: FrameSource + ?Sized> FrameSource for $pointer {
            fn len(&self) -> usize {
                (**self).len()
            }

            fn id(&self, index: usize) -> &str {
                (**self).id(index)
            }

            fn frame(&self, index: usize) -> Result<RgbdFrame, crate::Error> {
                (**self).frame(index)
            }
        }
    };
}
forward!(&S);
forward!(Box<S>);
forward!(std::sync::Arc<S>);
