//! Region and boundary agreement of masks whose agreement is known.
#![allow(clippy::unwrap_used)]

use eval_metrics::{BOUNDARY_TOLERANCE, MaskRef, boundary_f, region_similarity};
use proptest::prelude::*;

const WIDTH: usize = 120;
const HEIGHT: usize = 90;

/// A rectangle with its corner at `(x, y)`.
fn rectangle(x: usize, y: usize, width: usize, height: usize) -> Vec<u8> {
    let inside = |i: usize| (x..x + width).contains(&(i % WIDTH)) && (y..y + height).contains(&(i / WIDTH));
    (0..WIDTH * HEIGHT).map(|i| 255 * u8::from(inside(i))).collect()
}

fn scores(a: &[u8], b: &[u8], tolerance: f64) -> (f64, f64) {
    let (a, b) = (MaskRef::new(a, WIDTH).unwrap(), MaskRef::new(b, WIDTH).unwrap());
    (region_similarity(a, b).unwrap(), boundary_f(a, b, tolerance).unwrap())
}

#[test]
fn known_answers() {
    let square = rectangle(30, 30, 40, 40);
    assert_eq!(scores(&square, &square, 0.0), (1.0, 1.0));
    // Half of it moved away: 20 of 60 columns are common.
    assert_eq!(scores(&square, &rectangle(50, 30, 40, 40), 0.0).0, 1.0 / 3.0);
    // One pixel to the side is within DAVIS' band (0.008 * 150 pixels, rounded up: 2), and not within one of none.
    let moved = rectangle(31, 30, 40, 40);
    assert_eq!(scores(&square, &moved, BOUNDARY_TOLERANCE), (39.0 / 41.0, 1.0));
    assert!(scores(&square, &moved, 0.0).1 < 0.6);
    // Ten pixels away nothing of the boundary fits, however much of the region does.
    let inner = rectangle(40, 40, 20, 20);
    assert_eq!(scores(&square, &inner, BOUNDARY_TOLERANCE), (0.25, 0.0));
}

#[test]
fn precision_and_recall_of_the_boundary() {
    // The mask has the true square and another one of the same shape: precision 1/2, recall 1.
    let truth = rectangle(10, 10, 20, 20);
    let both: Vec<u8> = truth.iter().zip(rectangle(70, 50, 20, 20)).map(|(a, b)| a | b).collect();
    let (j, f) = scores(&both, &truth, BOUNDARY_TOLERANCE);
    assert_eq!(j, 0.5);
    assert!((f - 2.0 / 3.0).abs() < 1e-12, "{f}");
}

#[test]
fn empty_masks_and_other_sizes() {
    let (empty, square) = (vec![0; WIDTH * HEIGHT], rectangle(30, 30, 40, 40));
    assert_eq!(scores(&empty, &empty, 0.008), (1.0, 1.0));
    assert_eq!(scores(&empty, &square, 0.008), (0.0, 0.0));
    assert_eq!(scores(&square, &empty, 0.008), (0.0, 0.0));
    assert!(MaskRef::new(&square, 7).is_none() && MaskRef::new(&square, 0).is_none());
    let (wide, tall) = (MaskRef::new(&square, WIDTH).unwrap(), MaskRef::new(&square, HEIGHT).unwrap());
    assert_eq!((region_similarity(wide, tall), boundary_f(wide, tall, 0.1)), (None, None));
}

proptest! {
    #[test]
    fn symmetric_and_bounded(
        a in (0_usize..80, 0_usize..60, 1_usize..40, 1_usize..30),
        b in (0_usize..80, 0_usize..60, 1_usize..40, 1_usize..30),
    ) {
        let (a, b) = (rectangle(a.0, a.1, a.2, a.3), rectangle(b.0, b.1, b.2, b.3));
        let (forth, back) = (scores(&a, &b, 0.008), scores(&b, &a, 0.008));
        prop_assert!((forth.0 - back.0).abs() < 1e-12 && (forth.1 - back.1).abs() < 1e-12);
        prop_assert!((0.0..=1.0).contains(&forth.0) && (0.0..=1.0).contains(&forth.1));
        // A wider band never lowers F.
        prop_assert!(scores(&a, &b, 0.05).1 >= forth.1);
    }
}
