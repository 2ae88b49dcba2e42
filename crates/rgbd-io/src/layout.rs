//! Which files make up a custom folder, and how one frame of them is read.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use crate::listing::{self, Listed};
use crate::{Error, Image, Intrinsics, Mask, codec};

/// Where the object's masks come from.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum MaskSource {
    /// `masks/` (or `mask/`) for the first frame only; later frames have no mask, even where a file exists.
    #[default]
    First,
    /// `masks/` (or `mask/`), one for every frame.
    All,
    /// This folder, one for every frame. A relative path is tried from the sequence's folder first.
    Folder(PathBuf),
    /// No masks at all; for looking at frames, not for tracking.
    None,
}

/// How to read a custom folder.
#[derive(Clone, Debug, PartialEq)]
pub struct CustomOptions {
    /// Where masks come from.
    pub masks: MaskSource,
    /// Metres per unit of the depth files; 0.001 for millimetres.
    pub depth_scale: f64,
    /// Every how many frames one is used, from the first on; 0 counts as 1.
    pub stride: usize,
    /// The first frame's mask, if it isn't in the folder that `masks` names.
    pub first_mask: Option<PathBuf>,
}

impl Default for CustomOptions {
    fn default() -> Self {
        Self { masks: MaskSource::First, depth_scale: 0.001, stride: 1, first_mask: None }
    }
}

/// The files of one frame; `None` where there is none.
#[derive(Clone, Debug)]
pub(crate) struct Entry {
    pub(crate) id: String,
    pub(crate) color: PathBuf,
    pub(crate) depth: Option<PathBuf>,
    pub(crate) mask: Option<PathBuf>,
}

/// What a folder holds, before any image is read.
#[derive(Clone, Debug)]
pub(crate) struct Layout {
    pub(crate) root: PathBuf,
    /// At least one.
    pub(crate) entries: Vec<Entry>,
    /// Number of files before the stride.
    pub(crate) color_files: usize,
    pub(crate) depth_files: usize,
    pub(crate) mask_files: usize,
    /// What prevents the folder from being used; empty for a good one.
    pub(crate) problems: Vec<Error>,
}

impl Layout {
    /// Lists the files; fails only when there are no colour images to start from.
    pub(crate) fn scan(root: &Path, options: &CustomOptions) -> Result<Self, Error> {
        let colors = list_colors(root)?;
        let mut problems = Vec::new();
        let scale = options.depth_scale;
        if !(scale.is_finite() && scale > 0.0) {
            let remedy = "pass --depth-scale with the metres per unit, 0.001 for millimetres";
            problems.push(Error::new(root, format!("can't be read with a depth scale of {scale}"), remedy));
        }
        let depths = by_stem(list_depths(root), &mut problems);
        let masks = by_stem(list_masks(root, &options.masks), &mut problems);

        let mut entries: Vec<Entry> = colors
            .iter()
            .step_by(options.stride.max(1))
            .map(|(id, color)| Entry {
                id: id.clone(),
                color: color.clone(),
                depth: depths.get(id).cloned(),
                mask: masks.get(id).cloned(),
            })
            .collect();
        if options.masks == MaskSource::First {
            for entry in entries.iter_mut().skip(1) {
                entry.mask = None;
            }
        }
        if let (Some(first), Some(mask)) = (entries.first_mut(), &options.first_mask) {
            first.mask = Some(mask.clone());
        }
        let layout = Self {
            root: root.to_path_buf(),
            color_files: colors.len(),
            depth_files: depths.len(),
            mask_files: masks.len(),
            entries,
            problems,
        };
        Ok(layout.with_missing_files(options))
    }

    /// Notes the files that have to be there before the first frame is read.
    fn with_missing_files(mut self, options: &CustomOptions) -> Self {
        let Some(first) = self.entries.first() else { return self };
        if self.depth_files > 0 && first.depth.is_none() {
            self.problems.push(missing_depth(&self.root, first));
        }
        let folder = mask_folder(&self.root, &options.masks);
        if options.masks != MaskSource::None && first.mask.is_none() {
            self.problems.push(missing_first_mask(&folder, first));
        }
        if matches!(options.masks, MaskSource::All | MaskSource::Folder(_)) {
            let missing: Vec<&Entry> = self.entries.iter().skip(1).filter(|e| e.mask.is_none()).collect();
            if let Some(entry) = missing.first() {
                self.problems.push(Error::new(
                    folder.join(format!("{}.png", entry.id)),
                    format!("is missing, and {} masks in all", missing.len()),
                    "add a mask for every frame (all black where the object isn't visible), or use the first mask only",
                ));
            }
        }
        self
    }
}

fn list_colors(root: &Path) -> Result<Vec<Listed>, Error> {
    if !root.is_dir() {
        let problem = if root.exists() { "isn't a folder" } else { "no such folder" };
        return Err(Error::new(
            root,
            problem,
            "give the folder that holds rgb/, depth/, masks/ and cam_K.txt",
        ));
    }
    let dir = root.join("rgb");
    let remedy = "put the colour images there as rgb/0000.png, rgb/0001.png, ... (or .jpg)";
    if !dir.is_dir() {
        return Err(Error::new(dir, "no such folder", remedy));
    }
    let colors = listing::files(&dir, &["png", "jpg", "jpeg"])?;
    if colors.is_empty() {
        return Err(Error::new(dir, "holds no .png or .jpg images", remedy));
    }
    let mut seen: HashMap<&str, &Path> = HashMap::new();
    for (stem, path) in &colors {
        if let Some(other) = seen.insert(stem, path) {
            let problem = format!("names the same frame as {}", other.display());
            return Err(Error::new(path, problem, "keep one of the two files"));
        }
    }
    Ok(colors)
}

fn list_depths(root: &Path) -> Result<Vec<Listed>, Error> {
    let dir = root.join("depth");
    let remedy = "put one 16-bit PNG in millimetres there for every colour image, under the same name";
    if !dir.is_dir() {
        return Err(Error::new(dir, "no such folder", remedy));
    }
    let depths = listing::files(&dir, &["png"])?;
    if depths.is_empty() {
        let other =
            listing::files(&dir, &["exr", "tif", "tiff", "npy", "npz", "pfm", "pgm", "raw", "jpg", "jpeg"])?;
        let problem = match other.first().and_then(|(_, path)| path.file_name()) {
            Some(name) => {
                format!("holds no .png files but {} such as {}", other.len(), name.to_string_lossy())
            }
            None => "holds no .png files".to_owned(),
        };
        return Err(Error::new(dir, problem, remedy));
    }
    Ok(depths)
}

fn list_masks(root: &Path, masks: &MaskSource) -> Result<Vec<Listed>, Error> {
    if *masks == MaskSource::None {
        return Ok(Vec::new());
    }
    let dir = mask_folder(root, masks);
    // A missing default folder is reported with the first mask, which may also come from elsewhere.
    match masks {
        MaskSource::First if !dir.is_dir() => Ok(Vec::new()),
        _ if !dir.is_dir() => Err(Error::new(
            dir,
            "no such folder",
            "put one mask there for every colour image, under the same name",
        )),
        _ => listing::files(&dir, &["png"]),
    }
}

fn mask_folder(root: &Path, masks: &MaskSource) -> PathBuf {
    let (plural, singular) = (root.join("masks"), root.join("mask"));
    match masks {
        MaskSource::Folder(dir) => {
            let inside = root.join(dir);
            if inside.is_dir() { inside } else { dir.clone() }
        }
        _ if !plural.is_dir() && singular.is_dir() => singular,
        _ => plural,
    }
}

fn by_stem(files: Result<Vec<Listed>, Error>, problems: &mut Vec<Error>) -> HashMap<String, PathBuf> {
    files.map_err(|e| problems.push(e)).unwrap_or_default().into_iter().collect()
}

pub(crate) fn missing_depth(root: &Path, entry: &Entry) -> Error {
    let path = root.join("depth").join(format!("{}.png", entry.id));
    let problem = format!("is missing, so {} has no depth", entry.color.display());
    Error::new(path, problem, "export the depth image, or leave the colour image out")
}

fn missing_first_mask(folder: &Path, entry: &Entry) -> Error {
    let remedy = format!(
        "open {} in an image editor, paint the object white and all else black, and save that there at the same \
         size (or pass --first-mask FILE)",
        entry.color.display()
    );
    Error::new(folder.join(format!("{}.png", entry.id)), "is missing: the first frame needs a mask", remedy)
}

/// Reads a frame's depth, which must have the size of its colour image.
pub(crate) fn read_depth(root: &Path, entry: &Entry, size: (usize, usize)) -> Result<Image<u16>, Error> {
    let path = entry.depth.as_ref().ok_or_else(|| missing_depth(root, entry))?;
    let depth = match codec::read_depth_u16(path) {
        // The file was there when the folder was listed.
        Err(_) if !path.exists() => return Err(missing_depth(root, entry)),
        other => other?,
    };
    if depth.size() != size {
        let ((w, h), (cw, ch)) = (depth.size(), size);
        let problem = format!("has {w}x{h} pixels but its colour image {cw}x{ch}");
        let remedy = "register depth to colour (the camera's software calls it aligned depth) and save it at \
                      the colour image's size";
        return Err(Error::new(path, problem, remedy));
    }
    Ok(depth)
}

/// Reads a frame's mask at the size of its colour image: nearest-neighbour resized from the same aspect ratio.
pub(crate) fn read_mask(path: &Path, size: (usize, usize)) -> Result<Mask, Error> {
    fit_mask(codec::read_mask(path)?, path, size)
}

/// A mask at `size`; see [`read_mask`].
pub(crate) fn fit_mask(mask: Mask, path: &Path, size: (usize, usize)) -> Result<Mask, Error> {
    if mask.size() == size {
        return Ok(mask);
    }
    let ((w, h), (cw, ch)) = (mask.size(), size);
    let (a, b) = ((w * ch) as f64, (h * cw) as f64);
    if (a - b).abs() > 0.01 * a.max(b) {
        let problem = format!("has {w}x{h} pixels but its colour image {cw}x{ch}, another aspect ratio");
        return Err(Error::new(path, problem, "save the mask at the colour image's size"));
    }
    Ok(codec::resize_nearest(&mask, size))
}

/// Fails on a first mask without any object pixel.
pub(crate) fn check_not_empty(path: &Path, mask: &Mask) -> Result<(), Error> {
    if mask.pixels().iter().all(|v| *v == 0) {
        let remedy = "paint the object white in it, or start at a frame in which the object is visible";
        return Err(Error::new(path, "marks no pixel as object", remedy));
    }
    Ok(())
}

/// Fails when the principal point lies outside an image of `size`.
pub(crate) fn check_principal_point(k: &Intrinsics, path: &Path, size: (usize, usize)) -> Result<(), Error> {
    let (w, h) = (size.0 as f64, size.1 as f64);
    if (0.0..w).contains(&k.cx) && (0.0..h).contains(&k.cy) {
        return Ok(());
    }
    let problem =
        format!("its principal point ({:.1}, {:.1}) lies outside the images of {w}x{h} pixels", k.cx, k.cy);
    Err(Error::new(path, problem, rescale_remedy(k, size)))
}

/// How to repair a camera matrix that belongs to another resolution.
pub(crate) fn rescale_remedy(k: &Intrinsics, size: (usize, usize)) -> String {
    let (sx, sy) = (size.0 as f64 / (2.0 * k.cx), size.1 as f64 / (2.0 * k.cy));
    if k.cx > 0.0 && k.cy > 0.0 && (sx / sy - 1.0).abs() < 0.2 {
        let (w, h) = (2.0 * k.cx, 2.0 * k.cy);
        return format!(
            "it looks calibrated for about {w:.0}x{h:.0} pixels: multiply its first two rows by {:.3}, or use the \
             camera matrix of these images",
            (sx * sy).sqrt()
        );
    }
    "write the camera matrix of these very images: after resizing multiply its first two rows by the same factor, \
     after cropping subtract the crop's corner from cx and cy"
        .to_owned()
}
