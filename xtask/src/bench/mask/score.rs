//! How good a mask is: region similarity J and boundary measure F (Perazzi et al., CVPR 2016).

use rgbd_io::Mask;

/// Boundaries this share of the image's diagonal apart still match.
const TOLERANCE: f64 = 0.008;

/// Intersection over union; 1 when both are empty.
pub(super) fn region(mask: &Mask, truth: &Mask) -> f64 {
    let (mut both, mut either) = (0u32, 0u32);
    for (&a, &b) in mask.pixels().iter().zip(truth.pixels()) {
        both += u32::from(a != 0 && b != 0);
        either += u32::from(a != 0 || b != 0);
    }
    if either == 0 { 1.0 } else { f64::from(both) / f64::from(either) }
}

/// Harmonic mean of the shares of the mask's outline near the true one and of the true one near the mask's.
pub(super) fn boundary(mask: &Mask, truth: &Mask) -> f64 {
    let (w, h) = truth.size();
    let reach = (TOLERANCE * (w as f64).hypot(h as f64)).ceil() as isize;
    let outlines = [outline(mask), outline(truth)];
    let [found, wanted] = &outlines;
    match (found.is_empty(), wanted.is_empty()) {
        (true, true) => return 1.0,
        (false, false) => {}
        _ => return 0.0,
    }
    let near = outlines.each_ref().map(|o| dilate(o, (w, h), reach));
    let share = |outline: &[(usize, usize)], near: &[bool]| {
        outline.iter().filter(|(x, y)| near[y * w + x]).count() as f64 / outline.len() as f64
    };
    let (precision, recall) = (share(found, &near[1]), share(wanted, &near[0]));
    if precision + recall == 0.0 { 0.0 } else { 2.0 * precision * recall / (precision + recall) }
}

/// Pixels whose label differs from that to the right, below or diagonally below.
fn outline(mask: &Mask) -> Vec<(usize, usize)> {
    let (w, h) = mask.size();
    let mut found = Vec::new();
    for y in 0..h {
        for x in 0..w {
            let here = mask[(x, y)] != 0;
            let (r, b) = ((x + 1).min(w - 1), (y + 1).min(h - 1));
            if [(r, y), (x, b), (r, b)].iter().any(|&p| (mask[p] != 0) != here) {
                found.push((x, y));
            }
        }
    }
    found
}

fn dilate(outline: &[(usize, usize)], (w, h): (usize, usize), reach: isize) -> Vec<bool> {
    let mut near = vec![false; w * h];
    for &(x, y) in outline {
        for dy in -reach..=reach {
            let Some(row) = y.checked_add_signed(dy).filter(|row| *row < h) else { continue };
            let half = ((reach * reach - dy * dy) as f64).sqrt() as usize;
            near[row * w + x.saturating_sub(half)..=row * w + (x + half).min(w - 1)].fill(true);
        }
    }
    near
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
