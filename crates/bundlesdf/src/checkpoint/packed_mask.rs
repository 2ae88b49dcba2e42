//! A mask as run lengths: a few kilobytes for the outline of one object.

use rgbd_io::{Image, Mask};
use serde::{Deserialize, Serialize};

/// Lengths of alternating runs of background and object, row after row, background first.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct PackedMask {
    width: u32,
    height: u32,
    runs: Vec<u32>,
}

impl PackedMask {
    pub(crate) fn new(mask: &Mask) -> Self {
        /// Pixels that are compared at once.
        const STEP: usize = 32;
        let (mut runs, mut object, mut rest) = (Vec::new(), false, mask.pixels());
        loop {
            let goes_on = |p: &u8| (*p != 0) == object;
            let whole = |chunk: &&[u8]| chunk.iter().fold(true, |all, p| all & goes_on(p));
            let skipped = STEP * rest.chunks_exact(STEP).take_while(whole).count();
            let length = rest.iter().skip(skipped).take_while(|p| goes_on(p)).count() + skipped;
            runs.push(length as u32);
            rest = &rest[length..];
            if rest.is_empty() {
                break;
            }
            object = !object;
        }
        Self { width: mask.width() as u32, height: mask.height() as u32, runs }
    }

    /// The mask, 255 = object; `None` when the runs don't fill the image.
    pub(crate) fn unpack(&self) -> Option<Mask> {
        let (width, height) = (self.width as usize, self.height as usize);
        let total: u64 = self.runs.iter().map(|r| u64::from(*r)).sum();
        if total != u64::from(self.width) * u64::from(self.height) {
            return None;
        }
        let mut pixels = Vec::with_capacity(width * height);
        for (i, run) in self.runs.iter().enumerate() {
            pixels.resize(pixels.len() + *run as usize, if i % 2 == 0 { 0 } else { 255 });
        }
        Image::from_vec(width, height, pixels)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn any_mask_comes_back() {
        let shapes: [&dyn Fn(usize, usize) -> bool; 5] =
            [&|_, _| false, &|_, _| true, &|x, y| (x + y) % 2 == 0, &|x, y| x > 3 && y > 2, &|x, y| {
                (x * 7 + y * 13) % 5 == 0
            }];
        for shape in shapes {
            let mask = Image::from_fn(13, 7, |x, y| if shape(x, y) { 255 } else { 0 });
            assert_eq!(PackedMask::new(&mask).unpack().unwrap(), mask);
        }
        assert!(PackedMask { width: 3, height: 3, runs: vec![4, 4] }.unpack().is_none());
    }
}
