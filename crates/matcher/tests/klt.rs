//! Point tracking against known warps of a procedural texture.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, unreachable_pub, missing_docs)]

mod texture;

use matcher::{CornerOptions, KltOptions, Pyramid, Rect, detect_corners, track, track_forward_backward};
use rgbd_io::{Image, Mask};
use texture::texture;

const SIZE: (usize, usize) = (220, 180);

/// An affine map of the image plane about the image's centre.
#[derive(Clone, Copy)]
struct Affine {
    m: [f32; 4],
    t: [f32; 2],
}

impl Affine {
    fn apply(&self, p: [f32; 2]) -> [f32; 2] {
        let (u, v) = (p[0] - 110.0, p[1] - 90.0);
        [self.m[0] * u + self.m[1] * v + 110.0 + self.t[0], self.m[2] * u + self.m[3] * v + 90.0 + self.t[1]]
    }

    fn inverse(&self, p: [f32; 2]) -> [f32; 2] {
        let det = self.m[0] * self.m[3] - self.m[1] * self.m[2];
        let (u, v) = (p[0] - 110.0 - self.t[0], p[1] - 90.0 - self.t[1]);
        [(self.m[3] * u - self.m[1] * v) / det + 110.0, (-self.m[2] * u + self.m[0] * v) / det + 90.0]
    }
}

fn rotation(degrees: f32, scale: f32) -> [f32; 4] {
    let (s, c) = degrees.to_radians().sin_cos();
    [scale * c, -scale * s, scale * s, scale * c]
}

/// The texture and its image under `map`, with a gain, a bias and a little noise.
fn pair(map: Affine, gain: f32, bias: f32) -> (Image<f32>, Image<f32>) {
    let a = Image::from_fn(SIZE.0, SIZE.1, |x, y| texture(x as f32, y as f32, 7));
    let b = Image::from_fn(SIZE.0, SIZE.1, |x, y| {
        let p = map.inverse([x as f32, y as f32]);
        let noise = ((x * 7919 + y * 104_729) % 17) as f32 / 8.0 - 1.0;
        gain * texture(p[0], p[1], 7) + bias + noise
    });
    (a, b)
}

/// Corners at least 35 pixels inside.
fn corners(gray: &Image<f32>) -> Vec<[f32; 2]> {
    let mask = Mask::from_fn(SIZE.0, SIZE.1, |x, y| {
        u8::from(x >= 35 && y >= 35 && x + 35 < SIZE.0 && y + 35 < SIZE.1)
    });
    detect_corners(gray, &mask, &CornerOptions::default())
}

/// (median error, tracked, points)
fn run(map: Affine, guess: impl Fn([f32; 2]) -> [f32; 2], warp: Option<[f32; 4]>) -> (f32, usize, usize) {
    let (a, b) = pair(map, 0.8, 20.0);
    let points = corners(&a);
    assert!(points.len() > 80, "{} corners", points.len());
    let guesses: Vec<_> = points.iter().map(|&p| guess(p)).collect();
    let warps = warp.map(|w| vec![w; points.len()]);
    let (a, b) = (Pyramid::new(a, 3), Pyramid::new(b, 3));
    let tracks = track_forward_backward(&a, &b, &points, &guesses, warps.as_deref(), &KltOptions::default());
    let mut errors: Vec<f32> = points
        .iter()
        .zip(&tracks)
        .filter_map(|(&p, t)| {
            let truth = map.apply(p);
            t.map(|t| (t.position[0] - truth[0]).hypot(t.position[1] - truth[1]))
        })
        .collect();
    errors.sort_by(f32::total_cmp);
    (errors.get(errors.len() / 2).copied().unwrap_or(f32::INFINITY), errors.len(), points.len())
}

#[test]
fn shifts_are_found_to_a_tenth_of_a_pixel() {
    for t in [[0.3, -0.6], [3.45, 2.2], [-9.7, 7.35]] {
        let (median, tracked, all) = run(Affine { m: rotation(0.0, 1.0), t }, |p| p, None);
        assert!(median < 0.05, "{t:?}: median error {median}");
        assert!(tracked * 10 >= all * 8, "{t:?}: {tracked} of {all}");
    }
}

#[test]
fn a_predicted_warp_makes_large_rotations_and_scales_trackable() {
    let map = Affine { m: rotation(35.0, 1.25), t: [4.0, -3.0] };
    // The prediction is off by 2 pixels, 2 degrees and 2 percent.
    let guess = |p| {
        let q = map.apply(p);
        [q[0] + 1.6, q[1] - 1.2]
    };
    let (median, tracked, all) = run(map, guess, Some(rotation(33.0, 1.225)));
    assert!(median < 0.1, "median error {median}");
    // Points near the rim of the source leave the target image.
    assert!(tracked * 10 >= all * 7, "{tracked} of {all}");
    // Without the warp most are lost: the test can fail.
    let (_, tracked, all) = run(map, guess, None);
    assert!(tracked * 3 < all, "{tracked} of {all} without a warp");
}

#[test]
fn foreshortening_is_tracked_with_its_warp() {
    let m = [0.7, 0.1, -0.05, 1.05];
    let map = Affine { m, t: [-2.0, 3.3] };
    let (median, tracked, all) = run(map, |p| map.apply(p).map(|v| v.round()), Some(m));
    assert!(median < 0.1 && tracked * 10 >= all * 8, "median {median}, {tracked} of {all}");
}

#[test]
fn occluded_points_are_rejected() {
    let (a, mut b) = pair(Affine { m: rotation(0.0, 1.0), t: [2.0, 1.0] }, 1.0, 0.0);
    // Another texture covers the left half of the target.
    for y in 0..SIZE.1 {
        for x in 0..110 {
            b[(x, y)] = texture(x as f32, y as f32, 99);
        }
    }
    let points = corners(&a);
    let tracks = track_forward_backward(
        &Pyramid::new(a, 3),
        &Pyramid::new(b, 3),
        &points,
        &points,
        None,
        &KltOptions::default(),
    );
    let (mut hidden, mut wrong, mut seen, mut kept) = (0, 0, 0, 0);
    for (p, t) in points.iter().zip(&tracks) {
        let good = t.is_some_and(|t| (t.position[0] - p[0] - 2.0).hypot(t.position[1] - p[1] - 1.0) < 0.5);
        if p[0] < 100.0 {
            hidden += 1;
            wrong += usize::from(t.is_some());
        } else if p[0] > 120.0 {
            seen += 1;
            kept += usize::from(good);
        }
    }
    assert!(wrong * 10 <= hidden, "{wrong} of {hidden} hidden points were \"tracked\"");
    assert!(kept * 10 >= seen * 9, "{kept} of {seen}");
}

#[test]
fn a_cropped_pyramid_tracks_in_frame_pixels() {
    let color = |dx: f32| {
        Image::from_fn(SIZE.0, SIZE.1, |x, y| {
            let v = texture(x as f32 - dx, y as f32, 3) as u8;
            [v, v, v]
        })
    };
    let mask =
        Mask::from_fn(SIZE.0, SIZE.1, |x, y| u8::from((60..160).contains(&x) && (50..130).contains(&y)));
    let rect = Rect::around_mask(&mask, 10).unwrap();
    let other = Rect { x: rect.x + 7, y: rect.y - 5, ..rect };
    let (a, b) = (Pyramid::from_rect(&color(0.0), rect, 3), Pyramid::from_rect(&color(2.5), other, 3));
    assert_eq!(a.origin(), [50.0, 40.0]);
    let points: Vec<[f32; 2]> = (0..30).map(|i| [75.0 + 2.0 * i as f32, 70.0 + i as f32]).collect();
    let tracks = track(&a, &b, &points, &points, None, &KltOptions::default());
    let good = points.iter().zip(&tracks).filter(|(p, t)| {
        t.is_some_and(|t| (t.position[0] - p[0] - 2.5).abs() < 0.15 && (t.position[1] - p[1]).abs() < 0.15)
    });
    assert!(good.count() >= 27);
}

#[test]
fn odd_inputs_give_none() {
    let gray = Image::from_fn(64, 48, |x, y| texture(x as f32, y as f32, 1));
    let (textured, plain) = (Pyramid::new(gray, 3), Pyramid::new(Image::filled(64, 48, 90.0), 3));
    let options = KltOptions::default();
    let points = [[f32::NAN, 5.0], [-3.0, 5.0], [64.5, 5.0], [f32::INFINITY, 1.0]];
    assert!(track(&textured, &textured, &points, &points, None, &options).iter().all(Option::is_none));
    let middle = [[30.0, 20.0]];
    let lost = |from: &Pyramid, to: &Pyramid, guess: [f32; 2], warp: [f32; 4]| {
        track_forward_backward(from, to, &middle, &[guess], Some(&[warp]), &options)[0].is_none()
    };
    let identity = [1.0, 0.0, 0.0, 1.0];
    assert!(!lost(&textured, &textured, middle[0], identity));
    assert!(lost(&plain, &textured, middle[0], identity));
    assert!(lost(&textured, &plain, middle[0], identity));
    assert!(lost(&textured, &textured, [f32::NAN, 1.0], identity));
    assert!(lost(&textured, &textured, [1e9, 1.0], identity));
    assert!(lost(&textured, &textured, middle[0], [0.0; 4]));
    assert!(lost(&textured, &textured, middle[0], [f32::NAN; 4]));
    let empty = Pyramid::new(Image::default(), 3);
    assert!(lost(&empty, &textured, middle[0], identity) && lost(&textured, &empty, middle[0], identity));
    let dark = Pyramid::new(Image::filled(64, 48, f32::NAN), 3);
    assert!(lost(&dark, &textured, middle[0], identity) && lost(&textured, &dark, middle[0], identity));
    // Missing guesses are the points themselves.
    assert!(track(&textured, &textured, &middle, &[], None, &options)[0].is_some());
}

#[test]
fn a_change_of_light_moves_points_by_what_their_texture_says() {
    // The same picture in full and in a tenth of the contrast, under the same change of appearance.
    let light = |x: usize, y: usize| 2.0 * (0.9 * x as f32 + 0.4 * y as f32).sin();
    let moved = |contrast: f32| {
        let plain = Image::from_fn(SIZE.0, SIZE.1, |x, y| contrast * texture(x as f32, y as f32, 7));
        let lit = Image::from_fn(SIZE.0, SIZE.1, |x, y| plain[(x, y)] + light(x, y));
        let points = corners(&Image::from_fn(SIZE.0, SIZE.1, |x, y| texture(x as f32, y as f32, 7)));
        let options = KltOptions { min_eigenvalue: 1e-3, min_ncc: 0.0, ..KltOptions::default() };
        let (plain, lit) = (Pyramid::new(plain, 1), Pyramid::new(lit, 1));
        let tracks = track(&plain, &lit, &points, &points, None, &options);
        let found = points.iter().zip(tracks).filter_map(|(p, t)| t.map(|t| (p, t)));
        let mut values: Vec<[f32; 2]> =
            found.map(|(p, t)| [(t.position[0] - p[0]).hypot(t.position[1] - p[1]), t.texture]).collect();
        assert!(values.len() > 60, "{}", values.len());
        let mut median = |column: usize| {
            values.sort_by(|a, b| a[column].total_cmp(&b[column]));
            values[values.len() / 2][column]
        };
        [median(0), median(1)]
    };
    let ([strong, much], [weak, little]) = (moved(1.0), moved(0.1));
    assert!((much / little / 100.0 - 1.0).abs() < 0.1, "textures {much} and {little}");
    assert!((5.0..20.0).contains(&(weak / strong)), "moved by {strong} and {weak} px");
}
