//! Masks from another program and from a folder.
#![allow(clippy::unwrap_used, missing_docs)]

use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use bundlesdf::segmenter::{CommandSegmenter, FolderSegmenter, OnTrouble, Patience};
use mask_tracker::{Prior, VideoSegmenter};
use rgbd_io::{FrameSource, Image, Mask};
use rgbd_synth::{Masks, Sequence};

fn iou(a: &Mask, b: &Mask) -> f64 {
    let pairs = || a.pixels().iter().zip(b.pixels());
    let both = pairs().filter(|(a, b)| **a != 0 && **b != 0).count();
    both as f64 / pairs().filter(|(a, b)| **a != 0 || **b != 0).count().max(1) as f64
}

/// What was said about trouble, and who says it.
fn listener() -> (Arc<Mutex<Vec<String>>>, OnTrouble) {
    let said = Arc::new(Mutex::new(Vec::new()));
    let copy = said.clone();
    (said, Arc::new(move |text: &str| copy.lock().unwrap().push(text.to_owned())))
}

fn stand_in() -> String {
    // Examples are built with the tests, beside the folder that these run in.
    let mut path = std::env::current_exe().unwrap();
    path.pop();
    path.pop();
    path.push("examples");
    path.push(format!("segmenter_stand_in{}", std::env::consts::EXE_SUFFIX));
    assert!(path.exists(), "{} isn't built: run all of the package's tests", path.display());
    path.to_string_lossy().into_owned()
}

/// Follows `frames` frames with the stand-in; the lowest IoU and what was said.
fn follow(arguments: &[&str], patience: Patience, frames: usize) -> (f64, Vec<String>) {
    let video = Sequence::tiny().with_masks(Masks::First);
    let words: Vec<String> =
        std::iter::once(stand_in()).chain(arguments.iter().map(|a| (*a).to_owned())).collect();
    let (said, listen) = listener();
    let mut segmenter = CommandSegmenter::spawn(&words, patience, listen).unwrap();
    let first = video.render(0);
    segmenter.start(&first.frame, &first.visible_mask);
    let mut lowest = 1.0f64;
    for k in 1..frames {
        let shot = video.render(k);
        let found = segmenter.next(&shot.frame, &Prior::default());
        let found = segmenter.refine(&shot.frame, found, &Prior::default());
        assert_eq!(found.mask.size(), shot.frame.color.size());
        lowest = lowest.min(iou(&found.mask, &shot.visible_mask));
    }
    drop(segmenter);
    let said = said.lock().unwrap().clone();
    (lowest, said)
}

#[test]
fn a_program_gives_the_masks() {
    let (lowest, said) = follow(&[], Patience::default(), 6);
    assert!(said.is_empty(), "{said:?}");
    assert!(lowest > 0.3, "{lowest}");
}

#[test]
fn whatever_a_program_does_wrong_the_built_in_segmenter_goes_on() {
    let patience = Patience { start: Duration::from_secs(60), frame: Duration::from_secs(60) };
    for (how, what) in [("crash", "without an answer"), ("garbage", "loading weights"), ("half", "broke")] {
        let (lowest, said) = follow(&["--fail", how], patience, 6);
        assert_eq!(said.len(), 1, "{how}: {said:?}");
        assert!(said[0].contains(what) && said[0].contains("000003"), "{how}: {said:?}");
        assert!(lowest > 0.3, "{how}: {lowest}");
    }
    let hurried = Patience { frame: Duration::from_millis(1500), ..patience };
    let (_, said) = follow(&["--fail", "hang"], hurried, 5);
    assert!(said[0].contains("no answer within 1.5 s"), "{said:?}");
}

#[test]
fn a_program_that_is_not_there_is_named() {
    let words = ["no-such-program-anywhere".to_owned()];
    let error = CommandSegmenter::spawn(&words, Patience::default(), listener().1).err().unwrap();
    assert!(error.to_string().contains("no-such-program-anywhere"), "{error}");
}

#[test]
fn a_folder_of_masks_of_other_names_and_size_is_used() {
    let video = Sequence::tiny().with_masks(Masks::First).truncated(4);
    let dir = tempfile::tempdir().unwrap();
    let file = |k: usize| -> PathBuf { dir.path().join(format!("mask-{k}.png")) };
    for k in 0..4 {
        let mask = video.visible_mask(k);
        let large = Image::from_fn(2 * mask.width(), 2 * mask.height(), |x, y| mask[(x / 2, y / 2)]);
        rgbd_io::write_png_mask(&file(k), &large).unwrap();
    }
    std::fs::write(file(2), b"no png").unwrap();
    let (said, listen) = listener();
    let mut segmenter = FolderSegmenter::open(dir.path(), &video, listen).unwrap();
    let first = video.render(0);
    segmenter.start(&first.frame, &first.visible_mask);
    for k in 1..4 {
        let shot = video.render(k);
        let found = segmenter.next(&shot.frame, &Prior::default());
        let found = segmenter.refine(&shot.frame, found, &Prior::default());
        let j = iou(&found.mask, &shot.visible_mask);
        assert!(if k == 2 { j > 0.6 } else { j == 1.0 }, "{k}: {j}");
    }
    assert_eq!(said.lock().unwrap().len(), 1);
    assert_eq!(video.id(2), "000002");
    let empty = tempfile::tempdir().unwrap();
    let error = FolderSegmenter::open(empty.path(), &video, listener().1).err().unwrap();
    assert!(error.to_string().contains("0 masks"), "{error}");
}
