//! How good a mask is: region similarity J and boundary measure F (Perazzi et al., CVPR 2016).

use eval_metrics::{BOUNDARY_TOLERANCE, MaskRef, boundary_f, region_similarity};
use rgbd_io::Mask;

/// Region similarity J; masks of different sizes have nothing in common.
pub(super) fn region(mask: &Mask, truth: &Mask) -> f64 {
    pair(mask, truth).and_then(|(m, t)| region_similarity(m, t)).unwrap_or(0.0)
}

/// Boundary measure F at the usual tolerance.
pub(super) fn boundary(mask: &Mask, truth: &Mask) -> f64 {
    pair(mask, truth).and_then(|(m, t)| boundary_f(m, t, BOUNDARY_TOLERANCE)).unwrap_or(0.0)
}

fn pair<'a>(mask: &'a Mask, truth: &'a Mask) -> Option<(MaskRef<'a>, MaskRef<'a>)> {
    let by_ref = |m: &'a Mask| MaskRef::new(m.pixels(), m.width());
    Some((by_ref(mask)?, by_ref(truth)?))
}

/// How often the object came back after it was gone, and how often it was found within five frames.
pub(super) fn reappearances(areas: &[usize], regions: &[f64]) -> (usize, usize) {
    const WITHIN: usize = 5;
    let whole = areas.first().copied().unwrap_or(0) as f64;
    let (mut cases, mut found) = (0, 0);
    let mut gone = 0;
    for (i, &area) in areas.iter().enumerate() {
        let share = area as f64 / whole.max(1.0);
        if share < 0.02 {
            gone += 1;
        } else if share > 0.1 {
            if gone >= 3 {
                cases += 1;
                found += usize::from(regions.iter().skip(i).take(WITHIN + 1).any(|j| *j > 0.5));
            }
            gone = 0;
        }
    }
    (cases, found)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rgbd_io::Image;

    fn square(x0: usize, side: usize) -> Mask {
        Image::from_fn(100, 75, |x, y| u8::from((x0..x0 + side).contains(&x) && (20..20 + side).contains(&y)))
    }

    #[test]
    fn known_overlaps() {
        assert_eq!(region(&square(10, 20), &square(10, 20)), 1.0);
        assert!((region(&square(10, 20), &square(20, 20)) - 1.0 / 3.0).abs() < 1e-9);
        assert_eq!(region(&square(10, 0), &square(10, 0)), 1.0);
    }

    #[test]
    fn an_outline_one_pixel_off_matches_and_one_far_off_does_not() {
        assert_eq!(boundary(&square(10, 20), &square(11, 20)), 1.0);
        assert_eq!(boundary(&square(10, 20), &square(60, 20)), 0.0);
        assert_eq!(boundary(&square(10, 0), &square(60, 20)), 0.0);
        assert_eq!(boundary(&square(10, 0), &square(60, 0)), 1.0);
        let half_off = boundary(&square(10, 20), &square(15, 20));
        assert!((0.3..0.9).contains(&half_off), "{half_off}");
    }

    #[test]
    fn a_case_is_found_or_not() {
        let areas = [100, 100, 0, 0, 0, 60, 90, 90, 90, 90, 90, 90];
        let mut regions = vec![0.9; 12];
        assert_eq!(reappearances(&areas, &regions), (1, 1));
        regions[5..12].fill(0.0);
        assert_eq!(reappearances(&areas, &regions), (1, 0));
        assert_eq!(reappearances(&[100, 0, 90, 90], &[1.0; 4]), (0, 0));
    }
}
