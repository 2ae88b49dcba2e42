//! The first mask on rendered scenes whose true mask is known.
#![allow(clippy::unwrap_used, missing_docs)]

use mask_tracker::{Hints, first_mask};
use rgbd_io::Mask;
use rgbd_synth::Sequence;

fn iou(a: &Mask, b: &Mask) -> f64 {
    let pairs = || a.pixels().iter().zip(b.pixels());
    let both = pairs().filter(|(a, b)| **a != 0 && **b != 0).count();
    both as f64 / pairs().filter(|(a, b)| **a != 0 || **b != 0).count().max(1) as f64
}

/// The box around the mask, 15 % larger.
fn loose_box(mask: &Mask) -> [f32; 4] {
    let (w, h) = mask.size();
    let inside = |x: usize, y: usize| mask[(x, y)] != 0;
    let columns: Vec<usize> = (0..w).filter(|&x| (0..h).any(|y| inside(x, y))).collect();
    let rows: Vec<usize> = (0..h).filter(|&y| (0..w).any(|x| inside(x, y))).collect();
    let side = |v: &[usize]| (v[0] as f32, (v[v.len() - 1] - v[0] + 1) as f32);
    let ((x, bw), (y, bh)) = (side(&columns), side(&rows));
    [x - 0.075 * bw, y - 0.075 * bh, 1.15 * bw, 1.15 * bh]
}

#[test]
fn a_loose_box_is_enough() {
    for name in ["symmetric", "moving-camera", "large-near"] {
        let shot = Sequence::named(name).unwrap().render(0);
        let hints = Hints { rectangle: Some(loose_box(&shot.visible_mask)), ..Hints::default() };
        let j = iou(&first_mask(&shot.frame, &hints).unwrap(), &shot.visible_mask);
        println!("{name}: {j:.3}");
        assert!(j > 0.9, "{name}: {j}");
    }
}

#[test]
fn points_grow_to_the_object() {
    let shot = Sequence::named("large-near").unwrap().render(0);
    let [x, y, w, h] = loose_box(&shot.visible_mask);
    let object = [0.45, 0.6, 0.75].map(|s| [x + 0.5 * w, y + s * h]).to_vec();
    let j = iou(&first_mask(&shot.frame, &Hints { object, ..Hints::default() }).unwrap(), &shot.visible_mask);
    assert!(j > 0.85, "{j}");
}

#[test]
fn hints_outside_the_image_find_nothing() {
    let shot = Sequence::tiny().render(0);
    let outside = Hints { rectangle: Some([9000.0, 9000.0, 50.0, 50.0]), ..Hints::default() };
    let broken = Hints { rectangle: Some([f32::NAN; 4]), ..Hints::default() };
    let far = Hints { object: vec![[-50.0, -50.0]], ..Hints::default() };
    for hints in [outside, broken, far, Hints::default()] {
        assert_eq!(first_mask(&shot.frame, &hints), None, "{hints:?}");
    }
}
