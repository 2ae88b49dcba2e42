//! Crop, detection and matching together against known homographies.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, unreachable_pub, missing_docs)]

mod texture;

use matcher::{
    CropOptions, FeatureMatcher, Match, Orientation, RollCrop, ScaleSpaceMatcher, ScaleSpaceOptions,
};
use nalgebra::{Matrix3, Vector3};
use rgbd_io::{Image, Mask};
use texture::texture;

const SIZE: (usize, usize) = (420, 360);
/// The object is an ellipse about this pixel of the first view.
const CENTRE: [f64; 2] = [200.0, 170.0];
const RADII: [f64; 2] = [100.0, 80.0];

fn map(h: &Matrix3<f64>, p: [f64; 2]) -> [f64; 2] {
    let q = h * Vector3::new(p[0], p[1], 1.0);
    [q.x / q.z, q.y / q.z]
}

/// Similarity about the object's centre, then a shift and a perspective part.
fn homography(roll_degrees: f64, scale: f64, perspective: [f64; 2]) -> Matrix3<f64> {
    let (s, c) = roll_degrees.to_radians().sin_cos();
    let to_centre = Matrix3::new(1.0, 0.0, -CENTRE[0], 0.0, 1.0, -CENTRE[1], 0.0, 0.0, 1.0);
    let turn = Matrix3::new(
        scale * c,
        -scale * s,
        0.0,
        scale * s,
        scale * c,
        0.0,
        perspective[0],
        perspective[1],
        1.0,
    );
    let back = Matrix3::new(1.0, 0.0, CENTRE[0] + 11.3, 0.0, 1.0, CENTRE[1] + 4.6, 0.0, 0.0, 1.0);
    back * turn * to_centre
}

/// A textured ellipse in front of another texture that stays where it is.
fn view(h: &Matrix3<f64>, contrast: f32) -> (Image<f32>, Mask) {
    let inverse = h.try_inverse().unwrap();
    let mut mask = Mask::filled(SIZE.0, SIZE.1, 0);
    let gray = Image::from_fn(SIZE.0, SIZE.1, |x, y| {
        let p = map(&inverse, [x as f64, y as f64]);
        let r = ((p[0] - CENTRE[0]) / RADII[0]).powi(2) + ((p[1] - CENTRE[1]) / RADII[1]).powi(2);
        if r <= 1.0 {
            mask[(x, y)] = 255;
            128.0 + contrast * (texture(p[0] as f32, p[1] as f32, 21) - 128.0)
        } else {
            texture(x as f32 * 0.8, y as f32 * 0.8, 77)
        }
    });
    (gray, mask)
}

fn run(matcher: &dyn FeatureMatcher, h: &Matrix3<f64>, roll_degrees: f64) -> Vec<Match> {
    let (ga, ma) = view(&Matrix3::identity(), 1.0);
    let (gb, mb) = view(h, 1.0);
    let options = CropOptions::default();
    let a = RollCrop::new(&ga, &ma, 0.0, &options).unwrap();
    let b = RollCrop::new(&gb, &mb, roll_degrees.to_radians(), &options).unwrap();
    matcher.match_features(&matcher.detect(&a), &matcher.detect(&b))
}

fn correct(matches: &[Match], h: &Matrix3<f64>, tolerance: f64) -> usize {
    let good = |m: &&Match| {
        let truth = map(h, m.a.map(f64::from));
        (f64::from(m.b[0]) - truth[0]).hypot(f64::from(m.b[1]) - truth[1]) <= tolerance
    };
    matches.iter().filter(good).count()
}

fn assert_precise(matches: &[Match], h: &Matrix3<f64>, at_least: usize, what: &str) {
    let good = correct(matches, h, 2.0);
    assert!(good >= at_least, "{what}: {good} correct of {} matches", matches.len());
    assert!(good * 10 >= matches.len() * 9, "{what}: {good} correct of {} matches", matches.len());
}

#[test]
fn rolled_and_scaled_views_match_through_their_crops() {
    let matcher = ScaleSpaceMatcher::default();
    for (roll, scale) in [(0.0, 1.0), (30.0, 1.0), (30.0, 0.7), (-30.0, 1.4), (110.0, 1.2)] {
        let h = homography(roll, scale, [0.0, 0.0]);
        // The crop undoes the roll up to the error of a predicted pose.
        let matches = run(&matcher, &h, -roll + 4.0);
        assert_precise(&matches, &h, 60, &format!("roll {roll}, scale {scale}"));
        assert!(matches.iter().all(|m| (0.0..=1.0).contains(&m.confidence)));
    }
}

#[test]
fn perspective_is_tolerated() {
    let h = homography(20.0, 0.9, [0.001, -0.0008]);
    assert_precise(&run(&ScaleSpaceMatcher::default(), &h, -20.0), &h, 50, "perspective");
}

#[test]
fn dominant_orientation_needs_no_roll_and_upright_does() {
    let h = homography(100.0, 1.0, [0.0, 0.0]);
    let dominant = ScaleSpaceMatcher {
        options: ScaleSpaceOptions { orientation: Orientation::Dominant, ..ScaleSpaceOptions::default() },
    };
    assert_precise(&run(&dominant, &h, 0.0), &h, 60, "dominant");
    let upright = run(&ScaleSpaceMatcher::default(), &h, 0.0);
    assert!(correct(&upright, &h, 2.0) < 5, "upright descriptors should not match across 100 degrees");
}

#[test]
fn positions_are_sub_pixel() {
    let h = homography(30.0, 1.0, [0.0, 0.0]);
    let matches = run(&ScaleSpaceMatcher::default(), &h, -30.0);
    let mut errors: Vec<f64> = matches
        .iter()
        .map(|m| {
            let truth = map(&h, m.a.map(f64::from));
            (f64::from(m.b[0]) - truth[0]).hypot(f64::from(m.b[1]) - truth[1])
        })
        .collect();
    errors.sort_by(f64::total_cmp);
    assert!(errors[errors.len() / 2] < 0.4, "median error {}", errors[errors.len() / 2]);
}

#[test]
fn features_lie_on_the_object_and_are_reproducible() {
    let matcher = ScaleSpaceMatcher::default();
    let (gray, mask) = view(&Matrix3::identity(), 1.0);
    let crop = RollCrop::new(&gray, &mask, 0.4, &CropOptions::default()).unwrap();
    let features = matcher.detect(&crop);
    assert!(features.len() > 100, "{} features", features.len());
    assert_eq!(features.descriptors.count(), features.len());
    assert_eq!(features.scales.len(), features.len());
    for p in &features.points {
        assert!(mask[((p[0] + 0.5) as usize, (p[1] + 0.5) as usize)] != 0, "{p:?} is background");
    }
    assert_eq!(features, matcher.detect(&crop));
}

#[test]
fn a_plain_object_has_few_features_whatever_is_behind_it() {
    let matcher = ScaleSpaceMatcher::default();
    let (gray, mask) = view(&Matrix3::identity(), 0.0);
    let crop = RollCrop::new(&gray, &mask, 0.0, &CropOptions::default()).unwrap();
    let features = matcher.detect(&crop);
    assert!(features.len() <= 2, "{} features on a plain object", features.len());
    assert!(matcher.match_features(&features, &features).len() <= 2);
}

#[test]
fn tiny_and_broken_crops_are_fine() {
    let matcher = ScaleSpaceMatcher::default();
    let gray = Image::from_fn(30, 30, |x, y| texture(x as f32, y as f32, 5));
    let one = Mask::from_fn(30, 30, |x, y| u8::from(x == 15 && y == 15));
    for margin in [0.0, 10.0, f32::NAN] {
        let options = CropOptions { margin, ..CropOptions::default() };
        let _ = matcher.detect(&RollCrop::new(&gray, &one, 0.3, &options).unwrap());
    }
    let broken = Image::filled(30, 30, f32::NAN);
    let crop = RollCrop::new(&broken, &Mask::filled(30, 30, 1), 0.0, &CropOptions::default()).unwrap();
    assert!(matcher.detect(&crop).is_empty());
}
