//! The folder layout of one's own recordings.

use std::path::{Path, PathBuf};

use crate::depth_units::{Histogram, check_units};
use crate::layout::{self, CustomOptions, Entry, Layout};
use crate::{Error, FrameSource, Image, Intrinsics, RgbdFrame, codec, read_intrinsics};

/// A sequence in the custom layout:
///
/// | path | what |
/// |---|---|
/// | `rgb/*.png`, `.jpg`, `.jpeg` | colour, in natural order of the names (`2` before `10`) |
/// | `depth/<same name>.png` | 16-bit z-depth registered to colour and of its size, millimetres, `0` = missing |
/// | `masks/<same name>.png` | the object, any non-zero colour; `mask/` is accepted too |
/// | `cam_K.txt` | camera matrix of the colour images, 3x3, pixels |
///
/// A mask of another size but the same aspect ratio as its colour image is resized (nearest neighbour); depth of
/// another size is refused, because resizing doesn't register it.
#[derive(Clone, Debug)]
pub struct CustomFolder {
    root: PathBuf,
    entries: Vec<Entry>,
    intrinsics: Intrinsics,
    depth_scale: f64,
    size: (usize, usize),
}

impl CustomFolder {
    /// Lists the folder and checks its first frame; later frames are read when asked for.
    ///
    /// # Errors
    /// When the layout is incomplete, the camera matrix unusable, or the first frame unfit to start from:
    /// unreadable, of mismatched sizes, with an empty mask, without depth on the object, or with depth in other
    /// units than `depth_scale` says. The error names the file and the remedy. Depth that is missing for later
    /// frames is the error of those frames alone.
    pub fn open(path: impl AsRef<Path>, options: &CustomOptions) -> Result<Self, Error> {
        let root = path.as_ref();
        let layout = Layout::scan(root, options)?;
        let k_path = root.join("cam_K.txt");
        let intrinsics = read_intrinsics(&k_path)?;
        if let Some(problem) = layout.problems.into_iter().next() {
            return Err(problem);
        }
        let mut folder = Self {
            root: layout.root,
            entries: layout.entries,
            intrinsics,
            depth_scale: options.depth_scale,
            size: (0, 0),
        };
        folder.size = folder.check_first(&k_path)?;
        Ok(folder)
    }

    /// The folder.
    pub fn path(&self) -> &Path {
        &self.root
    }

    /// The camera of all frames.
    pub fn intrinsics(&self) -> Intrinsics {
        self.intrinsics
    }

    /// `(width, height)` of all frames, pixels.
    pub fn size(&self) -> (usize, usize) {
        self.size
    }

    /// The colour image of frame `index`, as a path; for writing beside it or naming it in a message.
    pub fn color_path(&self, index: usize) -> Option<&Path> {
        self.entries.get(index).map(|e| e.color.as_path())
    }

    /// Whether frame `index` has a depth file; one that can't be read counts.
    pub fn has_depth(&self, index: usize) -> bool {
        self.entries.get(index).is_some_and(|e| e.depth.is_some())
    }

    /// Reads colour alone, which is several times faster than [`FrameSource::frame`] for previews.
    ///
    /// # Errors
    /// When the file is missing, damaged or of another size than the first.
    pub fn color(&self, index: usize) -> Result<Image<[u8; 3]>, Error> {
        let entry = self.entry(index)?;
        let color = codec::read_color(&entry.color)?;
        if color.size() != self.size {
            let ((w, h), (fw, fh)) = (color.size(), self.size);
            let problem = format!("has {w}x{h} pixels but the first image {fw}x{fh}");
            return Err(Error::new(&entry.color, problem, "use images of one size, from one camera setting"));
        }
        Ok(color)
    }

    fn entry(&self, index: usize) -> Result<&Entry, Error> {
        self.entries.get(index).ok_or_else(|| {
            let problem = format!("has {} frames, so none with index {index}", self.entries.len());
            Error::new(&self.root, problem, "ask for a smaller index")
        })
    }

    /// Reads the first frame with all checks that a whole sequence stands or falls with; its size.
    fn check_first(&self, k_path: &Path) -> Result<(usize, usize), Error> {
        let entry = self.entry(0)?;
        let size = codec::read_color(&entry.color)?.size();
        layout::check_principal_point(&self.intrinsics, k_path, size)?;
        let depth = layout::read_depth(&self.root, entry, size)?;
        let depth_path = entry.depth.as_deref().unwrap_or(&self.root);
        let mask = entry.mask.as_deref().map(|path| (path, layout::read_mask(path, size))).map(
            |(path, mask)| -> Result<_, Error> {
                let mask = mask?;
                layout::check_not_empty(path, &mask)?;
                Ok(mask)
            },
        );
        let mask = mask.transpose()?;
        let mut histogram = Histogram::new();
        histogram.add(&depth, mask.as_ref());
        match histogram.percentile(0.5) {
            Some(median) => check_units(depth_path, median, self.depth_scale)?,
            None => return Err(no_depth(depth_path, mask.is_some())),
        }
        Ok(size)
    }
}

/// The first frame has no depth, at least not where it counts.
pub(crate) fn no_depth(path: &Path, in_mask: bool) -> Error {
    let problem = if in_mask { "holds no depth inside the object's mask" } else { "holds no depth at all" };
    let remedy = "start at a frame with depth on the object, and check that mask and depth belong to this frame and \
                  that the object isn't too near, shiny or transparent for the camera";
    Error::new(path, problem, remedy)
}

impl FrameSource for CustomFolder {
    fn len(&self) -> usize {
        self.entries.len()
    }

    fn id(&self, index: usize) -> &str {
        self.entries.get(index).map_or("", |e| e.id.as_str())
    }

    fn frame(&self, index: usize) -> Result<RgbdFrame, Error> {
        let entry = self.entry(index)?;
        let color = self.color(index)?;
        let scale = self.depth_scale;
        let depth = layout::read_depth(&self.root, entry, self.size)?;
        // In f64: 0.001 isn't an f32, and 500 mm should be the f32 nearest to 0.5.
        let depth = depth.map(|raw| (f64::from(*raw) * scale) as f32);
        let mask = entry.mask.as_deref().map(|path| layout::read_mask(path, self.size)).transpose()?;
        Ok(RgbdFrame { id: entry.id.clone(), color, depth, mask, intrinsics: self.intrinsics })
    }
}
