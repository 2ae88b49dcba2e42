//! Masks from a folder.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use mask_tracker::{Prior, Propagate, Segmentation, VideoSegmenter, pair_masks, resample};
use rgbd_io::{Error, FrameSource, Image, Mask, RgbdFrame};

use super::OnTrouble;

/// Takes each frame's mask from a folder of PNG files, matched by name, trailing number or order, of any size.
///
/// A frame without a mask, or with one that can't be read, is segmented by the built-in segmenter.
pub struct FolderSegmenter {
    masks: HashMap<String, PathBuf>,
    builtin: Propagate,
    given: bool,
    on_trouble: OnTrouble,
}

impl FolderSegmenter {
    /// Lists the masks in `dir` for the frames of `source`.
    ///
    /// # Errors
    /// When the folder can't be listed or its files can't be matched with the frames.
    pub fn open(dir: &Path, source: &dyn FrameSource, on_trouble: OnTrouble) -> Result<Self, Error> {
        let remedy = "give --segmenter folder:DIR the folder of the masks, one PNG file a frame";
        let failed = |e: std::io::Error| Error::new(dir, format!("can't be listed ({e})"), remedy);
        let mut files: Vec<PathBuf> = Vec::new();
        for entry in std::fs::read_dir(dir).map_err(failed)? {
            let path = entry.map_err(failed)?.path();
            let is_hidden = path.file_name().is_some_and(|n| n.to_string_lossy().starts_with('.'));
            if path.extension().is_some_and(|e| e.eq_ignore_ascii_case("png")) && !is_hidden {
                files.push(path);
            }
        }
        files.sort();
        let stems: Vec<String> =
            files.iter().filter_map(|f| Some(f.file_stem()?.to_string_lossy().into_owned())).collect();
        let stems: Vec<&str> = stems.iter().map(String::as_str).collect();
        let ids: Vec<&str> = (0..source.len()).map(|i| source.id(i)).collect();
        let pairs = pair_masks(&ids, &stems).map_err(|e| Error::new(dir, e.to_string(), remedy))?;
        let masks = ids
            .iter()
            .zip(pairs)
            .filter_map(|(id, mask)| Some(((*id).to_owned(), files.get(mask?)?.clone())))
            .collect();
        Ok(Self { masks, builtin: Propagate::default(), given: false, on_trouble })
    }

    fn read(&self, frame: &RgbdFrame) -> Option<Mask> {
        match rgbd_io::read_mask(self.masks.get(&frame.id)?) {
            Ok(mask) => Some(resample(&mask, frame.color.size())),
            Err(error) => {
                (self.on_trouble)(&format!("{error}; the built-in segmenter takes this frame"));
                None
            }
        }
    }
}

impl VideoSegmenter for FolderSegmenter {
    fn start(&mut self, frame: &RgbdFrame, mask: &Mask) {
        self.builtin.start(frame, mask);
    }

    fn next(&mut self, frame: &RgbdFrame, prior: &Prior<'_>) -> Segmentation {
        let mask = self.read(frame);
        self.given = mask.is_some();
        match mask {
            None => self.builtin.next(frame, prior),
            Some(mask) => {
                let found = Segmentation::new(mask, 1.0);
                // The built-in one goes on from the last mask that there was.
                if found.area > 0 {
                    self.builtin.start(frame, &found.mask);
                }
                found
            }
        }
    }

    fn refine(&mut self, frame: &RgbdFrame, found: Segmentation, prior: &Prior<'_>) -> Segmentation {
        if self.given {
            if found.area > 0 {
                let copy = Segmentation::new(Image::default(), 1.0);
                self.builtin.refine(frame, copy, prior);
            }
            return found;
        }
        self.builtin.refine(frame, found, prior)
    }
}
